"""The stub's missions, fences and rally points by the mission protocol; PX4's flight of a mission, of an orbit; logs."""

from __future__ import annotations

import math
from typing import Any

import pytest
from ardupilot_client import ArduPilotClient
from stub_client import MemoryClient, mavlink

from sitl_stub.firmware.common.globe import LocalOrigin
from sitl_stub.firmware.px4.modes import Mode

RELATIVE, WHOLE = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, mavlink.MAV_FRAME_MISSION
MISSION, FENCE, RALLY = range(3)


def item(
    seq: int,
    command: int,
    x: int = 0,
    y: int = 0,
    z: float = 0.0,
    params: tuple[float, ...] = (0.0, 0.0, 0.0, math.nan),
    frame: int = RELATIVE,
    kind: int = MISSION,
) -> Any:
    return mavlink.MAVLink_mission_item_int_message(
        1, 1, seq, frame, command, int(seq == 0), 1, *params, x, y, z, kind
    )


def upload(client: MemoryClient, items: list[Any], kind: int = MISSION) -> int:
    """Speak the protocol's upload; the result in the end."""
    client.take()
    client.send(mavlink.MAVLink_mission_count_message(1, 1, len(items), kind))
    for _ in range(len(items) + 1):
        for answer in client.take():
            if answer.name == "MISSION_ACK":
                return int(answer.type)
            if answer.name == "MISSION_REQUEST_INT":
                client.send(items[answer.seq])
    raise AssertionError("no MISSION_ACK")


def download(client: MemoryClient, kind: int = MISSION) -> list[Any]:
    client.take()
    client.send(mavlink.MAVLink_mission_request_list_message(1, 1, kind))
    found = []
    for seq in range(client.last("MISSION_COUNT").count):
        client.send(mavlink.MAVLink_mission_request_int_message(1, 1, seq, kind))
        found.append(client.last("MISSION_ITEM_INT"))
    client.send(mavlink.MAVLink_mission_ack_message(1, 1, 0, kind))
    return found


def fields(messages: list[Any]) -> list[tuple[Any, ...]]:
    return [(m.command, m.values["frame"], m.x, m.y, m.z, m.seq) for m in messages]


def place(client: MemoryClient, north_m: float, east_m: float) -> tuple[int, int]:
    origin: LocalOrigin = client.autopilot.state.origin
    return origin.globe_e7(north_m, east_m)


@pytest.fixture(params=["px4", "ardupilot"])
def client(request: pytest.FixtureRequest) -> MemoryClient:
    client = MemoryClient() if request.param == "px4" else ArduPilotClient()
    client.advance(0.1)
    return client


def square(client: MemoryClient) -> list[Any]:
    corners = ((5.0, 0.0), (5.0, 5.0), (0.0, 5.0))
    return [item(n, 16, *place(client, *corner), 4.0) for n, corner in enumerate(corners)]


def test_a_mission_goes_up_and_comes_down(client: MemoryClient) -> None:
    items = square(client)
    assert upload(client, items) == mavlink.MAV_MISSION_ACCEPTED
    down = download(client)
    sent = [(m.command, m.frame, m.x, m.y, m.z, m.seq) for m in items]
    first = 0 if not isinstance(client, ArduPilotClient) else 1  # ArduPilot keeps home as item 0
    assert fields(down)[first:] == sent[first:]
    client.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 255))
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_ACCEPTED
    assert download(client) == []


def test_fence_and_rally_points_are_kept_apart(client: MemoryClient) -> None:
    vertices = [
        item(n, 5001, 470000000 + n, 80000000, 0.0, (3.0, 0.0, 0.0, 0.0), frame=0, kind=FENCE)
        for n in range(3)
    ]
    assert upload(client, vertices, FENCE) == mavlink.MAV_MISSION_ACCEPTED
    rally = [item(0, 5100, 470000000, 80000000, 20.0, kind=RALLY)]
    assert upload(client, rally, RALLY) == mavlink.MAV_MISSION_ACCEPTED
    assert [m.x for m in download(client, FENCE)] == [470000000, 470000001, 470000002]
    assert [m.z for m in download(client, RALLY)] == [20.0]
    assert download(client) == []
    client.send(mavlink.MAVLink_mission_clear_all_message(1, 1, FENCE))
    assert download(client, FENCE) == [] and len(download(client, RALLY)) == 1
    assert upload(client, vertices, MISSION) != mavlink.MAV_MISSION_ACCEPTED


