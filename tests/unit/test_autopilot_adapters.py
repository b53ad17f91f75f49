"""What PX4 and ArduPilot are asked, told and refused for: every finding, every mode, every encoded setpoint."""

from __future__ import annotations

import math

import numpy as np
import pytest
from mavlink_wire import decoded, mav

from companion.autopilot.adapter import ARM, DISARM, Intent, VehicleStatus, Verdict
from companion.autopilot.ardupilot import ArduPilot, ArduPilotNoGps
from companion.autopilot.px4 import Px4
from companion.autopilot.registry import adapter_for
from companion.config.errors import UserError
from companion.control.structs import ControlLevel, Reference, Setpoint

PX4, ARDUPILOT, NO_GPS = Px4(), ArduPilot(), ArduPilotNoGps()
NOW = (1, 17, 0)
SQRT = math.sqrt(0.5)
PX4_GOOD = {
    "MPC_THR_HOVER": 0.5,
    "THR_MDL_FAC": 0.0,
    "COM_OF_LOSS_T": 1.0,
    "COM_OBL_RC_ACT": 4.0,
    "COM_RC_OVERRIDE": 3.0,
    "EKF2_HGT_REF": 3.0,
    "EKF2_RNG_CTRL": 0.0,
}
ARDUPILOT_GOOD = {"GUID_OPTIONS": 8.0, "ATC_ANGLE_BOOST": 0.0, "GUID_TIMEOUT": 0.5, "MOT_THST_HOVER": 0.37}


def findings(adapter, parameters, level=ControlLevel.ATTITUDE, version=NOW):
    return {finding.subject: finding for finding in adapter.check(parameters, level, version)}


# Which adapter ------------------------------------------------------------------------------------------


def test_which_adapter():
    quadrotor = mav.MAV_TYPE_QUADROTOR
    assert isinstance(adapter_for(mav.MAV_AUTOPILOT_PX4, quadrotor), Px4)
    assert isinstance(adapter_for(mav.MAV_AUTOPILOT_ARDUPILOTMEGA, quadrotor), ArduPilot)


@pytest.mark.parametrize(
    ("autopilot", "kind", "says"),
    [
        (mav.MAV_AUTOPILOT_GENERIC, mav.MAV_TYPE_QUADROTOR, "MAV_AUTOPILOT 0"),
        (mav.MAV_AUTOPILOT_PX4, mav.MAV_TYPE_FIXED_WING, "MAV_TYPE 1"),
        (mav.MAV_AUTOPILOT_ARDUPILOTMEGA, mav.MAV_TYPE_GROUND_ROVER, "MAV_TYPE 10"),
    ],
)
def test_what_cannot_be_flown_is_refused(autopilot, kind, says):
    with pytest.raises(UserError, match=says):
        adapter_for(autopilot, kind)


# Modes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("adapter", "intent", "parameters", "custom_mode", "name"),
    [
        # PX4's custom_mode: main mode in bits 16 to 23, sub mode in bits 24 to 31
        (PX4, Intent.EXTERNAL, (1, 6, 0), 0x00060000, "OFFBOARD"),
        (PX4, Intent.LAND, (1, 4, 6), 0x06040000, "AUTO.LAND"),
        (PX4, Intent.HOLD, (1, 4, 3), 0x03040000, "AUTO.LOITER"),
        (ARDUPILOT, Intent.EXTERNAL, (1, 4), 4, "GUIDED"),
        (ARDUPILOT, Intent.LAND, (1, 9), 9, "LAND"),
        (ARDUPILOT, Intent.HOLD, (1, 17), 17, "BRAKE"),
        (NO_GPS, Intent.EXTERNAL, (1, 20), 20, "GUIDED_NOGPS"),
        (NO_GPS, Intent.LAND, (1, 9), 9, "LAND"),
        (NO_GPS, Intent.HOLD, (1, 2), 2, "ALT_HOLD"),
    ],
)
def test_modes(adapter, intent, parameters, custom_mode, name):
    command = adapter.mode(intent)
    assert (command.number, command.parameters) == (176, tuple(map(float, parameters)))
    assert adapter.is_mode(custom_mode, intent)
    assert adapter.mode_name(custom_mode) == name
    assert [other for other in Intent if adapter.is_mode(custom_mode, other)] == [intent]


