"""Faults of the autopilot, its estimator and its pilot, seen from the wire."""

from __future__ import annotations

import math

import pytest
from fault_client import (
    ardupilot,
    flying_ardupilot,
    flying_px4,
    inject,
    px4,
    px4_mode,
    px4_mode_of,
    stay,
    texts,
)
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stub_client import MemoryClient

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.modes import Mode as ArduMode
from sitl_stub.firmware.px4.modes import Mode as Px4Mode


# --- clock --------------------------------------------------------------------------------------------------------
def test_clock_jump_is_in_time_stamps_and_timesync_and_goes_back_at_its_end() -> None:
    client = px4({"kind": "clock_jump", "at_s": 1.0, "for_s": 1.0, "jump_s": -0.4})
    for seconds, shift in ((0.5, 0.0), (1.0, -0.4), (1.0, 0.0)):
        client.advance(seconds)
        now = client.autopilot.time_us * 1e-6
        client.send(mavlink.MAVLink_timesync_message(0, 77))
        seen = client.take()
        by_name = {m.name: m for m in seen}
        assert by_name["ATTITUDE"].time_boot_ms == pytest.approx((now + shift) * 1e3)
        assert by_name["ODOMETRY"].time_usec * 1e-6 == pytest.approx(now + shift, abs=0.05)
        (answer,) = [m for m in seen if m.name == "TIMESYNC" and m.ts1 == 77]
        assert answer.tc1 * 1e-9 == pytest.approx(now + shift)


def test_clock_never_shows_less_than_nothing() -> None:
    client = ardupilot({"kind": "clock_jump", "at_s": 0.5, "jump_s": -100})
    client.command("SET_MESSAGE_INTERVAL", mavlink.MAVLINK_MSG_ID_ATTITUDE, 20_000)
    client.advance(1.0)
    assert client.last("ATTITUDE").time_boot_ms == 0


def test_clock_drift_gains_and_keeps_what_it_gained() -> None:
    client = px4({"kind": "clock_drift", "at_s": 1.0, "for_s": 2.0, "drift_ppm": 50_000})
    client.advance(2.0)
    assert client.last("ATTITUDE").time_boot_ms == 2050
    client.advance(2.0)
    assert client.last("ATTITUDE").time_boot_ms == 4100


# --- firmware -----------------------------------------------------------------------------------------------------
def test_stopped_streams_come_back_and_others_go_on() -> None:
    client = px4({"kind": "stream_stop", "at_s": 1.0, "for_s": 1.0, "messages": ["ATTITUDE", "HEARTBEAT"]})
    client.advance(1.0)
    client.take()
    client.advance(0.99)
    stopped = {m.name for m in client.take()}
    assert not stopped & {"ATTITUDE", "HEARTBEAT"} and "LOCAL_POSITION_NED" in stopped
    client.advance(1.01)
    assert {"ATTITUDE", "HEARTBEAT"} <= {m.name for m in client.take()}


def test_reboot_in_flight_stops_rotors_and_time_begins_again() -> None:
    client = flying_px4()
    client.command("SET_MESSAGE_INTERVAL", mavlink.MAVLINK_MSG_ID_ATTITUDE, 4000)
    client.send(mavlink.MAVLink_param_set_message(1, 1, b"MC_ROLL_P", 5.0, 9))
    client.take()
    inject(client, "reboot", silent_s=1.0)
    client.advance(0.01)
    assert [m.text for m in client.take("STATUSTEXT")] == ["fault: reboot"]
    client.advance(0.9)
    assert client.command("COMPONENT_ARM_DISARM", 1) == [] and client.take() == []
    assert client.height_m < 2.0
    client.advance(0.3)
    seen = client.take("ATTITUDE")
    assert 0 <= seen[0].time_boot_ms <= 20 and len(seen) <= 22  # the default rate again
    client.advance(1.0)
    heartbeat = client.last("HEARTBEAT")
    assert not heartbeat.base_mode & 128
    assert client.height_m < 0.05
    assert client.autopilot.parameters["MC_ROLL_P"] == 5.0
    client.advance(3.0)
    assert client.command("COMPONENT_ARM_DISARM", 1) == [0]  # it is ready as after any start


