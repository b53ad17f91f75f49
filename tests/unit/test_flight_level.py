"""Level flight before the law takes over: signs and sizes worked out by hand, FLU."""

import math

import numpy as np
import pytest

from companion.control.structs import ControlLevel, VehicleState
from companion.flight.level_flight import level_setpoint

INERTIA = np.array([0.03, 0.03, 0.04])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
FAST = np.full(3, 10.0)


def state(axis=(0.0, 0.0, 1.0), angle=0.0, rate=(0.0, 0.0, 0.0)):
    q = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * np.array(axis))])
    return VehicleState(0.0, np.zeros(3), np.zeros(3), q, np.array(rate))


@pytest.mark.parametrize(("axis", "gain"), [(0, 5.0), (1, 5.0), (2, 2.0)])
def test_turns_back_about_the_axis_it_is_off(axis, gain):
    """0.1 rad too far about an axis: −0.1·gain rad/s about it, and a torque of that sign; 2 sin(θ/2) ≈ θ."""
    unit = np.eye(3)[axis]
    s = level_setpoint(ControlLevel.BODY_RATE, state(unit, 0.1), LEVEL, 15.0, INERTIA, FAST)
    assert s.body_rate_flu == pytest.approx(-0.1 * gain * unit, abs=1e-3)
    assert s.torque_flu == pytest.approx(10.0 * INERTIA[axis] * -0.1 * gain * unit, abs=1e-3)
    assert s.level is ControlLevel.BODY_RATE
    assert s.thrust_newton == 15.0


def test_damps_rotation_and_takes_the_short_way():
    s = level_setpoint(ControlLevel.ACTUATOR, state(rate=(0.2, -0.1, 0.3)), -LEVEL, 15.0, INERTIA, FAST)
    assert s.body_rate_flu == pytest.approx(np.zeros(3), abs=1e-12)
    assert s.torque_flu == pytest.approx(-10.0 * INERTIA * [0.2, -0.1, 0.3])


def test_asks_for_no_torque_without_thrust():
    s = level_setpoint(ControlLevel.ACTUATOR, state((1.0, 0.0, 0.0), 0.3), LEVEL, 0.0, INERTIA, FAST)
    assert not s.torque_flu.any()


def test_asks_for_no_rate_beyond_what_the_vehicle_may_turn_at():
    """1 rad off about x asks for 2·sin(0.5)·5 = 4.8 rad/s, of which 2 are allowed."""
    s = level_setpoint(
        ControlLevel.BODY_RATE, state((1.0, 0.0, 0.0), 1.0), LEVEL, 15.0, INERTIA, np.full(3, 2.0)
    )
    assert s.body_rate_flu == pytest.approx([-2.0, 0.0, 0.0])
