"""What the ArduCopter stub answers, and what it lets fall silently: as the capture, or the same build at real time."""

from __future__ import annotations

import math
import re
import struct

import numpy as np
import pytest
from ardupilot_client import (
    BRAKE,
    GUIDED,
    GUIDED_NOGPS,
    HOVER,
    LAND,
    LOITER,
    RTL,
    THRUST_AS_THRUST,
    ArduPilotClient,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stub_client import message_id

from sitl_stub.firmware.ardupilot.parameters import stock_parameters
from sitl_stub.mavlink.codec import LAYOUTS, Received, unpack_payload

ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4
ATTITUDE, ODOMETRY, SIM_STATE = map(message_id, ("ATTITUDE", "ODOMETRY", "SIM_STATE"))
ESTIMATOR_STATUS = message_id("ESTIMATOR_STATUS")


def test_nothing_streams_until_asked() -> None:
    client = ArduPilotClient()
    client.advance(5.0)
    assert {m.name for m in client.take()} == {
        "HEARTBEAT",
        "STATUSTEXT",
        "HOME_POSITION",
        "GPS_GLOBAL_ORIGIN",
    }


@pytest.mark.parametrize(
    ("hertz", "result"), [(100.0, ACCEPTED), (250.0, ACCEPTED), (333.0, ACCEPTED), (400.0, DENIED)]
)
def test_intervals_are_whole_milliseconds_and_three_is_the_least(hertz: float, result: int) -> None:
    client = ArduPilotClient()
    assert client.command("SET_MESSAGE_INTERVAL", ATTITUDE, 1e6 / hertz) == [result]
    client.take()
    client.advance(1.0)
    granted_ms = math.floor(1e3 / hertz)
    wanted = 1000 / granted_ms if result == ACCEPTED else 0
    assert len(client.take("ATTITUDE")) == pytest.approx(wanted, abs=2)


def test_refused_rate_and_unknown_message_are_explained_after_the_answer() -> None:
    client = ArduPilotClient()
    client.advance(1.0)
    client.take()
    assert client.answers("SET_MESSAGE_INTERVAL", ATTITUDE, 2500) == (
        [DENIED],
        ["Requested rate for message ID 30 too fast. Increase SCHED_LOOP_RATE"],
    )
    for number in (ODOMETRY, ESTIMATOR_STATUS, 9999):
        assert client.answers("SET_MESSAGE_INTERVAL", number, 1e5) == (
            [DENIED],
            [f"No ap_message for mavlink id ({number})"],
        )
    assert client.command("SET_MESSAGE_INTERVAL", ATTITUDE, -5) == [DENIED]
    assert client.command("SET_MESSAGE_INTERVAL", ATTITUDE, -1) == [ACCEPTED]


def test_interval_and_message_on_request() -> None:
    client = ArduPilotClient()
    client.command("SET_MESSAGE_INTERVAL", ATTITUDE, 4700)
    client.send(
        mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 0, ATTITUDE, 0, 0, 0, 0, 0, 0
        )
    )
    assert client.last("MESSAGE_INTERVAL").interval_us == 4000
    assert client.command("GET_MESSAGE_INTERVAL", ODOMETRY) == [FAILED]
    assert client.command("REQUEST_MESSAGE", ODOMETRY) == [FAILED]
    client.send(
        mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, message_id("AUTOPILOT_VERSION"), 0, 0, 0, 0, 0, 0
        )
    )
    version = client.last("AUTOPILOT_VERSION")
    assert (version.flight_sw_version >> 24, version.flight_sw_version >> 16 & 255) == (4, 7)
    assert bytes(version.flight_custom_version) == b"2598e9d4"


def test_request_data_stream_turns_groups_on_and_off() -> None:
    client = ArduPilotClient()
    client.advance(2.0)
    client.send(mavlink.MAVLink_request_data_stream_message(1, 1, 10, 10, 1))
    client.take()
    client.advance(1.0)
    assert len(client.take("ATTITUDE")) == pytest.approx(10, abs=1)
    client.send(mavlink.MAVLink_request_data_stream_message(1, 1, 10, 10, 0))
    client.advance(0.2)
    client.take()
    client.advance(1.0)
    assert client.take("ATTITUDE") == []