def test_reboot_of_ardupilot_boots_through_all_its_stages() -> None:
    client = flying_ardupilot()
    inject(client, "reboot", silent_s=0.5)
    client.advance(0.5)
    client.take()
    client.advance(1.5)
    assert not client.autopilot.armed and client.autopilot.state.mode is ArduMode.STABILIZE
    assert client.autopilot.core.memory[at.OUT_MOTORS] == 0.0
    said = texts(client)
    assert "ArduPilot Ready" in said and "EKF3 IMU0 is using GPS" in said
    assert client.height_m < 0.1


# --- estimator ----------------------------------------------------------------------------------------------------
def test_estimator_reset_jumps_counts_and_does_not_move_a_holding_vehicle() -> None:
    client = flying_px4()
    client.set_mode(Px4Mode.LOITER)  # HOLD
    client.advance(1.0)
    before = client.last("ODOMETRY")
    truth = client.autopilot.core.state[:3].copy()
    inject(client, "estimator_reset", north_m=1.5, down_m=-0.5, yaw_deg=20)
    client.advance(0.1)
    after = client.last("ODOMETRY")
    assert after.x - before.x == pytest.approx(1.5, abs=0.05)
    assert after.z - before.z == pytest.approx(-0.5, abs=0.05)
    assert after.reset_counter == before.reset_counter + 2
    yaw = 2 * math.atan2(after.q[3], after.q[0]) - 2 * math.atan2(before.q[3], before.q[0])
    assert math.degrees(yaw) == pytest.approx(20, abs=2)
    client.advance(3.0)
    assert abs(client.autopilot.core.state[:3] - truth).max() < 0.15


def test_estimator_reset_of_ardupilot_is_taken_along_too() -> None:
    client = flying_ardupilot("LOCAL_POSITION_NED")
    assert client.command("DO_SET_MODE", 1, ArduMode.BRAKE.custom_mode) == [0]
    client.advance(2.0)
    before = client.last("LOCAL_POSITION_NED")
    truth = client.autopilot.core.state[:3].copy()
    inject(client, "estimator_reset", east_m=2.0)
    client.advance(0.1)
    assert client.last("LOCAL_POSITION_NED").y - before.y == pytest.approx(2.0, abs=0.05)
    client.advance(3.0)
    assert abs(client.autopilot.core.state[:3] - truth).max() < 0.15


def test_divergence_ramps_position_and_velocity_with_good_flags_and_recovers_with_a_reset() -> None:
    client = px4(
        {"kind": "estimator_divergence", "at_s": 2.0, "for_s": 2.0, "east_m_s": 0.75, "yaw_deg_s": 5}
    )
    client.advance(3.9)
    seen = client.take()
    positions = [m for m in seen if m.name == "LOCAL_POSITION_NED"]
    assert positions[-1].y == pytest.approx(0.75 * (positions[-1].time_boot_ms * 1e-3 - 2.0), abs=1e-3)
    assert positions[-1].vy == pytest.approx(0.75, abs=1e-6)
    attitudes = [m for m in seen if m.name == "ATTITUDE"]
    assert math.degrees(attitudes[-1].yaw) == pytest.approx(5 * 1.9, abs=0.05)
    flags = [m.flags for m in seen if m.name == "ESTIMATOR_STATUS"][-1]
    assert flags & 16 and flags & 512
    counter = [m.reset_counter for m in seen if m.name == "ODOMETRY"][-1]
    client.advance(0.3)
    after = client.last("ODOMETRY")
    assert after.y == pytest.approx(0.0, abs=1e-3) and after.reset_counter == counter + 2
    assert after.vy == pytest.approx(0.0, abs=1e-6)


def test_divergence_that_does_not_recover_leaves_its_error() -> None:
    client = px4({"kind": "estimator_divergence", "for_s": 1.0, "north_m_s": 1.0, "recovers": False})
    client.advance(2.0)
    assert client.last("LOCAL_POSITION_NED").x == pytest.approx(1.0, abs=0.01)


def test_invalid_flags_end_position_control_of_px4_and_come_back() -> None:
    client = flying_px4()
    inject(client, "estimator_invalid", for_s=1.5)
    stay(client, 1.2)
    seen = client.take()
    assert not [m.flags for m in seen if m.name == "ESTIMATOR_STATUS"][-1] & 16
    heartbeat = [m for m in seen if m.name == "HEARTBEAT"][-1]
    assert heartbeat.custom_mode == Px4Mode.LAND.custom_mode and heartbeat.system_status == 5
    stay(client, 1.5)
    seen = client.take()
    assert [m.flags for m in seen if m.name == "ESTIMATOR_STATUS"][-1] & 16
    assert [m for m in seen if m.name == "HEARTBEAT"][-1].custom_mode == Px4Mode.OFFBOARD.custom_mode