def test_modes_nobody_knows_have_a_name():
    assert PX4.mode_name(0x00030000) == "POSCTL"
    assert "99" in PX4.mode_name(99 << 16)
    assert "99" in PX4.mode_name(4 << 16 | 99 << 24)
    assert "99" in ARDUPILOT.mode_name(99)
    assert PX4.mode_name(-1) and ARDUPILOT.mode_name(-1)


@pytest.mark.parametrize(
    ("parameters", "kind"),
    [
        ({}, ArduPilot),  # not answered: as most vehicles are
        ({"GPS1_TYPE": 1.0}, ArduPilot),
        ({"GPS1_TYPE": 0.0}, ArduPilotNoGps),
        ({"GPS_TYPE": 0.0}, ArduPilotNoGps),
        ({"GPS_TYPE": 2.0}, ArduPilot),
    ],
)
def test_without_gps_the_mode_is_guided_nogps(parameters, kind):
    for before in (ARDUPILOT, NO_GPS):
        assert type(before.suited(parameters)) is kind
    assert set(parameters) <= set(ARDUPILOT.parameters_needed())
    assert PX4.suited(parameters) is PX4


def test_without_gps_the_checks_are_the_same_and_name_the_mode():
    found = findings(NO_GPS, ARDUPILOT_GOOD)
    assert (found.pop("mode").found, found) == ("GUIDED_NOGPS", findings(ARDUPILOT, ARDUPILOT_GOOD))


@pytest.mark.parametrize(
    ("adapter", "parameters", "limit_deg"),
    [
        (ARDUPILOT, {"ANGLE_MAX": 3000.0}, 30.0),
        (ARDUPILOT, {"ATC_ANGLE_MAX": 25.0}, 25.0),
        (ARDUPILOT, {}, math.inf),
        (PX4, {}, math.inf),
    ],
)
def test_where_our_attitude_is_cut(adapter, parameters, limit_deg):
    assert adapter.tilt_limit_deg(parameters) == limit_deg


def test_arming():
    assert (ARM.number, ARM.parameters) == (400, (1.0,))
    assert (DISARM.number, DISARM.parameters) == (400, (0.0,))


# Checks -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("adapter", "good"), [(PX4, PX4_GOOD), (ARDUPILOT, ARDUPILOT_GOOD)])
@pytest.mark.parametrize("level", [ControlLevel.ATTITUDE, ControlLevel.BODY_RATE])
def test_a_vehicle_as_it_should_be(adapter, good, level):
    if level is ControlLevel.BODY_RATE:
        good = {**good, **{name: 0.5 for name in ("COM_OF_LOSS_T", "GUID_TIMEOUT") if name in good}}
    assert {f.verdict for f in findings(adapter, good, level).values()} == {Verdict.OK}
    assert set(good) <= set(adapter.parameters_needed())


@pytest.mark.parametrize(
    ("adapter", "good", "name"),
    [(PX4, PX4_GOOD, "COM_OF_LOSS_T"), (ARDUPILOT, ARDUPILOT_GOOD, "GUID_TIMEOUT")],
)
def test_rates_of_a_dead_companion_are_not_held_for_long(adapter, good, name):
    """Killed while it turns, at a vehicle that follows for 3 s: seen by the campaign, tilt 133°."""
    as_shipped = findings(adapter, {**good, name: 3.0}, ControlLevel.BODY_RATE)[name]
    assert (as_shipped.verdict, as_shipped.fix) == (Verdict.WARNING, (name, 0.5))
    assert findings(adapter, good, ControlLevel.ATTITUDE)[name].verdict is Verdict.OK