def test_readiness_comes_in_the_captures_order() -> None:
    client = ArduPilotClient(ready_after_s=42.0)
    for number in map(message_id, ("SYS_STATUS", "LOCAL_POSITION_NED", "EKF_STATUS_REPORT")):
        client.command("SET_MESSAGE_INTERVAL", number, 1e5)
    seen: dict[str, float] = {}
    flags = []
    while client.autopilot.time_us < 44e6:
        client.advance(0.1)
        now = client.autopilot.time_us * 1e-6
        for message in client.take():
            if message.name == "SYS_STATUS" and message.onboard_control_sensors_health & 1 << 28:
                seen.setdefault("pre-arm bit", now)
            elif message.name == "LOCAL_POSITION_NED":
                seen.setdefault("position", now)
            elif message.name == "HOME_POSITION":
                seen.setdefault("home", now)
            elif message.name == "EKF_STATUS_REPORT" and flags[-1:] != [message.flags]:
                flags.append(message.flags)
    assert seen["home"] == pytest.approx(20.0, abs=0.2)
    assert seen["pre-arm bit"] == pytest.approx(23.3, abs=0.4)
    assert seen["position"] == pytest.approx(41.6, abs=0.2)
    assert flags == [1024, 167, 831]


def test_arming_too_early_is_refused_in_ardupilots_words() -> None:
    client = ArduPilotClient(ready_after_s=42.0)
    client.advance(10.9)
    client.take()
    assert client.answers("COMPONENT_ARM_DISARM", 1) == ([FAILED], ["Arm: Accels inconsistent"])
    assert client.answers("DO_SET_MODE", 1, GUIDED) == ([ACCEPTED], [])  # any mode on the ground
    assert client.answers("COMPONENT_ARM_DISARM", 1) == (
        [FAILED],
        ["Arm: Accels inconsistent", "Arm: AHRS: waiting for home"],
    )
    client.advance(14.0)
    client.take()
    assert client.answers("COMPONENT_ARM_DISARM", 1) == ([FAILED], ["Arm: Need Position Estimate"])
    client.advance(6.0)
    assert client.texts()[-1] == "PreArm: Need Position Estimate"
    assert client.answers("COMPONENT_ARM_DISARM", 0) == ([ACCEPTED], [])
    assert client.answers("COMPONENT_ARM_DISARM", 2) == ([UNSUPPORTED], [])


def test_modes_that_do_not_arm_say_so() -> None:
    client = ArduPilotClient()
    client.advance(3.0)
    client.take()
    for number, name in ((RTL, "RTL"), (LAND, "LAND"), (BRAKE, "BRAKE")):
        client.command("DO_SET_MODE", 1, number)
        assert client.answers("COMPONENT_ARM_DISARM", 1) == ([FAILED], [f"Arm: {name} mode not armable"])
    assert client.answers("DO_SET_MODE", 1, 99) == ([FAILED], ["No such mode 99"])
    assert client.command("DO_SET_MODE", 0, GUIDED) == [DENIED]  # base mode without the custom bit
    client.command("DO_SET_MODE", 1, GUIDED)
    assert client.answers("COMPONENT_ARM_DISARM", 1) == ([ACCEPTED], ["Arming motors"])


def test_take_off_needs_arming_the_ground_and_a_way_up() -> None:
    client = ArduPilotClient()
    client.advance(2.0)
    client.command("DO_SET_MODE", 1, GUIDED)
    assert client.command("NAV_TAKEOFF", 0, 0, 0, 0, 0, 0, 5) == [FAILED]
    client.command("COMPONENT_ARM_DISARM", 1)
    assert client.command("NAV_TAKEOFF", 0, 0, 0, 0, 0, 0, -5) == [FAILED]
    assert client.command("NAV_TAKEOFF", 0, 0, 0, 0, 0, 0, 5) == [ACCEPTED]
    client.advance(12.0)
    assert client.command("NAV_TAKEOFF", 0, 0, 0, 0, 0, 0, 8) == [FAILED]
    assert client.command("COMPONENT_ARM_DISARM", 0) == [FAILED]  # in the air
    assert client.answers("DO_SET_MODE", 1, 3)[1][-1:] == ["Mode change to AUTO failed: init failed"]
    assert client.command("COMPONENT_ARM_DISARM", 0, 21196) == [ACCEPTED]
    assert not client.autopilot.armed


def test_mode_that_needs_a_position_is_refused_without_one_in_the_air() -> None:
    client = ArduPilotClient()
    client.in_the_air()
    assert client.command("DO_SET_MODE", 1, GUIDED_NOGPS) == [ACCEPTED]
    client.autopilot.core.estimator.set_position_invalid(True)
    client.advance(0.1)
    client.take()
    assert client.answers("DO_SET_MODE", 1, LOITER) == (
        [FAILED],
        ["Mode change to LOITER failed: requires position"],
    )
    assert client.command("DO_SET_MODE", 1, LAND) == [ACCEPTED]