def test_invalid_flags_land_ardupilot_after_a_second() -> None:
    client = flying_ardupilot("EKF_STATUS_REPORT", "LOCAL_POSITION_NED")
    client.take()
    inject(client, "estimator_invalid")
    client.advance(0.9)
    seen = client.take()
    assert not [m.flags for m in seen if m.name == "EKF_STATUS_REPORT"][-1] & 16
    assert len([m for m in seen if m.name == "LOCAL_POSITION_NED"]) <= 1
    assert client.autopilot.state.mode is ArduMode.GUIDED
    client.advance(0.2)
    assert texts(client) == ["EKF variance", "EKF Failsafe: changed to LAND Mode"]
    client.advance(3.0)
    assert client.height_m == pytest.approx(5.0, abs=0.3)  # LAND begins with a pause of 4 s
    client.advance(16.0)
    assert not client.autopilot.armed and client.height_m < 0.05


@pytest.mark.parametrize("action", [0, 2])
def test_other_actions_on_a_lost_estimate(action: int) -> None:
    client = flying_ardupilot(parameters={"FS_EKF_ACTION": action})
    inject(client, "estimator_invalid", for_s=1.5)
    client.advance(1.4)
    assert client.autopilot.state.mode is (ArduMode.GUIDED, None, ArduMode.ALT_HOLD)[action]
    client.advance(2.0)
    acted = ("EKF Failsafe", "", "EKF Failsafe: changed to ALT_HOLD Mode")[action]
    assert texts(client) == ["EKF variance", acted, "EKF Failsafe Cleared"]


def test_lost_gps_shows_at_once_and_flags_go_later() -> None:
    client = MemoryClient(estimator="gps", seed=2)
    client.advance(5.0)
    client.take()
    from fault_client import with_faults

    with_faults(client, {"kind": "gps_loss", "at_s": 6.0, "for_s": 8.0})
    client.advance(2.0)
    seen = client.take()
    gps = [m for m in seen if m.name == "GPS_RAW_INT"]
    assert (gps[0].fix_type, gps[0].satellites_visible) == (3, 10)
    assert (gps[-1].fix_type, gps[-1].satellites_visible) == (0, 0)
    status = [m for m in seen if m.name == "SYS_STATUS"]
    assert status[0].onboard_control_sensors_health & 32
    assert not status[-1].onboard_control_sensors_health & 32
    assert [m.flags for m in seen if m.name == "ESTIMATOR_STATUS"][-1] & 16
    client.advance(5.0)
    assert not client.last("ESTIMATOR_STATUS").flags & 16
    client.advance(4.0)
    seen = client.take()
    assert [m.flags for m in seen if m.name == "ESTIMATOR_STATUS"][-1] & 16
    assert [m.reset_counter for m in seen if m.name == "ODOMETRY"][-1] == 1


def test_lost_gps_of_ardupilot_ends_in_its_failsafe() -> None:
    client = flying_ardupilot("GPS_RAW_INT", "SYS_STATUS")
    inject(client, "gps_loss")
    client.advance(1.0)
    seen = client.take()
    assert [m.fix_type for m in seen if m.name == "GPS_RAW_INT"][-1] == 1
    assert not [m for m in seen if m.name == "SYS_STATUS"][-1].onboard_control_sensors_health & 32
    client.advance(5.5)
    assert client.autopilot.state.mode is ArduMode.GUIDED
    client.advance(2.0)  # 7 s until EKF3 gives the position up, one more until ArduCopter acts
    assert client.autopilot.state.mode is ArduMode.LAND
    client.take()
    client.advance(7.0)
    assert texts(client) == ["EKF3 IMU0 stopped aiding", "EKF3 IMU1 stopped aiding"]


