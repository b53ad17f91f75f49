"""PX4's behaviour, message by message, on an autopilot inside this process."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stub_client import LEVEL, MemoryClient, message_id

from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.build import build_px4
from sitl_stub.firmware.px4.events import Event
from sitl_stub.firmware.px4.modes import Mode
from sitl_stub.mavlink.codec import LAYOUTS, NEWER_MESSAGES
from sitl_stub.physics.vehicle import IMPACT_SPEED

HOVER = 0.3658


def _mode(client: MemoryClient) -> Mode:
    return client.autopilot.state.mode


# --- arming -------------------------------------------------------------------------------------------------------
def test_arming_before_ready_and_without_setpoints_is_rejected_for_now() -> None:
    client = MemoryClient()
    assert client.command("COMPONENT_ARM_DISARM", 1) == [1]
    client.advance(2.0)
    assert client.set_mode(Mode.OFFBOARD) == [0, 0]
    assert client.command("COMPONENT_ARM_DISARM", 1) == [1]
    assert not client.autopilot.armed
    assert client.set_mode(Mode.LOITER) == [0, 0]
    assert client.command("COMPONENT_ARM_DISARM", 1) == [0]
    assert client.autopilot.armed


def test_prearm_bit_is_for_the_present_mode() -> None:
    client = MemoryClient()
    bit = 1 << 28
    client.advance(2.0)
    assert client.last("SYS_STATUS").onboard_control_sensors_health & bit
    client.set_mode(Mode.OFFBOARD)
    client.advance(0.5)
    assert not client.last("SYS_STATUS").onboard_control_sensors_health & bit
    client.advance(0.5, every=lambda: client.attitude(0.0))
    assert client.last("SYS_STATUS").onboard_control_sensors_health & bit


def test_events_have_the_numbers_of_the_capture() -> None:
    captured = (0x0102089D, 0x0190CAF3, 0x01414569, 0x019638AC, 0x01F46777, 0x01DEDBD0)
    spoken = (
        Event.ARMING_DENIED,
        Event.ARMED,
        Event.TAKEOFF_DETECTED,
        Event.LANDING_DETECTED,
        Event.DISARMED,
    )
    assert tuple(event.number for event in (*spoken, Event.FAILSAFE)) == captured


def test_forcing_skips_no_check_of_arming() -> None:
    client = MemoryClient()
    client.advance(2.0)
    assert client.set_mode(Mode.OFFBOARD) == [0, 0]
    assert client.command("COMPONENT_ARM_DISARM", 1, 21196) == [1]
    assert not client.autopilot.armed


def test_disarming_in_the_air_needs_force() -> None:
    client = MemoryClient()
    client.in_the_air()
    assert client.command("COMPONENT_ARM_DISARM", 0) == [1]
    assert client.autopilot.armed
    assert client.command("COMPONENT_ARM_DISARM", 0, 21196) == [0]
    assert not client.autopilot.armed


def test_unknown_command_message_and_parameter() -> None:
    client = MemoryClient()
    client.advance(0.1)
    assert client.command(31999, 1) == [3]
    assert client.command("SET_MESSAGE_INTERVAL", 9999, 10000) == [4]
    assert client.command("REQUEST_MESSAGE", 9999) == [2]
    client.send(mavlink.MAVLink_param_request_read_message(1, 1, b"NO_SUCH_PARAM", -1))
    client.send(mavlink.MAVLink_param_set_message(1, 1, b"NO_SUCH_PARAM", 1.0, 9))
    assert client.take("PARAM_VALUE") == []


def test_messages_for_others_are_not_obeyed() -> None:
    client = MemoryClient()
    client.advance(2.0)
    client.send(
        mavlink.MAVLink_command_long_message(
            2, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0
        )
    )
    client.send(
        mavlink.MAVLink_command_long_message(
            1, 25, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0
        )
    )
    assert client.take("COMMAND_ACK") == []
    assert not client.autopilot.armed


def test_armed_and_never_taken_off_disarms_after_its_time() -> None:
    client = MemoryClient(parameters={"COM_DISARM_PRFLT": 3.0})
    client.advance(2.0)
    assert client.command("COMPONENT_ARM_DISARM", 1) == [0]
    client.advance(2.9)
    assert client.autopilot.armed
    client.advance(0.2)
    assert not client.autopilot.armed


# --- offboard -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("action", "mode"), [(3, Mode.RTL), (4, Mode.LAND), (5, Mode.LOITER), (0, Mode.RTL)])
def test_offboard_loss_does_what_the_parameter_says_and_recovers(action: int, mode: Mode) -> None:
    client = MemoryClient(parameters={"COM_OBL_RC_ACT": action})
    client.in_the_air()
    client.advance(0.95)
    assert _mode(client) is Mode.OFFBOARD
    client.advance(0.15)
    assert _mode(client) is mode
    client.advance(1.1)
    beat = client.last("HEARTBEAT")
    assert (beat.custom_mode, beat.system_status) == (mode.custom_mode, 5)
    client.advance(0.1, every=lambda: client.position(0, 0, -3))
    assert _mode(client) is Mode.OFFBOARD


def test_offboard_loss_with_disarm_action_stops_the_rotors() -> None:
    client = MemoryClient(parameters={"COM_OBL_RC_ACT": 7})
    client.in_the_air()
    client.advance(1.2)
    assert not client.autopilot.armed


def test_loss_timeout_is_a_parameter() -> None:
    client = MemoryClient(parameters={"COM_OF_LOSS_T": 0.3})
    client.in_the_air()
    client.advance(0.4)
    assert _mode(client) is Mode.LAND


def test_throttle_ignored_is_zero_thrust_and_keeps_offboard_alive() -> None:
    client = MemoryClient()
    client.in_the_air()
    client.advance(0.6, every=lambda: client.attitude(HOVER))
    client.advance(0.2, every=lambda: client.attitude(0.9, mask=71))
    assert client.autopilot.core.memory[at.OUT_THRUST] == 0.0
    assert _mode(client) is Mode.OFFBOARD


def test_mask_zero_lets_the_rates_override_the_attitude() -> None:
    client = MemoryClient(estimator="perfect")
    client.in_the_air()
    client.advance(1.0, every=lambda: client.attitude(HOVER))
    client.advance(0.5, every=lambda: client.attitude(HOVER, LEVEL, mask=0, rates=(0.3, 0.0, 0.0)))
    assert client.autopilot.core.state[10] == pytest.approx(0.3, abs=0.08)
    assert client.tilt_rad > 0.06


def test_rates_meet_the_attitude_loop_until_the_mode_is_published() -> None:
    """The capture's pitch rate step: up to half a second in which a rate setpoint gets about 0.4 of its way."""
    client = MemoryClient(estimator="perfect")
    client.in_the_air()
    client.advance(1.2, every=lambda: client.attitude(HOVER), period_s=0.01)
    while client.autopilot.time_us - client.autopilot.control.latched_us != 0:
        client.attitude(HOVER)
        client.autopilot.step()
    rates: list[float] = []
    for _ in range(40):
        client.attitude(HOVER, mask=128, rates=(0.0, 0.6, 0.0))
        client.advance(0.01)
        rates.append(float(client.autopilot.core.state[11]))
    assert 0.1 < np.mean(rates[15:]) < 0.3
    client.advance(0.4, every=lambda: client.attitude(HOVER, mask=128, rates=(0.0, 0.6, 0.0)), period_s=0.01)
    assert client.autopilot.core.state[11] == pytest.approx(0.6, abs=0.12)