@pytest.mark.parametrize(
    ("adapter", "good", "name", "value", "verdict", "fix"),
    [
        (PX4, PX4_GOOD, "MPC_THR_HOVER", None, Verdict.WARNING, None),
        (PX4, PX4_GOOD, "MPC_THR_HOVER", 0.05, Verdict.REFUSAL, None),
        (PX4, PX4_GOOD, "MPC_THR_HOVER", 0.85, Verdict.REFUSAL, None),
        (PX4, PX4_GOOD, "COM_OF_LOSS_T", 2.5, Verdict.WARNING, 1.0),
        (PX4, PX4_GOOD, "COM_OBL_RC_ACT", -1.0, Verdict.WARNING, None),
        (PX4, PX4_GOOD, "COM_OBL_RC_ACT", 2.0, Verdict.WARNING, None),
        (PX4, PX4_GOOD, "COM_OBL_RC_ACT", 6.0, Verdict.WARNING, None),
        (PX4, PX4_GOOD, "COM_OBL_RC_ACT", 7.0, Verdict.WARNING, None),
        (PX4, PX4_GOOD, "COM_OBL_RC_ACT", 3.0, Verdict.OK, None),
        (PX4, PX4_GOOD, "COM_RC_OVERRIDE", 1.0, Verdict.WARNING, None),
        (PX4, PX4_GOOD, "EKF2_RNG_CTRL", 1.0, Verdict.WARNING, None),
        (PX4, PX4_GOOD, "COM_DISARM_PRFLT", -1.0, Verdict.WARNING, 10.0),
        (ARDUPILOT, ARDUPILOT_GOOD, "GUID_OPTIONS", None, Verdict.REFUSAL, None),
        (ARDUPILOT, ARDUPILOT_GOOD, "GUID_OPTIONS", 0.0, Verdict.REFUSAL, 8.0),
        (ARDUPILOT, ARDUPILOT_GOOD, "GUID_OPTIONS", 5.0, Verdict.REFUSAL, 13.0),
        (ARDUPILOT, ARDUPILOT_GOOD, "GUID_OPTIONS", 24.0, Verdict.OK, None),
        (ARDUPILOT, ARDUPILOT_GOOD, "ATC_ANGLE_BOOST", None, Verdict.REFUSAL, None),
        (ARDUPILOT, ARDUPILOT_GOOD, "ATC_ANGLE_BOOST", 1.0, Verdict.REFUSAL, 0.0),
        (ARDUPILOT, ARDUPILOT_GOOD, "GUID_TIMEOUT", 5.0, Verdict.WARNING, 0.5),
        (ARDUPILOT, ARDUPILOT_GOOD, "GUID_TIMEOUT", 3.0, Verdict.WARNING, 0.5),
        (ARDUPILOT, ARDUPILOT_GOOD, "GUID_TIMEOUT", 0.5, Verdict.OK, None),
        (ARDUPILOT, ARDUPILOT_GOOD, "MOT_THST_HOVER", 0.05, Verdict.REFUSAL, None),
        (ARDUPILOT, ARDUPILOT_GOOD, "MOT_THST_HOVER", 0.95, Verdict.REFUSAL, None),
    ],
)
def test_every_finding(adapter, good, name, value, verdict, fix):
    """One parameter off: that finding changes, says what to do, and no other does."""
    changed = {key: kept for key, kept in good.items() if key != name}
    if value is not None:
        changed[name] = value
    found = findings(adapter, changed)
    assert found[name].verdict is verdict
    assert {f.verdict for f in found.values() if f.subject != name} == {Verdict.OK}
    assert found[name].fix == (None if fix is None else (name, fix))
    if verdict is not Verdict.OK:
        assert found[name].why and found[name].remedy
    if fix is not None:
        mended = findings(adapter, {**changed, name: fix})
        assert name not in mended or mended[name].verdict is Verdict.OK
    if value is None:
        assert found[name].found == "not answered"


@pytest.mark.parametrize(
    ("adapter", "version", "verdict"),
    [
        (PX4, (1, 13, 0), Verdict.OK),
        (PX4, (1, 13, 3), Verdict.OK),
        (PX4, (1, 14, 0), Verdict.REFUSAL),
        (PX4, NOW, Verdict.REFUSAL),
        (ARDUPILOT, (4, 7, 0), Verdict.REFUSAL),
    ],
)
def test_actuator_controls_need_old_firmware(adapter, version, verdict):
    good = PX4_GOOD if adapter is PX4 else ARDUPILOT_GOOD
    found = findings(adapter, good, ControlLevel.ACTUATOR, version)["actuator controls"]
    assert found.verdict is verdict
    assert (found.remedy == "fly at --level body_rate") is (verdict is Verdict.REFUSAL)


def status(flags=None, prearm=None):
    found = VehicleStatus()
    found.estimator_flags, found.prearm_ok = flags, prearm
    return found


ALL_FLAGS = 1 | 2 | 4 | 8  # attitude, both velocities, relative position