def test_a_request_that_is_lost_comes_again_and_an_upload_that_stops_is_forgotten(
    client: MemoryClient,
) -> None:
    client.take()
    client.send(mavlink.MAVLink_mission_count_message(1, 1, 3, MISSION))
    assert [m.seq for m in client.take("MISSION_REQUEST_INT")] == [0]
    client.advance(0.3)
    assert [m.seq for m in client.take("MISSION_REQUEST_INT")] == [0]
    client.advance(6.0)
    client.take()
    client.advance(1.0)
    assert client.take("MISSION_REQUEST_INT") == []
    assert download(client) == []  # nothing is believed by halves


def test_a_second_partner_waits_and_a_repeated_last_item_is_acknowledged_again(client: MemoryClient) -> None:
    items = square(client)
    client.send(mavlink.MAVLink_mission_count_message(1, 1, 3, MISSION))
    other = mavlink.MAVLink(None, 254, 190)
    stranger = mavlink.MAVLink_mission_count_message(1, 1, 2, MISSION).pack(other)
    client.take()
    for message in client.link.reader.read_datagram(bytes(stranger)):
        client.autopilot.handle(client.link, message)
    assert client.last("MISSION_ACK").type in (mavlink.MAV_MISSION_ERROR, mavlink.MAV_MISSION_DENIED)
    assert upload(client, items) == mavlink.MAV_MISSION_ACCEPTED
    client.send(items[-1])
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_ACCEPTED


def test_too_many_wrong_frames_and_numbers_are_refused(client: MemoryClient) -> None:
    assert upload(client, square(client) * 1000) == mavlink.MAV_MISSION_NO_SPACE
    local = [item(0, 16, 1, 2, 3.0, frame=mavlink.MAV_FRAME_BODY_FRD)]
    assert upload(client, local) == mavlink.MAV_MISSION_UNSUPPORTED_FRAME
    assert upload(client, square(client)) == mavlink.MAV_MISSION_ACCEPTED
    client.send(mavlink.MAVLink_mission_request_int_message(1, 1, 9, MISSION))
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_INVALID_SEQUENCE


def test_the_current_item_is_chosen_and_told(client: MemoryClient) -> None:
    upload(client, square(client))
    client.take()
    client.send(mavlink.MAVLink_mission_set_current_message(1, 1, 2))
    assert client.last("MISSION_CURRENT").seq == 2
    assert client.command("DO_SET_MISSION_CURRENT", 1) == [mavlink.MAV_RESULT_ACCEPTED]
    assert client.command("DO_SET_MISSION_CURRENT", 9) != [mavlink.MAV_RESULT_ACCEPTED]


def test_ardupilot_takes_a_part_of_a_mission() -> None:
    client = ArduPilotClient()
    client.advance(0.1)
    items = square(client)
    assert upload(client, items) == mavlink.MAV_MISSION_ACCEPTED
    client.take()
    client.send(mavlink.MAVLink_mission_write_partial_list_message(1, 1, 1, 1, MISSION))
    assert [m.seq for m in client.take("MISSION_REQUEST_INT")] == [1]
    client.send(item(1, 16, *place(client, 9.0, 9.0), 7.0))
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_ACCEPTED
    assert [m.z for m in download(client)][1:] == [7.0, 4.0]


def test_plans_outlive_a_restart(client: MemoryClient) -> None:
    upload(client, square(client))
    client.autopilot.power_up(killed=False)
    assert len(download(client)) == 3