def test_without_gps_guided_is_not_armed_and_guided_nogps_is() -> None:
    client = ArduPilotClient(parameters={"GPS1_TYPE": 0.0})
    client.advance(3.0)
    assert not [text for text in client.texts() if "GPS" in text]
    assert client.command("DO_SET_MODE", 1, GUIDED) == [ACCEPTED]
    assert client.answers("COMPONENT_ARM_DISARM", 1) == ([FAILED], ["Arm: AHRS: waiting for home"])
    assert client.command("DO_SET_MODE", 1, GUIDED_NOGPS) == [ACCEPTED]
    assert client.command("COMPONENT_ARM_DISARM", 1) == [ACCEPTED]


@pytest.mark.parametrize("mode", [0, LOITER, BRAKE])
def test_targets_outside_guided_fall_silently(mode: int) -> None:
    client = ArduPilotClient(parameters=THRUST_AS_THRUST)
    client.in_the_air()
    client.command("DO_SET_MODE", 1, mode)
    client.advance(0.1)
    before = client.autopilot.core.setpoint.copy()
    client.take()
    client.attitude(0.7, q=[math.cos(0.1), math.sin(0.1), 0, 0])
    client.position(10, 0, -5)
    assert (client.autopilot.core.setpoint == before).all()
    assert client.take() == []


def test_targets_are_never_acknowledged() -> None:
    client = ArduPilotClient(parameters=THRUST_AS_THRUST)
    client.in_the_air()
    client.take()
    client.attitude(HOVER)
    client.position(1, 0, -5)
    assert client.take() == []


def test_the_thrust_bit_tells_what_thrust_means() -> None:
    client = ArduPilotClient()
    client.in_the_air()
    start = client.height_m
    client.advance(4.0, every=lambda: client.attitude(0.75))
    # half of the way from 0.5 to 1 is half of WPNAV_SPEED_UP
    assert client.height_m - start == pytest.approx(4 * 1.25, abs=1.0)
    client.advance(4.0, every=lambda: client.attitude(0.5))
    still = client.height_m
    client.advance(3.0, every=lambda: client.attitude(0.5))
    assert client.height_m == pytest.approx(still, abs=0.15)


def test_parameters_travel_as_floats_and_are_cast_as_c_does() -> None:
    client = ArduPilotClient()

    def change(name: str, value: float) -> list[tuple[float, int, int]]:
        client.take()
        client.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, 9))
        return [(m.param_value, m.param_type, m.param_index) for m in client.take("PARAM_VALUE")]

    assert change("GUID_OPTIONS", 9.7) == [(9.0, 6, 65535)]
    assert change("ATC_ANGLE_BOOST", 300.0) == [(127.0, 2, 65535)]
    assert change("MOT_THST_HOVER", 0.25) == [(0.25, 9, 65535)]
    assert change("NO_SUCH_PARAM", 1.0) == []
    assert change("MOT_THST_HOVER", math.nan) == []
    assert client.autopilot.parameters["MOT_THST_HOVER"] == 0.25


def test_reading_by_name_has_no_index_and_by_index_has() -> None:
    client = ArduPilotClient()

    def read(name: bytes, index: int) -> list[tuple[str, float, int, int]]:
        client.take()
        client.send(mavlink.MAVLink_param_request_read_message(1, 1, name, index))
        found = client.take("PARAM_VALUE")
        return [(m.param_id, m.param_value, m.param_index, m.param_count) for m in found]

    assert read(b"GUID_OPTIONS", -1) == [("GUID_OPTIONS", 0.0, 65535, 1348)]
    assert read(b"", 0) == [("FORMAT_VERSION", 120.0, 0, 1348)]
    assert read(b"NOPE", -1) == read(b"", 5000) == []


def test_parameter_list_with_losses_is_completed_by_reading_again() -> None:
    client = ArduPilotClient()
    client.advance(0.5)
    client.take()
    client.send(mavlink.MAVLink_param_request_list_message(1, 1))
    client.advance(3.0)
    messages = client.take()
    assert [m.text for m in messages if m.name == "STATUSTEXT"][:1] == ["ArduCopter V4.7.0-dev (2598e9d4)"]
    values = [m for m in messages if m.name == "PARAM_VALUE"]
    kept = {m.param_index: m for i, m in enumerate(values) if i % 7}
    missing = set(range(1348)) - set(kept)
    assert missing
    for index in missing:
        client.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", index))
    kept |= {m.param_index: m for m in client.take("PARAM_VALUE")}
    assert set(kept) == set(range(1348))
    stock = stock_parameters()
    assert {m.param_id: m.param_value for m in kept.values()} == dict(stock)