@pytest.mark.parametrize("q", [[math.nan, 0, 0, 0], [0, 0, 0, 0]])
def test_an_attitude_that_is_none_is_no_setpoint(q: list[float]) -> None:
    client = MemoryClient()
    client.advance(2.0)
    client.attitude(0.5, q)
    assert client.autopilot.offboard.count == 0


def test_quaternion_off_unit_length_is_normalised() -> None:
    client = MemoryClient()
    client.attitude(0.5, [2.0, 0.0, 0.0, 2.0])
    half = math.sqrt(0.5)
    packed = client.autopilot.offboard.packed
    np.testing.assert_allclose(packed[at.QUATERNION : at.QUATERNION + 4], [half, 0, 0, half], atol=1e-7)


@pytest.mark.parametrize("firmware", ["px4", "px4-1.13"])
def test_actuator_controls_work_on_the_old_firmware_only(firmware: str) -> None:
    client = MemoryClient(firmware=firmware)
    client.advance(2.0)

    def controls() -> None:
        client.send(
            mavlink.MAVLink_set_actuator_control_target_message(0, 0, 1, 1, [0, 0, 0, 0.2, 0, 0, 0, 0])
        )

    client.advance(1.0, every=controls)
    client.set_mode(Mode.OFFBOARD)
    old = firmware == "px4-1.13"
    assert client.command("COMPONENT_ARM_DISARM", 1) == [0 if old else 1]
    client.advance(0.5, every=controls)
    np.testing.assert_allclose(client.autopilot.core.motors[:4], 0.2 if old else 0.0, atol=1e-9)
    assert client.autopilot.version.flight_sw_version == (0x010D03FF if old else 0x011100FF)


