"""What the autopilots' parameters tell of a vehicle; numbers worked out by hand, and where each is from."""

import math

import pytest

from companion.autopilot.ardupilot import ArduPilot
from companion.autopilot.px4 import Px4
from companion.config.provenance import provenance, tables_of
from companion.config.settings import load_settings, resolved

PX4 = {
    "MPC_THR_HOVER": 0.43, "MPC_TILTMAX_AIR": 25.0, "MC_ROLL_P": 6.5, "MC_PITCH_P": 3.25, "MC_YAW_P": 2.8,
    "MC_ROLLRATE_MAX": 110.0, "MC_PITCHRATE_MAX": 300.0, "MC_YAWRATE_MAX": 80.0, "CA_ROTOR_COUNT": 6.0,
}  # fmt: skip
ARDUPILOT = {
    "MOT_THST_HOVER": 0.3, "FRAME_CLASS": 3.0, "ATC_ANG_RLL_P": 9.0, "ATC_ANG_PIT_P": 4.5, "ATC_ANG_YAW_P": 4.5,
    "ATC_INPUT_TC": 0.3, "ATC_RATE_FF_ENAB": 1.0, "ATC_RATE_R_MAX": 0.0, "ANGLE_MAX": 2000.0,
}  # fmt: skip


def told(adapter, parameters, vehicle_type=2):
    return {item.key: item for item in adapter.tells(parameters, vehicle_type)}


def test_px4():
    """The slower of roll and pitch counts: half the gain that was seen with 0.07 s of dead time and ω 12 rad/s.

    In all 0.2367 + 0.66 (1/3.25 − 1/6.5) = 0.3382 s, 0.08 of it dead time.
    """
    known = told(Px4(), PX4)
    assert known["hover_thrust"].value == 0.43 and len(known["rotors.layout"].value) == 6
    assert known["limits.tilt_max_deg"].value == 25.0
    assert known["limits.body_rate_max_deg_s"].value == [110.0, 220.0, 80.0]
    assert known["responses.px4.tilt.natural_frequency_rad_s"].value == pytest.approx(2.0 / 0.2582, rel=1e-3)
    assert known["responses.px4.dead_time_s"].value == pytest.approx(0.08)
    assert "MC_PITCH_P 3.25" in known["responses.px4.dead_time_s"].source


def test_ardupilot():
    """Shaping twice as slow as stock, which was seen with 0.16 s; ANGLE_MAX in hundredths of a degree."""
    known = told(ArduPilot(), ARDUPILOT)
    assert known["hover_thrust"].value == 0.3 and len(known["rotors.layout"].value) == 8
    assert known["limits.tilt_max_deg"].value == 20.0
    assert known["limits.body_rate_max_deg_s"].value == [220.0, 220.0, 120.0]
    natural = known["responses.ardupilot.tilt.natural_frequency_rad_s"].value
    assert 2.0 * 0.97 / natural == pytest.approx(0.32, rel=1e-3)


@pytest.mark.parametrize(
    "limits",
    [
        {"ATC_ACCEL_R_MAX": 1000.0, "ATC_ACCEL_P_MAX": 0.0},  # until 4.6, centidegrees
        {"ATC_ACC_R_MAX": 10.0, "ATC_ACC_P_MAX": 0.0, "ATC_ACCEL_P_MAX": 1.0},  # from 4.7 on
    ],
)
def test_ardupilots_acceleration_by_either_name(limits):
    """10°/s²: a tilt of 10° takes 2 √(10 / 10) = 2 s and lags by 1 s."""
    natural = told(ArduPilot(), ARDUPILOT | limits)["responses.ardupilot.tilt.natural_frequency_rad_s"].value
    assert 2.0 * 0.97 / natural == pytest.approx(1.0, rel=1e-3)


def test_without_feed_forward_the_angle_loop_lags_too():
    natural = told(ArduPilot(), ARDUPILOT | {"ATC_RATE_FF_ENAB": 0.0})[
        "responses.ardupilot.tilt.natural_frequency_rad_s"
    ].value
    assert 2.0 * 0.97 / natural == pytest.approx(0.32 + 1.0 / 4.5, rel=1e-3)


@pytest.mark.parametrize("adapter", [Px4(), ArduPilot()])
def test_nothing_told_is_stock_and_said(adapter):
    known = told(adapter, {}, vehicle_type=13)
    assert "hover_thrust" not in known and len(known["rotors.layout"].value) == 6
    response = f"responses.{adapter.profile_key}.tilt.natural_frequency_rad_s"
    assert "not on this vehicle" in known[response].source


def test_what_is_written_goes_before_what_is_told_and_each_says_where_it_is_from():
    settings = load_settings(None, {}, ["profile.mass_kg=2.5", "profile.limits.tilt_max_deg=15"])
    assert settings.given is not None
    known = Px4().tells(PX4, 2)
    settings = resolved(settings.flight, settings.given, settings.overrides, tables_of(known), "px4")
    profile = settings.profile
    assert profile.mass_kg == 2.5 and profile.limits.tilt_max_deg == 15.0
    assert profile.hover_thrust == 0.43 and profile.lag_margin == 1.2
    assert profile.rotors.thrust_max_newton == pytest.approx(2.5 * 9.81 / 6 / 0.43)
    # lag 0.3382 s with a margin of 1.2; the common gains were found at 0.2367 s with K_e 4
    assert settings.gains.position_loop.K_e[0] == pytest.approx(4 * 0.2367 / (1.2 * 0.3382), rel=2e-3)
    rows = {row.key: row for row in provenance(settings, known, "px4")}
    assert rows["mass_kg"].source == "--set" and rows["mass_ratio"].source == "default"
    assert rows["hover_thrust"].source == "MPC_THR_HOVER 0.43"
    assert "0.406 s" in rows["gains.position_loop"].source
    assert math.isclose(rows["responses.px4.dead_time_s"].value, 0.08)