def test_px4_flies_a_mission_from_the_ground_to_the_landing() -> None:
    """Up at the start, place after place, a wait, a speed, down at the last; each item told, and the log listed."""
    client = MemoryClient(ready_after_s=1.0, estimator="perfect")
    client.advance(2.0)
    assert client.set_mode(Mode.MISSION)[-1] == 0  # on the ground every mode is granted …
    assert client.command("COMPONENT_ARM_DISARM", 1) == [
        mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    ]  # … and not armed in
    client.set_mode(Mode.LOITER)
    items = [
        item(0, 22, *place(client, 0.0, 0.0), 4.0),
        item(1, 178, params=(1.0, 2.0, -1.0, 0.0), frame=WHOLE),
        item(2, 16, *place(client, 6.0, 0.0), 4.0, (1.0, 0.5, 0.0, math.nan)),
        item(3, 16, *place(client, 6.0, 4.0), 4.0, (0.0, 0.5, 0.0, math.nan)),
        item(4, 21, *place(client, 3.0, 4.0), 0.0),
    ]
    assert upload(client, items) == mavlink.MAV_MISSION_ACCEPTED
    assert client.command("COMPONENT_ARM_DISARM", 1) == [0]
    assert client.set_mode(Mode.MISSION)[-1] == 0
    reached, fastest, highest = [], 0.0, 0.0
    state = client.autopilot.core.state
    for _ in range(600):
        client.advance(0.1)
        reached += [m.seq for m in client.take("MISSION_ITEM_REACHED")]
        fastest = max(fastest, math.hypot(float(state[3]), float(state[4])))
        highest = max(highest, -float(state[2]))
        if not client.autopilot.armed:
            break
    assert reached == [0, 1, 2, 3, 4]
    assert math.dist(state[:2], (3.0, 4.0)) < 0.5 and not client.autopilot.armed
    assert 3.5 < highest < 4.6 and 1.5 < fastest < 3.2
    client.take()
    client.send(mavlink.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF))
    entry = client.last("LOG_ENTRY")
    assert (entry.num_logs, entry.id) == (1, 0) and entry.size > 0


def test_px4_pauses_a_mission_and_goes_on_with_it() -> None:
    client = MemoryClient(ready_after_s=1.0, estimator="perfect")
    client.in_the_air()
    far = [item(n, 16, *place(client, *corner), 3.0) for n, corner in enumerate(((4.0, 0.0), (100.0, 0.0)))]
    assert upload(client, far) == mavlink.MAV_MISSION_ACCEPTED
    assert client.command("MISSION_START") == [0]
    client.advance(8.0)
    assert client.last("MISSION_CURRENT").seq == 1
    client.set_mode(Mode.LOITER)
    client.advance(4.0)
    paused = client.last("MISSION_CURRENT")
    assert (paused.seq, paused.mission_state) == (1, 4)
    there = float(client.autopilot.core.state[0])
    client.set_mode(Mode.MISSION)
    client.advance(3.0)
    assert float(client.autopilot.core.state[0]) > there + 2.0
    assert client.last("MISSION_CURRENT").mission_state == 3


def test_px4_circles_and_ardupilot_does_not_know_how() -> None:
    client = MemoryClient(ready_after_s=1.0, estimator="perfect")
    client.in_the_air()
    latitude, longitude = (value * 1e-7 for value in place(client, 4.0, 0.0))
    nan = math.nan
    assert client.command("DO_ORBIT", 4.0, 2.0, 0.0, nan, latitude, longitude, nan) == [0]
    assert client.autopilot.state.mode is Mode.ORBIT
    client.advance(4.0)
    state, distances, sides = client.autopilot.core.state, [], []
    for _ in range(60):
        client.advance(0.1)
        distances.append(math.dist(state[:2], (4.0, 0.0)))
        sides.append(float(state[1]))
    assert max(abs(d - 4.0) for d in distances) < 0.6
    assert min(sides) < -2.0 or max(sides) > 2.0
    status = client.last("ORBIT_EXECUTION_STATUS")
    assert status.radius == pytest.approx(4.0)
    other = ArduPilotClient()
    assert other.command("DO_ORBIT", 4.0, 2.0) == [mavlink.MAV_RESULT_UNSUPPORTED]


def test_without_a_flight_there_is_no_log(client: MemoryClient) -> None:
    client.take()
    client.send(mavlink.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF))
    assert client.last("LOG_ENTRY").num_logs == 0