def test_velocity_setpoint_in_the_heading_frame() -> None:
    client = MemoryClient(estimator="perfect")
    client.in_the_air()
    client.advance(3.0, every=lambda: client.position(0, 0, -3, yaw=math.pi / 2))

    def forward() -> None:
        client.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, 1, 1, 8, 0b110111000111, 0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0, 0
            )
        )

    client.advance(6.0, every=forward)
    assert client.autopilot.core.state[4] == pytest.approx(1.0, abs=0.1)  # east
    assert client.autopilot.core.state[3] == pytest.approx(0.0, abs=0.1)


# --- own modes ----------------------------------------------------------------------------------------------------
def test_take_off_hold_return_land_and_disarm_by_its_own_modes() -> None:
    client = MemoryClient(parameters={"RTL_RETURN_ALT": 6.0, "RTL_DESCEND_ALT": 4.0})
    client.advance(2.0)
    assert client.command("COMPONENT_ARM_DISARM", 1) == [0]
    assert client.command("NAV_TAKEOFF", 0, 0, 0, math.nan, 0, 0, 0) == [0]
    client.advance(12.0)
    assert _mode(client) is Mode.LOITER
    assert client.height_m == pytest.approx(client.autopilot.parameters["MIS_TAKEOFF_ALT"], abs=0.35)
    states = [m.landed_state for m in client.take("EXTENDED_SYS_STATE")]
    assert [s for i, s in enumerate(states) if i == 0 or s != states[i - 1]] == [1, 3, 2]
    target = client.autopilot.state.origin.globe_e7(5.0, -3.0)
    client.send(
        mavlink.MAVLink_command_int_message(
            1,
            1,
            mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
            mavlink.MAV_CMD_DO_REPOSITION,
            0,
            0,
            -1,
            0,
            0,
            math.nan,
            *target,
            math.nan,
        )
    )
    assert client.last("COMMAND_ACK").result == 0
    client.advance(12.0)
    np.testing.assert_allclose(client.autopilot.core.state[:2], [5.0, -3.0], atol=0.3)
    assert client.set_mode(Mode.RTL) == [0, 0]
    client.advance(60.0)
    assert not client.autopilot.armed
    np.testing.assert_allclose(client.autopilot.core.state[:2], [0.0, 0.0], atol=0.5)
    assert _mode(client) is Mode.LOITER  # the mode chosen before arming


def test_landing_from_offboard_ends_disarmed_in_offboard_as_in_the_capture() -> None:
    client = MemoryClient()
    client.in_the_air()
    assert client.set_mode(Mode.LAND) == [0, 0]
    client.advance(15.0)
    assert not client.autopilot.armed
    assert abs(client.height_m) < 0.02
    assert _mode(client) is Mode.OFFBOARD
    assert float(client.autopilot.core.state[IMPACT_SPEED]) < 1.0  # MPC_LAND_SPEED 0.7 m/s


def test_sticks_are_needed_for_position_mode_and_move_the_vehicle() -> None:
    client = MemoryClient(parameters={"COM_RC_IN_MODE": 1}, estimator="perfect")
    client.in_the_air()
    assert client.set_mode(Mode.POSCTL) == [0, 1]  # none there yet
    assert _mode(client) is Mode.OFFBOARD

    def sticks(x: int) -> None:
        client.send(mavlink.MAVLink_manual_control_message(1, x, 0, 500, 0, 0))

    sticks(0)
    assert client.set_mode(Mode.POSCTL) == [0, 0]
    client.advance(2.0, every=lambda: sticks(0))
    still = float(client.autopilot.core.state[0])
    client.advance(2.0, every=lambda: sticks(300))
    assert client.autopilot.core.state[0] > still + 1.0
    client.advance(1.0)  # sticks lost: it holds for COM_FAIL_ACT_T, then NAV_RCL_ACT 2, return
    assert _mode(client) is Mode.LOITER
    client.advance(5.0)
    assert _mode(client) is Mode.RTL


