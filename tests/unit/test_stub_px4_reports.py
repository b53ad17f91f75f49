"""What PX4 reports once a second: link statistics that are counted, the way home, integrity, remote identification."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stub_client import MemoryClient

from sitl_stub.mavlink.codec import Received
from sitl_stub.physics import estimator as belief


def _reports(client: MemoryClient) -> tuple[list[Received], int, int]:
    """LINK_NODE_STATUS since the last look, and messages and bytes that came before the last of them."""
    frames = list(client.link.frames)
    messages = client.link.take()
    last = max(index for index, m in enumerate(messages) if m.name == "LINK_NODE_STATUS")
    reports = [m for m in messages if m.name == "LINK_NODE_STATUS"]
    return reports, last, sum(len(frame) for frame in frames[:last])


def test_link_statistics_are_those_of_the_link() -> None:
    client = MemoryClient()
    for _ in range(30):
        client.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
        client.advance(0.1)
    reports, sent, sent_bytes = _reports(client)
    assert [m.timestamp for m in reports] == [10_000, 1_000_000, 2_000_000, 3_000_000]
    last = reports[-1]
    assert (last.messages_sent, last.messages_received, last.messages_lost) == (sent, 30, 0)
    assert last.rx_rate == pytest.approx(10 * 21, abs=25)
    in_windows = sum(m.tx_rate * s for m, s in zip(reports[1:], (0.99, 1.0, 1.0), strict=True))
    assert in_windows == pytest.approx(sent_bytes, rel=0.02)


def test_link_statistics_tell_what_was_lost_and_broken() -> None:
    client = MemoryClient()
    beat = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
    client.send(beat)
    client.packer.seq = (client.packer.seq + 3) & 0xFF
    client.send(beat)
    frame = bytearray(beat.pack(client.packer))
    frame[-1] ^= 0xFF
    assert client.link.reader.read_datagram(bytes(frame)) == []
    client.advance(1.0)
    last = _reports(client)[0][-1]
    assert (last.messages_received, last.messages_lost, last.rx_parse_err) == (2, 3, 1)
    client.autopilot.restart(0.5)
    client.advance(0.6)
    fresh = _reports(client)[0][-1]
    assert fresh.messages_sent < 30 and (fresh.messages_received, fresh.messages_lost) == (0, 0)


def test_the_way_home_in_seconds_as_the_capture_tells_it() -> None:
    client = MemoryClient(estimator="perfect")
    client.advance(2.5)
    assert client.last("TIME_ESTIMATE_TO_TARGET").safe_return == 0
    client.in_the_air(height_m=2.0)
    # over home at 2 m: down at 1.5 m/s, a tenth more and 100 s; the capture told 101 to 104
    assert client.last("TIME_ESTIMATE_TO_TARGET").safe_return == 101
    client.advance(8.0, every=lambda: client.position(6.0, 0.0, -2.0))
    # 6 m off it climbs to 6 m at 3 m/s, flies at 5 m/s, and comes down at 1.5 m/s
    assert client.last("TIME_ESTIMATE_TO_TARGET").safe_return == int(100 + 1.1 * (4 / 3 + 6 / 5 + 6 / 1.5))
    # parameters may be set to anything (found by scripts/hostile_frames.py)
    for name, value in (("MPC_XY_CRUISE", 0.0), ("MPC_Z_V_AUTO_UP", -1e30), ("RTL_TIME_FACTOR", 3e38)):
        client.autopilot.parameters.set(name, value)
        client.advance(2.1, every=lambda: client.position(6.0, 0.0, -2.0))
        assert client.last("TIME_ESTIMATE_TO_TARGET").safe_return >= 100


def test_remote_identification_follows_the_flight() -> None:
    client = MemoryClient(estimator="perfect")
    client.advance(2.5)
    location = client.last("OPEN_DRONE_ID_LOCATION")
    assert (location.status, location.direction) == (1, 0)
    client.in_the_air(height_m=3.0)
    client.advance(2.0, every=lambda: client.position(0.0, 20.0, -3.0))
    messages = client.take()
    location = [m for m in messages if m.name == "OPEN_DRONE_ID_LOCATION"][-1]
    operator = [m for m in messages if m.name == "OPEN_DRONE_ID_SYSTEM"][-1]
    origin = client.autopilot.state.origin
    assert (operator.operator_latitude, operator.operator_longitude) == origin.globe_e7(0.0, 0.0)
    assert operator.area_count == 1
    assert location.status == 2
    assert location.direction == pytest.approx(9000, abs=200)  # east
    assert location.speed_horizontal > 100 and abs(location.speed_vertical) < 50
    assert location.height == pytest.approx(3.0, abs=0.3)
    assert location.altitude_geodetic == round(location.altitude_barometric)


def test_without_a_fix_the_place_is_unknown_and_the_operator_silent() -> None:
    client = MemoryClient(estimator="gps")
    client.advance(6.0)
    assert client.take("OPEN_DRONE_ID_SYSTEM")
    client.autopilot.core.estimator.arrays.memory[belief.AIDED] = 0.0
    client.advance(2.0)
    messages = client.take()
    location = [m for m in messages if m.name == "OPEN_DRONE_ID_LOCATION"][-1]
    assert (location.latitude, location.longitude, location.direction) == (0, 0, 36100)
    assert (location.altitude_geodetic, location.horizontal_accuracy) == (-1000.0, 0)
    assert not [m for m in messages if m.name == "OPEN_DRONE_ID_SYSTEM"]
    assert [m.raim_hfom for m in messages if m.name == "GNSS_INTEGRITY"] == [65535, 65535]


def test_the_old_firmware_reports_its_links_only() -> None:
    client = MemoryClient(firmware="px4-1.13")
    client.advance(3.0)
    names = {m.name for m in client.take()}
    assert "LINK_NODE_STATUS" in names
    assert not names & {"GNSS_INTEGRITY", "OPEN_DRONE_ID_LOCATION", "TIME_ESTIMATE_TO_TARGET", "CURRENT_MODE"}
