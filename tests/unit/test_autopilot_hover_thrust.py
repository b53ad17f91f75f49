"""The hover-thrust estimator against a vertical plant written here: m v̇ = k u_lagged(t − dead) − m g."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.autopilot.hover_thrust import FURTHEST, TRUST, HoverThrustEstimator

DT = 0.01


def fly(
    estimator, true_hover, seconds, *, dead_s=0.06, lag=15.0, noise=0.02, trusted=True, seed=1, sine=0.05
):
    """Fly a plant that hovers at `true_hover` with a gentle up and down; returns the estimates."""
    random = np.random.default_rng(seed)
    sent: list[float] = []
    velocity, rotor = 0.0, true_hover
    out = []
    for k in range(round(seconds / DT)):
        time_s = k * DT
        setpoint = true_hover * (1.0 - 0.3 * velocity) + sine * true_hover * math.sin(2.0 * time_s)
        sent.append(setpoint)
        estimator.sent(time_s, setpoint)
        acting = sent[max(0, k - round(dead_s / DT))]
        rotor += (1.0 - math.exp(-lag * DT)) * (acting - rotor)
        velocity += DT * (9.81 * rotor / true_hover - 9.81)
        estimator.update(time_s, velocity + random.normal(0.0, noise), 1.0, trusted)
        out.append(estimator.hover_thrust)
    return out


@pytest.mark.parametrize("wrong_by", [0.8, 0.9, 1.0, 1.1, 1.25])
def test_finds_the_hover_thrust_within_3_percent_in_5_s(wrong_by):
    true = 0.366
    estimates = fly(HoverThrustEstimator(true * wrong_by, 0.06, 15.0), true, 8.0)
    assert abs(estimates[round(5.0 / DT)] / true - 1.0) < 0.03
    assert abs(estimates[-1] / true - 1.0) < 0.03


def test_stands_still_where_it_may_not_learn():
    estimator = HoverThrustEstimator(0.5, 0.06, 15.0)
    assert set(fly(estimator, 0.3, 5.0, trusted=False)) == {0.5}


def test_does_not_believe_a_kick():
    """A collision: 8 m/s² for 50 ms is no change of hover thrust."""
    estimator = HoverThrustEstimator(0.4, 0.0, 15.0)
    fly(estimator, 0.4, 6.0, dead_s=0.0)
    before = estimator.hover_thrust
    for k in range(25):
        estimator.sent(6.0 + k * DT, 0.4)
        estimator.update(6.0 + k * DT, 4.0 if k > 10 else 0.0, 1.0, True)
    assert estimator.hover_thrust == pytest.approx(before, rel=0.01)


@settings(max_examples=50, deadline=None)
@given(
    first=st.floats(0.15, 0.7),
    velocities=st.lists(st.floats(-50.0, 50.0), min_size=30, max_size=200),
    thrust=st.floats(0.0, 1.0),
)
def test_never_leaves_its_bounds(first, velocities, thrust):
    estimator = HoverThrustEstimator(first, 0.05, 15.0)
    for k, velocity in enumerate(velocities):
        estimator.sent(k * DT, thrust)
        estimator.update(k * DT, velocity, 1.0, True)
        assert first / TRUST * 0.999 <= estimator.hover_thrust <= first * TRUST * 1.001
        assert math.isfinite(estimator.deviation)


@pytest.mark.parametrize("wrong_by", [0.8, 1.0, 1.25])
@pytest.mark.parametrize("true", [0.25, 0.5])
def test_a_lift_off_tells_the_hover_thrust(true, wrong_by):
    estimator = HoverThrustEstimator(true * wrong_by, 0.07, 15.0)
    slope = 0.5 * true * wrong_by  # of the thrust setpoint, 1/s
    sent: list[float] = []
    velocity = height = rotor = 0.0
    while height < 0.08:  # stands until the rotors carry it
        sent.append(0.3 * true + slope * DT * len(sent))
        acting = sent[max(0, len(sent) - 1 - 7)]
        rotor += (1.0 - math.exp(-15.0 * DT)) * (acting - rotor)
        velocity = max(0.0, velocity + DT * 9.81 * (rotor / true - 1.0))
        height += DT * velocity
    assert sent[-1] > 1.2 * true  # the thrust is far beyond balance by then
    estimator.lifted_off(sent[-1], slope, velocity)
    assert estimator.hover_thrust == pytest.approx(true, rel=0.04)


@given(st.floats(0.0, 1.0), st.floats(0.0, 2.0), st.floats(-5.0, 50.0))
def test_no_lift_off_leaves_the_bounds(thrust, slope, velocity):
    estimator = HoverThrustEstimator(0.4, 0.07, 15.0)
    estimator.lifted_off(thrust, slope, velocity)
    assert 0.4 / FURTHEST <= estimator.hover_thrust <= 0.4 * FURTHEST


def test_a_false_lift_off_does_not_hold_the_estimate():
    """A deck that rises: 0.24 is read off it and confirmed while it carries the rest; true is 0.366, the parameter 0.3.

    Within 5 s of flight the estimate is back, by no more than a tenth a second until the readings agree with it. Before
    they were outside the gate for 10 s, then moved the scale by half in one step.
    """
    true, estimator, random = 0.366, HoverThrustEstimator(0.3, 0.07, 15.0), np.random.default_rng(1)
    estimator.lifted_off(0.24, 0.15, 0.26)
    assert estimator.hover_thrust < 0.22
    sent, rotor, velocity, error, held = [], 0.24, 0.0, 0.0, 0.0
    for k in range(1200):
        time_s = k * DT
        if k < 600:
            setpoint = estimator.hover_thrust
        else:
            held += 0.5 * DT * error
            setpoint = true - 0.3 * velocity + held
        sent.append(setpoint)
        estimator.sent(time_s, setpoint)
        rotor += (1.0 - math.exp(-15.0 * DT)) * (sent[max(0, k - 7)] - rotor)
        if k < 600:
            velocity = 0.08 * math.cos(2.0 * math.pi * time_s / 8.0)
        else:
            velocity += DT * 9.81 * (rotor / true - 1.0)
            error -= DT * velocity
        estimator.update(time_s, velocity + random.normal(0.0, 0.02), 1.0, True)
        if k == 599:
            assert estimator.hover_thrust == pytest.approx(0.23, abs=0.02)
    assert estimator.hover_thrust == pytest.approx(true, rel=0.03)


def test_idling_for_ten_minutes_leaves_nothing_to_catch_up_with():
    estimator = HoverThrustEstimator(0.366, 0.07, 15.0)
    for k in range(60000):
        estimator.sent(k * DT, 0.0)
    assert len(estimator._pending) <= 256
    estimates = fly_on_from(estimator, 600.0)
    assert estimates == pytest.approx(0.366, rel=0.02)


def fly_on_from(estimator, start_s):
    """Hover for 4 s at the true hover thrust 0.366 after idling; the estimate then."""
    for k in range(400):
        estimator.sent(start_s + k * DT, 0.366)
        estimator.update(start_s + k * DT, 0.0, 1.0, k > 50)
    return estimator.hover_thrust


@pytest.mark.parametrize("told", [0.185, 0.37, 0.74], ids=["half", "true", "twice"])
def test_a_told_value_wrong_by_a_factor_of_two_is_found_at_lift_off(told: float) -> None:
    """True hover 0.37; 0.25 s beyond the balance a rise of s per second gives v = g/h s τ²/2, thrust h + s (lag + τ)."""
    hover, dead_s, lag_rad_s, tau_s = 0.37, 0.02, 20.0, 0.25
    slope = 0.5 * told
    thrust = hover + slope * (dead_s + 1.0 / lag_rad_s + tau_s)
    speed_m_s = 9.81 / hover * slope * tau_s**2 / 2.0
    estimator = HoverThrustEstimator(told, dead_s, lag_rad_s)
    estimator.lifted_off(thrust, slope, speed_m_s)
    assert estimator.hover_thrust == pytest.approx(hover, rel=0.06)


def test_a_lift_off_that_tells_something_absurd_is_believed_within_bounds() -> None:
    estimator = HoverThrustEstimator(0.5, 0.02, 20.0)
    estimator.lifted_off(0.06, 0.25, 0.0)
    assert estimator.hover_thrust >= 0.5 / 2.5


@pytest.mark.parametrize("true", [0.20, 0.37, 0.75])
def test_what_the_autopilot_hovers_with_is_believed_however_wrong_the_parameter(true):
    estimator = HoverThrustEstimator(0.37, 0.02, 20.0)
    estimator.hovered(true)
    assert estimator.hover_thrust == pytest.approx(true, rel=0.01)