@pytest.mark.parametrize("mode", [Mode.STABILIZED, Mode.ALTCTL, Mode.ACRO])
def test_other_stick_modes_lean_to_the_stick(mode: Mode) -> None:
    client = MemoryClient(parameters={"COM_RC_IN_MODE": 1}, estimator="perfect")
    client.in_the_air()

    def sticks() -> None:
        throttle = round(1000 * HOVER) if mode is Mode.ACRO else 500
        client.send(mavlink.MAVLink_manual_control_message(1, 0, 200, throttle, 0, 0))

    sticks()
    assert client.command("DO_SET_MODE", 1, mode.value.main) == [0, 0]
    client.advance(0.5, every=sticks)
    roll = 2 * float(client.autopilot.core.state[7])
    assert 0.05 < roll < 0.4


def test_loss_of_position_lands_a_position_mode() -> None:
    client = MemoryClient()
    client.in_the_air()
    client.autopilot.core.estimator.set_position_invalid(True)
    client.advance(0.1, every=lambda: client.position(0, 0, -3))
    assert _mode(client) is Mode.LAND
    client.advance(12.0)
    assert not client.autopilot.armed


# --- parameters ---------------------------------------------------------------------------------------------------
def test_parameter_list_whole_with_hash_first_and_integers_as_bits() -> None:
    client = MemoryClient()
    client.advance(1.0)
    client.take()
    client.send(mavlink.MAVLink_param_request_list_message(1, 1))
    client.advance(2.0)
    values = client.take("PARAM_VALUE")
    assert values[0].param_id == "_HASH_CHECK"
    assert [m.param_index for m in values[1:]] == list(range(884))
    by_name = {m.param_id: m for m in values}
    bits = struct.unpack("<i", struct.pack("<f", by_name["COM_OBL_RC_ACT"].param_value))[0]
    assert (bits, by_name["COM_OBL_RC_ACT"].param_type) == (4, 6)
    assert by_name["MPC_THR_HOVER"].param_value == pytest.approx(1.79 * 9.81 / 48, abs=1e-4)


def test_parameter_set_reaches_the_controller_and_everybody() -> None:
    client = MemoryClient()
    other = MemoryClient(autopilot=client.autopilot, role="gcs")
    client.send(mavlink.MAVLink_param_set_message(1, 1, b"MC_ROLL_P", 5.5, 9))
    assert client.last("PARAM_VALUE").param_value == 5.5
    assert other.last("PARAM_VALUE").param_value == 5.5
    assert client.autopilot.core.gains[at.ATTITUDE_P] == 5.5
    as_float = struct.unpack("<f", struct.pack("<i", 3))[0]
    client.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", as_float, 6))
    assert client.autopilot.parameters["COM_OBL_RC_ACT"] == 3
    client.send(mavlink.MAVLink_param_set_message(1, 1, b"MC_ROLL_P", math.nan, 9))
    assert client.last("PARAM_VALUE").param_value == 5.5


def test_hash_follows_values() -> None:
    client = MemoryClient()

    def asked() -> int:
        client.send(mavlink.MAVLink_param_request_read_message(1, 1, b"_HASH_CHECK", -1))
        return int.from_bytes(struct.pack("<f", client.last("PARAM_VALUE").param_value), "little")

    first = asked()
    client.autopilot.parameters.set("MC_ROLL_P", 4.5)
    assert asked() != first
    client.autopilot.parameters.set("MC_ROLL_P", 4.0)
    assert asked() == first


