"""Engaging in the air: each reason against it in words, and what is sent before it: the vehicle as it hovers."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from companion.autopilot.adapter import Intent, VehicleStatus
from companion.autopilot.px4 import Px4
from companion.config.procedure import Procedure
from companion.config.settings import load_settings
from companion.control.prediction import Predictor
from companion.control.structs import ControlLevel, Setpoint, VehicleState
from companion.flight.control_loop import Activity
from companion.flight.engagement import Engagement
from companion.mavlink.link import mav

HOVER_THRUST = 0.42
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
IN_AIR = mav.MAV_LANDED_STATE_IN_AIR


def state(time_s=10.0, velocity=(0.0, 0.0, 0.0), quaternion=LEVEL):
    still = np.zeros(3)
    return VehicleState(time_s, np.array([1.0, 2.0, 3.0]), np.array(velocity, float), quaternion, still)


def rolled(degrees):
    half = math.radians(degrees) / 2.0
    return np.array([math.cos(half), math.sin(half), 0.0, 0.0])


def hovering(**changes):
    """An engagement of a vehicle that hovers well, but for `changes`."""
    status = VehicleStatus()
    status.armed, status.landed_state = True, changes.get("landed_state", IN_AIR)
    status.armed = changes.get("armed", True)
    status.custom_mode = changes.get("custom_mode", 3 << 16)  # POSCTL
    status.estimator_flags = changes.get("estimator_flags", 0x3FF)
    status.prearm_ok = True
    vehicle = SimpleNamespace(
        status=status,
        adapter=Px4(),
        state=changes.get("state", state()),
        on_ground=changes.get("on_ground", False),
        link=SimpleNamespace(autopilot_time_s=changes.get("now_s", 10.0)),
        assembler=SimpleNamespace(position_time_s=10.0),
    )
    loop = SimpleNamespace(activity=Activity.NOTHING, sent=[], on_state=lambda _: None)
    loop.hover = lambda quaternion, thrust: loop.sent.append((quaternion, thrust))
    engagement = Engagement(vehicle, loop, Procedure())
    if changes.get("thrust_told", True):
        vehicle.link.autopilot_time_s = 10.0
        engagement.take(thrust_in_use(HOVER_THRUST))
        vehicle.link.autopilot_time_s = changes.get("now_s", 10.0)
    return engagement, vehicle, loop


def thrust_in_use(thrust):
    return mav.MAVLink_attitude_target_message(0, 0, [1, 0, 0, 0], 0, 0, 0, thrust)


def land_mode():
    return int(Px4().mode(Intent.LAND).parameters[1]) << 16 | int(Px4().mode(Intent.LAND).parameters[2]) << 24


def test_nothing_stands_against_a_vehicle_that_hovers():
    assert hovering()[0].why_not() == []


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"armed": False}, "the vehicle is disarmed"),
        ({"on_ground": None}, "the autopilot does not say whether the vehicle flies (EXTENDED_SYS_STATE)"),
        ({"on_ground": True}, "the vehicle stands on the ground with its motors running"),
        ({"landed_state": mav.MAV_LANDED_STATE_LANDING}, "the vehicle is landing"),
        ({"custom_mode": land_mode()}, "the vehicle is landing"),
        ({"landed_state": mav.MAV_LANDED_STATE_TAKEOFF}, "the vehicle is taking off"),
        ({"state": None}, "no estimate of the position"),
        ({"now_s": 10.7}, "the position is 0.7 s old"),
        (
            {"thrust_told": False},
            "the autopilot does not tell the thrust it hovers with (ATTITUDE_TARGET)",
        ),
        ({"state": state(velocity=(3.0, 1.0, 0.0))}, "speed 3.2 m/s, limit 3 m/s"),
        ({"state": state(velocity=(math.nan, 0.0, 0.0))}, "speed nan m/s, limit 3 m/s"),
        ({"state": state(velocity=(0.0, 0.0, -0.5))}, "it descends at 0.5 m/s, limit 0.3 m/s"),
        ({"state": state(quaternion=rolled(25.0))}, "tilt 25°, limit 20°"),
    ],
)
def test_each_reason_against_it_is_said(changes, says):
    assert says in hovering(**changes)[0].why_not()


def test_a_bad_estimate_stands_against_it_in_the_autopilots_words():
    flags = mav.ESTIMATOR_ATTITUDE  # nothing of velocity and position
    reasons = hovering(estimator_flags=flags)[0].why_not()
    assert reasons and all("estimat" in reason or "position" in reason for reason in reasons)


def test_what_is_sent_before_is_the_vehicle_as_it_hovers():
    engagement, _, loop = hovering()
    leaning = rolled(5.0)
    engagement.on_state(state(quaternion=leaning))
    engagement.prove()
    quaternion, thrust = loop.sent[-1]
    np.testing.assert_allclose(quaternion, leaning, atol=1e-9)
    assert thrust == pytest.approx(HOVER_THRUST)


def test_the_thrust_is_a_mean_over_a_second():
    engagement, vehicle, _ = hovering()
    vehicle.link.autopilot_time_s = 10.02
    engagement.take(thrust_in_use(0.52))
    assert engagement.thrust == pytest.approx(HOVER_THRUST + 0.1 * (1.0 - math.exp(-0.02)))
    engagement.take(thrust_in_use(0.0))  # no thrust in use tells nothing
    engagement.take(thrust_in_use(math.nan))
    assert engagement.thrust == pytest.approx(HOVER_THRUST + 0.1 * (1.0 - math.exp(-0.02)))


def home(latitude, longitude, altitude_mm, x, y, z):
    return mav.MAVLink_home_position_message(latitude, longitude, altitude_mm, x, y, z, [1, 0, 0, 0], 0, 0, 0)


def test_home_is_taken_by_its_place_on_the_globe_where_there_is_an_origin():
    """ArduPilot leaves x, y and z at 0. 1e-5 ° of latitude is 1.112 m of a sphere of 6371 km."""
    engagement, vehicle, _ = hovering()
    engagement.take(home(0, 0, 0, 7.0, 8.0, -9.0))
    np.testing.assert_allclose(engagement.home_enu, [8.0, 7.0, 9.0])
    vehicle.status.global_origin = (47.0, 8.0, 500.0)
    engagement.take(home(470000100, 80000000, 501500, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(engagement.home_enu, [0.0, 1.11195, 1.5], atol=1e-4)


def test_the_prediction_begins_with_what_the_thrust_carries():
    """At 5° of roll the thrust of 20 N carries 20 cos 5° / 9.81 kg."""
    predictor = Predictor(load_settings("qball2", {}, []).profile, ControlLevel.ATTITUDE)
    still = np.zeros(3)
    for step in range(50):
        predictor.sent(step * 0.01, Setpoint(ControlLevel.ATTITUDE, 5.0, LEVEL, still, still))
    predictor.hovering(10.0, rolled(5.0), 20.0)
    assert predictor.mass_kg == pytest.approx(20.0 * math.cos(math.radians(5.0)) / 9.81, rel=1e-9)
    before = state(10.0, quaternion=rolled(5.0))
    after = predictor.predict(before)
    assert after.velocity_enu[2] == pytest.approx(0.0, abs=1e-3)
    assert after.velocity_enu[1] < 0.0  # rolled right, seen from an east heading: to the south
