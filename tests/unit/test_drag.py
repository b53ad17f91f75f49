"""Horizontal drag from tilt and speed: found where the vehicle moved, as usual where it did not, and how it is flown."""

import math

import numpy as np
import pytest

from companion.autopilot.drag import SPREAD_1_S, USUAL_1_S, DragMeter
from companion.control.structs import Reference

G = 9.81


def flown(drag, speed=0.6, wind=0.0, noise=0.0, tilt_off=0.0, seconds=20.0):
    """A meter that saw v = speed·sin(1.3 t) along east and the tilt that this takes: tan θ = (v̇ + d (v − wind)) / g."""
    meter, draw = DragMeter(), np.random.default_rng(1)
    for k in range(int(seconds / 0.01)):
        t = 0.01 * k
        v, a = speed * math.sin(1.3 * t), 1.3 * speed * math.cos(1.3 * t)
        half = 0.5 * (math.atan((a + drag * (v - wind)) / G) + tilt_off)
        velocity = np.array([v, 0.0, 0.0]) + noise * draw.standard_normal(3)
        meter.update(t, velocity, np.array([math.cos(half), 0.0, math.sin(half), 0.0]))
    return meter


@pytest.mark.parametrize("drag", [0.0, 0.25, 0.6])
@pytest.mark.parametrize("wind, tilt_off", [(0.0, 0.0), (3.0, math.radians(1.0))])
def test_drag_is_found_whatever_pushes_steadily(drag, wind, tilt_off):
    found, deviation = flown(drag, wind=wind, tilt_off=tilt_off).measured()
    assert found == pytest.approx(drag, abs=0.04) and deviation < 0.04


def test_through_an_estimators_noise():
    """2 cm/s: differences over 0.2 s are off by 0.14 m/s²."""
    meter = flown(0.4, noise=0.02, seconds=30.0)
    assert meter.measured()[0] == pytest.approx(0.4, abs=0.08)
    assert meter.drag_1_s == pytest.approx(0.4, abs=0.1)


def test_without_motion_it_is_what_is_usual():
    found, deviation = flown(0.6, speed=0.0).measured()
    assert found == pytest.approx(USUAL_1_S) and deviation == pytest.approx(SPREAD_1_S)


def test_untrusted_states_do_not_count():
    meter = DragMeter()
    for k in range(1000):
        meter.update(0.01 * k, np.array([0.5, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), trusted=False)
    assert meter.measured() == (USUAL_1_S, SPREAD_1_S)


def test_the_reference_that_thrust_has_to_follow():
    """p̈ + d ṗ and its derivatives, horizontally; position, velocity and heading are what they were."""
    meter = DragMeter()
    meter.drag_1_s = 0.5
    vectors = [np.array([1.0, 2.0, 3.0]) * k for k in range(1, 6)]
    given = Reference(*vectors, 0.3, 0.2, 0.1)
    asked = meter.with_drag(given)
    assert asked.acceleration_enu.tolist() == [3.0 + 1.0, 6.0 + 2.0, 9.0]
    assert asked.jerk_enu.tolist() == [4.0 + 1.5, 8.0 + 3.0, 12.0]
    assert asked.snap_enu.tolist() == [5.0 + 2.0, 10.0 + 4.0, 15.0]
    assert asked.position_enu is given.position_enu and asked.velocity_enu is given.velocity_enu
    assert (asked.yaw_rad, asked.yaw_rate_rad_s, asked.yaw_acceleration_rad_s2) == (0.3, 0.2, 0.1)