# --- pilot --------------------------------------------------------------------------------------------------------
def test_pilot_takes_px4_by_mode_and_gives_it_back() -> None:
    client = flying_px4()
    inject(client, "pilot_mode", mode="POSCTL", for_s=1.0)
    stay(client, 1.0)
    assert px4_mode(client) is Px4Mode.POSCTL
    stay(client, 1.1)
    assert px4_mode(client) is Px4Mode.OFFBOARD
    client.take()
    inject(client, "pilot_mode", mode="altitude")
    client.advance(3.0)
    seen = client.take()
    assert [m for m in seen if m.name == "HEARTBEAT"][-1].custom_mode == Px4Mode.ALTCTL.custom_mode
    assert [m for m in seen if m.name == "RC_CHANNELS"][-1].chan3_raw == 1500
    assert client.height_m == pytest.approx(3.0, abs=0.3)


def test_pilot_takes_ardupilot_by_mode_and_holds_its_height() -> None:
    client = flying_ardupilot()
    inject(client, "pilot_mode", mode="ALT_HOLD")
    client.advance(3.0)
    assert client.last("HEARTBEAT").custom_mode == ArduMode.ALT_HOLD.custom_mode
    assert client.height_m == pytest.approx(5.0, abs=0.2)


@pytest.mark.parametrize(("override", "taken"), [(1, False), (3, True)])
def test_moved_sticks_take_px4_out_of_offboard_as_its_parameter_says(override: int, taken: bool) -> None:
    client = flying_px4(parameters={"COM_RC_OVERRIDE": override})
    inject(client, "pilot_sticks", roll=0.6, pitch=0.0, for_s=1.5)
    stay(client, 1.4)
    seen = client.take()
    channels = [m for m in seen if m.name == "RC_CHANNELS"]
    assert len(channels) == 28 and channels[0].chan1_raw == 1800
    assert (px4_mode_of(seen) is Px4Mode.POSCTL) is taken
    assert (float(client.autopilot.core.state[1]) > 0.5) is taken
    stay(client, 0.3)
    assert client.last("RC_CHANNELS").chan1_raw == 1500


def test_small_movements_do_not_take_over() -> None:
    client = flying_px4(parameters={"COM_RC_OVERRIDE": 3})
    inject(client, "pilot_sticks", roll=0.25, pitch=0.0)
    stay(client, 1.5)
    assert px4_mode(client) is Px4Mode.OFFBOARD


def test_moved_sticks_are_seen_and_do_nothing_in_guided() -> None:
    client = flying_ardupilot("RC_CHANNELS")
    inject(client, "pilot_sticks", roll=1.0, pitch=0.4, throttle=0.8, for_s=1.0)
    client.advance(0.9)
    channels = client.last("RC_CHANNELS")
    assert (channels.chan1_raw, channels.chan2_raw, channels.chan3_raw) == (2000, 1300, 1800)
    assert abs(client.autopilot.core.state[:2]).max() < 0.1
    client.advance(0.2)
    assert client.last("RC_CHANNELS").chan3_raw == 1000


def test_pilot_disarms_in_the_air_only_by_force() -> None:
    for client in (flying_px4(), flying_ardupilot()):
        inject(client, "pilot_disarm", forced=False)
        client.advance(1.1, every=lambda c=client: c.position(0, 0, -3))
        assert client.last("HEARTBEAT").base_mode & 128
        inject(client, "pilot_disarm")
        client.advance(1.1)
        assert not client.last("HEARTBEAT").base_mode & 128
        assert client.height_m < 2.5


def test_kill_switch_stops_the_rotors_while_armed_and_px4_disarms_later() -> None:
    client = flying_px4()
    inject(client, "pilot_kill")
    stay(client, 1.1)
    seen = client.take()
    assert [m for m in seen if m.name == "HEARTBEAT"][-1].base_mode & 128
    assert [m for m in seen if m.name == "SERVO_OUTPUT_RAW"][-1].servo1_raw == 1000
    assert client.height_m < 0.1
    stay(client, 5.0)
    assert not client.last("HEARTBEAT").base_mode & 128
    assert client.command("COMPONENT_ARM_DISARM", 1) == [1]


def test_a_short_kill_lets_the_vehicle_go_on() -> None:
    for client in (flying_px4(), flying_ardupilot()):
        inject(client, "pilot_kill", for_s=0.15)
        least = client.height_m
        for _ in range(50):
            client.advance(0.02, every=lambda c=client: c.position(0, 0, -3))
            least = min(least, client.height_m)
        client.advance(4.0, every=lambda c=client: c.position(0, 0, -3))
        assert least < 2.9 or least < 4.9
        assert client.autopilot.armed and client.height_m == pytest.approx(3.0, abs=0.3)