@pytest.mark.parametrize(
    ("flags", "missing"),
    [
        (ALL_FLAGS, []),
        (1 | 2 | 4 | 16, []),  # an absolute position will do
        (ALL_FLAGS & ~1, ["attitude"]),
        (ALL_FLAGS & ~2, ["horizontal velocity"]),
        (ALL_FLAGS & ~4, ["vertical velocity"]),
        (ALL_FLAGS & ~8, ["horizontal position"]),
        (0, ["attitude", "horizontal velocity", "vertical velocity", "horizontal position"]),
    ],
)
def test_what_the_estimator_has_to_know(flags, missing):
    assert PX4.not_ready(status(flags)) == [f"estimator has no {what}" for what in missing]


@pytest.mark.parametrize(("prearm", "ready"), [(True, True), (False, False), (None, False)])
def test_the_prearm_bit_counts_on_ardupilot_only(prearm, ready):
    assert (ARDUPILOT.not_ready(status(ALL_FLAGS, prearm)) == []) is ready
    assert PX4.not_ready(status(ALL_FLAGS, prearm)) == []  # there it is about the mode it is in now


# Setpoints ----------------------------------------------------------------------------------------------


def setpoint(level):
    """Nose north, 0.2 rad rolled to the right (FLU and ENU), rates of 0.1, 0.2, 0.3 rad/s."""
    north, right = np.array([SQRT, 0, 0, SQRT]), np.array([math.cos(0.1), math.sin(0.1), 0.0, 0.0])
    w = north[0] * right[0]
    x, y, z = north[0] * right[1], north[3] * right[1], north[3] * right[0]
    return Setpoint(level, 12.0, np.array([w, x, y, z]), np.array([0.1, 0.2, 0.3]), np.zeros(3))


@pytest.mark.parametrize("adapter", [PX4, ARDUPILOT])
@pytest.mark.parametrize(("level", "mask"), [(ControlLevel.ATTITUDE, 7), (ControlLevel.BODY_RATE, 128)])
def test_encoded_setpoint(adapter, level, mask):
    """In NED/FRD the same attitude is roll +0.2 at heading 0; the rates are 0.1, −0.2, −0.3."""
    message = adapter.encode(setpoint(level), 12.3456, 0.4, 7)
    assert (message.target_system, message.target_component, message.type_mask) == (7, 1, mask)
    assert message.time_boot_ms == 12346
    np.testing.assert_allclose(message.q, [math.cos(0.1), math.sin(0.1), 0.0, 0.0], atol=1e-12)
    rates = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
    assert rates == pytest.approx((0.1, -0.2, -0.3))
    assert message.thrust == 0.4


def test_a_time_that_does_not_fit_goes_round():
    message = PX4.encode(setpoint(ControlLevel.ATTITUDE), 2.0**32 * 1e-3 + 1.0, 0.4, 1)
    assert message.time_boot_ms == 1000
    decoded([bytes(message.pack(mav.MAVLink(None)))])


def test_encoded_actuators():
    """FLU roll right, nose down, turn left: FRD +, −, −; the other four controls are zero."""
    message = PX4.encode_actuators(1.5, np.array([0.1, 0.2, 0.3, 0.4]), 7)
    assert message.time_usec == 1_500_000
    assert (message.group_mlx, message.target_system, message.target_component) == (0, 7, 1)
    assert message.controls == pytest.approx([0.1, -0.2, -0.3, 0.4, 0, 0, 0, 0])
    with pytest.raises(NotImplementedError, match="ArduPilot takes no actuator controls"):
        ARDUPILOT.encode_actuators(1.5, np.zeros(4), 7)


@pytest.mark.parametrize("adapter", [Px4(), ArduPilot()])
def test_a_reference_goes_out_as_position_velocity_acceleration_and_yaw(adapter):
    """ENU (1, 2, 3) is NED (2, 1, -3); a yaw of 0 (east) is a heading of 90 degrees; yaw rate is not said."""
    vectors = (np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]), np.array([0.01, 0.02, 0.03]))
    reference = Reference(*vectors, np.zeros(3), np.zeros(3), 0.0, 0.0, 0.0)
    message = adapter.encode_reference(reference, 12.5, 7)
    assert message.target_system == 7 and message.time_boot_ms == 12500
    assert message.coordinate_frame == mav.MAV_FRAME_LOCAL_NED
    assert message.type_mask == 2048
    assert (message.x, message.y, message.z) == pytest.approx((2.0, 1.0, -3.0))
    assert (message.vx, message.vy, message.vz) == pytest.approx((0.2, 0.1, -0.3))
    assert (message.afx, message.afy, message.afz) == pytest.approx((0.02, 0.01, -0.03))
    assert message.yaw == pytest.approx(math.pi / 2.0)