# --- streams ------------------------------------------------------------------------------------------------------
def test_intervals_are_kept_and_position_comes_before_attitude() -> None:
    client = MemoryClient()
    client.advance(1.0)
    quick = ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "HIL_STATE_QUATERNION")
    for name, interval in (*((name, 4000) for name in quick), ("ATTITUDE", -1)):
        assert client.command("SET_MESSAGE_INTERVAL", message_id(name), interval) == [0]
    client.take()
    client.advance(2.0)
    messages = client.take()
    names = [m.name for m in messages]
    assert names.count("ATTITUDE_QUATERNION") == names.count("LOCAL_POSITION_NED") == 500
    assert names.count("HIL_STATE_QUATERNION") == 500 and "ATTITUDE" not in names
    pairs = [n for n in names if n in ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION")]
    assert pairs == ["LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"] * 500
    assert client.command("SET_MESSAGE_INTERVAL", message_id("ATTITUDE_QUATERNION"), 0) == [0]
    client.advance(2.0)
    assert [m.name for m in client.take()].count("ATTITUDE_QUATERNION") == pytest.approx(100, abs=1)
    client.command("GET_MESSAGE_INTERVAL", message_id("LOCAL_POSITION_NED"))
    client.send(
        mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, 0, message_id("LOCAL_POSITION_NED"), 0, 0, 0, 0, 0, 0
        )
    )
    assert client.last("MESSAGE_INTERVAL").interval_us == 4000


def test_requested_messages_come_at_once() -> None:
    client = MemoryClient()
    client.advance(2.0)
    client.take()
    client.send(
        mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, message_id("AUTOPILOT_VERSION"), 0, 0, 0, 0, 0, 0
        )
    )
    names = [m.name for m in client.take()]
    assert names == ["AUTOPILOT_VERSION", "COMMAND_ACK"]
    client.send(
        mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, message_id("GPS_GLOBAL_ORIGIN"), 0, 0, 0, 0, 0, 0
        )
    )
    origin = client.take("GPS_GLOBAL_ORIGIN")[0]
    assert origin.latitude == pytest.approx(473977432, abs=2)


def test_ground_station_and_companion_have_their_own_rates_and_versions() -> None:
    companion = MemoryClient()
    station = MemoryClient(autopilot=companion.autopilot, role="gcs", mavlink1=True)
    station.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    companion.take(), station.take()
    companion.advance(2.0)
    assert {frame[0] for frame in companion.link.frames} == {0xFD}
    assert {frame[0] for frame in station.link.frames} == {0xFE}
    fast, slow = companion.take("ATTITUDE"), station.take("ATTITUDE")
    assert (len(fast), len(slow)) == (200, 30)


def test_timesync_both_ways_and_ping() -> None:
    client = MemoryClient()
    client.advance(0.5)
    requests = client.take("TIMESYNC")
    assert len(requests) == 6 and {m.tc1 for m in requests} == {0}
    client.send(mavlink.MAVLink_timesync_message(0, 123456789))
    answer = client.last("TIMESYNC")
    assert (answer.tc1, answer.ts1) == (500_000_000, 123456789)
    client.send(mavlink.MAVLink_ping_message(42, 7, 0, 0))
    ping = client.last("PING")
    assert (ping.time_usec, ping.seq, ping.target_system, ping.target_component) == (42, 7, 255, 190)


def test_truth_is_the_truth() -> None:
    client = MemoryClient(estimator="gps")
    client.advance(5.0)
    client.command("SET_MESSAGE_INTERVAL", message_id("HIL_STATE_QUATERNION"), 100000)
    client.advance(0.5)
    truth = client.last("HIL_STATE_QUATERNION")
    origin = client.autopilot.state.origin
    assert (truth.lat, truth.lon) == origin.globe_e7(0.0, 0.0)
    assert list(truth.attitude_quaternion) == [1, 0, 0, 0]
    assert client.autopilot.core.position_ned[0] != 0.0


def test_every_message_it_can_send_can_be_read_by_pymavlink() -> None:
    client = MemoryClient(firmware="px4-1.13")
    client.advance(2.0)
    for number, definition in client.autopilot.streams.definitions.items():
        values = definition.build(client.link)
        if values is None or definition.layout.name in NEWER_MESSAGES:
            continue
        frame = client.link.writer.frame(definition.layout, values)
        decoded = mavlink.MAVLink(None).decode(bytearray(frame))
        assert decoded.get_msgId() == number
        assert len(values) == len(
            LAYOUTS[definition.layout.name].packer.unpack(bytes(definition.layout.packer.size))
        )


# --- repeatability ------------------------------------------------------------------------------------------------
def test_same_seed_same_bytes() -> None:
    def flown(seed: int) -> bytes:
        client = MemoryClient(build_px4(seed=seed, gust_speed_m_s=2.0))
        client.in_the_air()
        client.advance(1.0, every=lambda: client.attitude(HOVER))
        return b"".join(client.link.frames)

    first = flown(1)
    assert len(first) > 10_000
    assert first == flown(1)
    assert first != flown(2)