@given(value=st.floats(-1e6, 1e6), name=st.sampled_from(["ATC_ANGLE_BOOST", "ANGLE_MAX", "GUID_OPTIONS"]))
@settings(max_examples=60, deadline=None)
def test_an_integer_parameter_stays_within_its_width(value: float, name: str) -> None:
    table = stock_parameters()
    table.set(name, value)
    bits = {2: 8, 4: 16, 6: 32}[table.kind(name)]
    assert isinstance(table[name], int)
    assert -(2 ** (bits - 1)) <= table[name] < 2 ** (bits - 1)
    if abs(value) < 100:
        assert abs(table[name] - value) <= 1.0


def test_truth_is_sent_on_request_and_has_no_time() -> None:
    client = ArduPilotClient(parameters=THRUST_AS_THRUST)
    client.in_the_air()
    assert client.command("SET_MESSAGE_INTERVAL", SIM_STATE, 1e5) == [ACCEPTED]
    client.advance(0.2)
    truth = client.last("SIM_STATE")
    assert "time_usec" not in truth.values and "time_boot_ms" not in truth.values
    down = float(client.autopilot.core.state[2])
    assert 584.09 - truth.alt == pytest.approx(down, abs=1e-3)
    assert (truth.lat_int, truth.lon_int) == pytest.approx((-353632610, 1491652299), abs=50)


def test_heartbeat_tells_who_controls_and_whether_it_flies() -> None:
    client = ArduPilotClient(parameters=THRUST_AS_THRUST)
    client.advance(2.5)
    beats = [(m.base_mode, m.custom_mode, m.system_status) for m in client.take("HEARTBEAT")]
    assert beats[-1] == (81, 0, 3)
    client.in_the_air()
    assert client.last("HEARTBEAT").values["base_mode"] == 217
    client.advance(1.2, every=client.hover)
    last = client.last("HEARTBEAT")
    assert (last.base_mode, last.custom_mode, last.system_status) == (209, GUIDED, 4)


def test_broken_and_foreign_frames_do_nothing() -> None:
    client = ArduPilotClient()
    client.advance(1.0)
    client.take()
    client.send(
        mavlink.MAVLink_command_long_message(
            7, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0
        )
    )  # another system
    client.send(
        mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, math.nan, math.nan, 0, 0, 0, 0, 0
        )
    )
    client.send(
        mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 0, math.inf)
    )
    assert not client.autopilot.armed


def test_any_numbers_in_any_message_are_survived() -> None:
    """3,000 messages of every kind it listens to, with numbers as bad as they come, while it flies."""
    client = ArduPilotClient(parameters=THRUST_AS_THRUST)
    client.in_the_air()
    random = np.random.default_rng(5)
    floats = [0.0, 1.0, -1.0, 4.0, 0.5, 1e-30, 1e9, -1e9, 3e38, math.nan, math.inf, -math.inf]
    integers = [0, 1, 2, 4, 7, 9, 64, 128, 255, 400, 511, 2048, 3576, 65535, 2**31 - 1, -1]
    commands = [*client.autopilot.command_protocol.handlers, 31999]
    names = [name for name in client.autopilot.messages if name not in ("PARAM_SET", "TIMESYNC")]
    for count in range(3000):
        layout = LAYOUTS[names[int(random.integers(len(names)))]]
        parts: list[bytes] = []
        for repeat, kind in re.findall(r"(\d*)([a-zA-Z])", layout.packer.format):
            if kind == "s":
                parts.append(struct.pack(f"{repeat}s", b"GUID_OPTIONS"))
                continue
            for _ in range(int(repeat or 1)):
                if kind in "fd":
                    parts.append(struct.pack(f"<{kind}", random.choice(floats)))
                else:
                    size = struct.calcsize(kind)
                    parts.append(int(random.choice(integers)).to_bytes(9, "little", signed=True)[:size])
        values = unpack_payload(layout, b"".join(parts))
        values |= {"target_system": 1, "target_component": 1}
        if "command" in values:
            values["command"] = int(random.choice(commands))
        client.autopilot.handle(client.link, Received(layout.name, 255, 190, 2, values))
        if count % 20 == 0:
            client.advance(0.05)
            client.take()
    assert np.isfinite(client.autopilot.core.state[:13]).all()
