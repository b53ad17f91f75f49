"""Faults of the vehicle and of the air about it, seen from the wire; and those that a vehicle has no part for."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
from fault_client import flying_ardupilot, flying_px4, inject, px4_mode, px4_mode_of, stay, texts
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl_stub.faults.fault import FaultError
from sitl_stub.faults.scenario import Target, entry_from, scenario_from
from sitl_stub.firmware.ardupilot.modes import Mode as ArduMode
from sitl_stub.firmware.px4.events import event_number
from sitl_stub.firmware.px4.modes import Mode as Px4Mode
from sitl_stub.physics import vehicle as body
from sitl_stub.physics.vehicle import load_vehicle


# --- vehicle and air ----------------------------------------------------------------------------------------------
def test_motor_failure_turns_the_vehicle_over() -> None:
    client = flying_px4()
    inject(client, "motor_failure", rotor=2)
    stay(client, 1.5)
    attitudes = client.take("ATTITUDE")
    assert max(max(abs(m.roll), abs(m.pitch)) for m in attitudes) > 0.7
    assert client.height_m < 2.5


@pytest.mark.parametrize("check", [1.0, 0.0])
def test_arducopter_disarms_a_vehicle_that_lies_there(check: float) -> None:
    """Its crash check; without that, FS_CRASH_CHECK 0, the motors go on turning."""
    client = flying_ardupilot()
    client.autopilot.parameters.set("FS_CRASH_CHECK", check)
    inject(client, "motor_failure", rotor=2)
    told: list[str] = []
    for _ in range(40):
        client.advance(0.5)
        told += texts(client)
    crash = [text for text in told if text.startswith("Crash: Disarming: AngErr=")]
    assert len(crash) == (1 if check else 0)
    assert client.autopilot.armed is (check == 0.0)
    if check:
        assert "Disarming motors" in told and client.height_m < 0.5


@pytest.mark.parametrize("shaken", [False, True])
def test_a_vehicle_on_its_side_is_disarmed_unless_something_throws_it_about(shaken: bool) -> None:
    """Held leaning by 69° in the air for 5 s. Its speed goes from 1 to -1 m/s and back where it is shaken: 200 m/s²."""
    client = flying_ardupilot()
    core = client.autopilot.core
    sides = itertools.cycle((1.0, -1.0))

    def hold_on_its_side() -> None:
        core.state[body.POSITION_NED] = (0.0, 0.0, -5.0)
        core.state[body.QUATERNION_WXYZ] = (math.cos(0.6), math.sin(0.6), 0.0, 0.0)
        core.state[body.VELOCITY_NED] = (next(sides) if shaken else 0.0, 0.0, 0.0)
        core.state[body.BODY_RATE_FRD] = 0.0

    client.advance(5.0, every=hold_on_its_side, period_s=0.01)
    crashed = [text for text in texts(client) if text.startswith("Crash: Disarming")]
    assert client.autopilot.armed is shaken and bool(crashed) is not shaken


def test_weakened_rotor_is_balanced_by_its_command() -> None:
    client = flying_px4()
    before = client.last("SERVO_OUTPUT_RAW")
    inject(client, "motor_failure", rotor=1, thrust_share=0.8)
    stay(client, 3.0)
    after = client.last("SERVO_OUTPUT_RAW")
    assert after.servo2_raw - 1000 > 1.1 * (before.servo2_raw - 1000)
    assert client.height_m == pytest.approx(3.0, abs=0.2)


@pytest.mark.parametrize(
    ("remaining", "mode", "charge_state"), [(0.06, Px4Mode.RTL, 3), (0.03, Px4Mode.LAND, 4)]
)
def test_battery_failsafe_of_px4(remaining: float, mode: Px4Mode, charge_state: int) -> None:
    client = flying_px4()
    volts = client.last("SYS_STATUS").voltage_battery
    inject(client, "battery_critical", remaining=remaining)
    stay(client, 1.5)
    seen = client.take()
    status = [m for m in seen if m.name == "SYS_STATUS"][-1]
    assert status.battery_remaining == round(100 * remaining)
    assert status.voltage_battery < 0.9 * volts
    assert [m for m in seen if m.name == "BATTERY_STATUS"][-1].charge_state == charge_state
    assert px4_mode_of(seen) is Px4Mode.LOITER  # COM_FAIL_ACT_T: the pilot may step in
    assert [m for m in seen if m.name == "HEARTBEAT"][-1].system_status == 5
    (event,) = [m for m in seen if m.name == "EVENT"]
    assert event.id == event_number("commander_failsafe_enter_hold")
    stay(client, 5.0)
    assert px4_mode(client) is mode


def test_px4_may_be_told_only_to_warn_and_may_be_taken_back() -> None:
    client = flying_px4(parameters={"COM_LOW_BAT_ACT": 0})
    inject(client, "battery_critical", remaining=0.06)
    stay(client, 1.5)
    assert px4_mode(client) is Px4Mode.OFFBOARD
    client = flying_px4()
    inject(client, "battery_critical", remaining=0.06, for_s=8.0)
    stay(client, 6.0)
    assert px4_mode(client) is Px4Mode.RTL
    assert client.set_mode(Px4Mode.OFFBOARD) == [0, 0]
    stay(client, 1.1)
    assert px4_mode(client) is Px4Mode.OFFBOARD
    stay(client, 2.5)
    assert client.last("SYS_STATUS").battery_remaining > 90


def test_battery_failsafe_of_ardupilot_after_its_timer() -> None:
    client = flying_ardupilot("SYS_STATUS", "BATTERY_STATUS", parameters={"BATT_FS_LOW_ACT": 1})
    inject(client, "battery_critical", remaining=0.05)
    client.advance(9.9)
    assert client.autopilot.state.mode is ArduMode.GUIDED
    client.advance(0.3)
    seen = client.take()
    assert [m for m in seen if m.name == "SYS_STATUS"][-1].voltage_battery < 10_500
    assert [m for m in seen if m.name == "BATTERY_STATUS"][-1].charge_state == 2
    said = [m.text for m in seen if m.name == "STATUSTEXT" and not m.text.startswith("fault:")]
    assert said[0].startswith("Battery 1 is low ") and said[1:] == ["Battery Failsafe"]
    assert client.autopilot.state.mode is ArduMode.LAND
    client.advance(20.0)
    assert not client.autopilot.armed
    assert client.command("DO_SET_MODE", 1, ArduMode.GUIDED.custom_mode) == [0]
    assert client.command("COMPONENT_ARM_DISARM", 1) == [4]
    client.advance(0.1)
    assert texts(client)[-2:] == ["Arm: Battery 1 low voltage failsafe", "Arm: Battery failsafe"]


def test_a_lost_ground_station_of_ardupilot() -> None:
    client = flying_ardupilot(parameters={"FS_GCS_ENABLE": 1, "FS_OPTIONS": 0})
    beat = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
    client.advance(3.0, every=lambda: client.send(beat))
    client.take()
    client.advance(4.9)
    assert client.autopilot.state.mode is ArduMode.GUIDED
    client.advance(0.6)
    assert client.autopilot.state.mode is ArduMode.RTL
    client.send(beat)
    client.advance(0.5)
    assert texts(client) == ["GCS Failsafe", "GCS Failsafe Cleared"]
    assert client.autopilot.state.mode is ArduMode.RTL


def test_sagging_battery_takes_thrust_and_gives_it_back() -> None:
    client = flying_px4(parameters={"COM_LOW_BAT_ACT": 0})
    before = client.last("SERVO_OUTPUT_RAW").servo1_raw
    inject(client, "battery_critical", sag=True, for_s=4.0)
    stay(client, 3.5)
    assert client.last("SERVO_OUTPUT_RAW").servo1_raw - 1000 > 1.15 * (before - 1000)
    stay(client, 4.0)
    assert client.last("SERVO_OUTPUT_RAW").servo1_raw == pytest.approx(before, abs=10)


def test_dropped_payload_makes_it_hover_on_less() -> None:
    client = flying_px4()
    core = client.autopilot.core
    before = client.last("SERVO_OUTPUT_RAW").servo1_raw
    inertia = core.parameters_packed[1:4].copy()
    inject(client, "payload_drop", mass_kg=0.25 * core.vehicle.mass_kg, inertia_share=0.9)
    stay(client, 4.0)
    after = client.last("SERVO_OUTPUT_RAW").servo1_raw
    assert (after - 1000) / (before - 1000) == pytest.approx(0.75, abs=0.03)
    assert core.parameters_packed[1:4] == pytest.approx(0.9 * inertia)


def test_gust_pushes_and_passes() -> None:
    client = flying_px4(vehicle="px4_sih")
    inject(client, "gust", east_m_s=12.0, north_m_s=0.0, for_s=2.0)
    worst = 0.0
    for _ in range(10):
        stay(client, 0.2)
        worst = max(worst, *(m.y for m in client.take("LOCAL_POSITION_NED")))
    assert worst > 0.1
    stay(client, 6.0)
    assert client.last("LOCAL_POSITION_NED").y == pytest.approx(0.0, abs=0.1)
    assert abs(client.autopilot.core.environment[:3]).max() == pytest.approx(0.0, abs=1e-12)


# --- what a vehicle has not got -----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("firmware", "fault", "part"),
    [
        ("px4", {"kind": "motor_failure", "rotor": 5}, "count from 0 to 3"),
        ("px4", {"kind": "payload_drop", "mass_kg": 50}, "give at the most"),
        ("px4", {"kind": "pilot_mode", "mode": "ALT_HOLD"}, "none of firmware px4: give one of position"),
        ("ardupilot", {"kind": "pilot_mode", "mode": "POSCTL"}, "none of firmware ardupilot"),
        ("px4", {"kind": "pilot_mode", "mode": "FAST"}, "mode is 'FAST': give one of"),
        ("px4", {"kind": "stream_stop", "messages": ["ATITUDE"]}, "give a list of MAVLink message names"),
        ("px4", {"kind": "reboot", "for_s": 1.0}, "momentary: leave it out"),
    ],
)
def test_what_firmware_or_vehicle_have_not_got(firmware: str, fault: dict[str, Any], part: str) -> None:
    target = Target(firmware, load_vehicle("qball2"))
    with pytest.raises(FaultError, match=part):
        entry_from(fault, target)
    with pytest.raises(FaultError, match=r"file.toml: \[\[fault\]\] 1"):
        scenario_from({"fault": [fault]}, "file.toml", target)
