"""The ground: rest is exact, landings settle without bouncing or sinking, take-off is clean, friction holds and slips."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl_stub.physics.rigid_body import advance
from sitl_stub.physics.vehicle import (
    AT_REST,
    BODY_RATE_FRD,
    EXTERNAL_FORCE_NED,
    GROUND_DOWN,
    IMPACT_SPEED,
    POSITION_NED,
    QUATERNION_WXYZ,
    RIGID,
    SPECIFIC_FORCE_FRD,
    TOUCHING,
    VELOCITY_NED,
    calm_environment,
    initial_state,
    load_vehicle,
)

NAMES = ["qball2", "px4_sih", "arducopter"]


def standing(name="qball2", position=(0.0, 0.0, 0.0), yaw=0.0, **changes):
    vehicle = load_vehicle(name, **changes)
    return vehicle, initial_state(vehicle, position, yaw), vehicle.packed(), calm_environment(vehicle)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("throttle", [0.0, 0.6])
def test_at_rest_it_stays_exactly_where_it_is(name, throttle):
    """Throttle is a share of the hover command; uneven by a few per cent, as a rate loop on the ground is."""
    vehicle, state, p, environment = standing(name, yaw=0.7)
    command = throttle * vehicle.hover_command * np.array([1.0, 1.03, 0.98, 1.01])
    advance(state, command, p, environment, 1e-3, 1000)
    before = state[RIGID].copy()
    advance(state, command, p, environment, 1e-3, 20000)
    np.testing.assert_array_equal(state[RIGID], before)
    assert abs(state[2]) < 1e-5
    assert (state[VELOCITY_NED] == 0).all() and (state[BODY_RATE_FRD] == 0).all()
    np.testing.assert_allclose(state[SPECIFIC_FORCE_FRD], [0, 0, -vehicle.gravity_m_s2], atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(
    name=st.sampled_from(NAMES),
    tilt=st.tuples(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15)),
    velocity=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0, 1.5)),
    yaw=st.floats(-3, 3),
)
def test_a_landing_neither_bounces_nor_sinks_and_settles_on_its_feet(name, tilt, velocity, yaw):
    vehicle, state, p, environment = standing(name, (0.0, 0.0, -0.08), yaw)
    _tilt(state, tilt)
    state[VELOCITY_NED] = velocity
    energy = _energy(vehicle, state)
    for _ in range(2500):
        advance(state, np.zeros(4), p, environment, 1e-3, 1)
        assert _lowest_corner_height(state, p, environment) > -1e-9  # no corner is ever below the ground
        before, energy = energy, _energy(vehicle, state)
        assert energy < before + 1e-3  # joule: the ground gives nothing back
    assert state[AT_REST] == 1.0
    assert (state[VELOCITY_NED] == 0.0).all() and (state[BODY_RATE_FRD] == 0.0).all()
    assert abs(state[2]) < 1e-12
    assert (state[QUATERNION_WXYZ][1:3] == 0.0).all()  # level
    heading = 2 * math.atan2(state[QUATERNION_WXYZ][3], state[QUATERNION_WXYZ][0])
    assert abs(math.remainder(heading - yaw, 2 * math.pi)) < 0.2


@settings(max_examples=15, deadline=None)
@given(
    name=st.sampled_from(NAMES),
    tilt=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    rate=st.tuples(*[st.floats(-5, 5)] * 3),
    speed=st.floats(0, 5),
)
def test_however_it_crashes_it_stays_above_the_ground_and_comes_to_rest(name, tilt, rate, speed):
    _vehicle, state, p, environment = standing(name, (0.0, 0.0, -1.0))
    _tilt(state, tilt)
    state[BODY_RATE_FRD] = rate
    state[VELOCITY_NED] = speed, -speed, speed
    for _ in range(100):
        advance(state, np.zeros(4), p, environment, 1e-3, 100)
        assert _lowest_corner_height(state, p, environment) > -1e-9
    assert state[AT_REST] == 1.0


def _tilt(state, tilt):
    w, z = state[QUATERNION_WXYZ][0], state[QUATERNION_WXYZ][3]
    a, b = tilt[0] / 2, tilt[1] / 2
    state[QUATERNION_WXYZ] = [w, w * a - z * b, w * b + z * a, z]
    state[QUATERNION_WXYZ] /= np.linalg.norm(state[QUATERNION_WXYZ])


def _energy(vehicle, state):
    rate, velocity = state[BODY_RATE_FRD], state[VELOCITY_NED]
    kinetic = vehicle.mass_kg * velocity @ velocity + vehicle.inertia_kg_m2 @ rate**2
    return 0.5 * kinetic - vehicle.mass_kg * vehicle.gravity_m_s2 * state[2]


def _lowest_corner_height(state, p, environment):
    corners = p[-24:].reshape(8, 3)
    w, x, y, z = state[QUATERNION_WXYZ]
    down = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    return (environment[GROUND_DOWN] - state[2] - corners @ down).min()


def test_a_flat_drop_stops_dead_and_the_impact_is_told():
    _vehicle, state, p, environment = standing("px4_sih", (0.0, 0.0, -0.5))
    advance(state, np.zeros(4), p, environment, 1e-3, 1000)
    assert state[AT_REST] == 1.0
    assert state[POSITION_NED] == pytest.approx([0, 0, 0], abs=1e-5)
    assert state[IMPACT_SPEED] == pytest.approx(math.sqrt(2 * 9.80665 * 0.5), rel=0.02)


@pytest.mark.parametrize("name", NAMES)
def test_it_leaves_the_ground_when_thrust_passes_weight_and_not_before(name):
    vehicle, state, p, environment = standing(name, ground_effect=0.0)
    command = np.full(4, vehicle.hover_command * 0.999)
    advance(state, command, p, environment, 1e-3, 5000)
    assert abs(state[2]) < 1e-5 and state[AT_REST] == 1.0
    command = np.full(4, vehicle.hover_command * 1.01)
    advance(state, command, p, environment, 1e-3, 2000)
    assert state[2] < -0.01 and state[AT_REST] == 0.0 and state[TOUCHING] == 0
    # straight up: nothing but the vertical has moved
    np.testing.assert_allclose(state[RIGID][[0, 1, 3, 4]], 0.0, atol=1e-7)
    np.testing.assert_allclose(state[QUATERNION_WXYZ], [1, 0, 0, 0], atol=1e-8)


def test_a_slow_thrust_ramp_takes_off_at_hover_thrust():
    vehicle, state, p, environment = standing("px4_sih")
    for throttle in np.arange(0.0, 0.6, 0.0001):
        advance(state, np.full(4, throttle), p, environment, 1e-3, 10)
        if state[AT_REST] == 0.0 and state[2] < -1e-3:
            break
    # 1 mm of climb at this ramp of 0.01 per second takes place within 0.01 of hover thrust
    assert vehicle.hover_command < throttle < vehicle.hover_command + 0.01


def test_friction_holds_a_push_below_its_limit_and_gives_way_above():
    _vehicle, state, p, environment = standing("qball2", yaw=0.4)
    weight = 1.79 * 9.81
    advance(state, np.zeros(4), p, environment, 1e-3, 100)
    environment[EXTERNAL_FORCE_NED] = 0.0, 0.69 * weight, 0.0
    advance(state, np.zeros(4), p, environment, 1e-3, 2000)
    assert state[1] == 0.0
    environment[EXTERNAL_FORCE_NED] = 0.0, 0.72 * weight, 0.0
    advance(state, np.zeros(4), p, environment, 1e-3, 1000)
    # Coulomb: it slides with (0.72 − 0.70) g; the push through the centre of mass rocks it a little
    assert state[4] == pytest.approx(0.02 * 9.81, rel=0.1)
    assert abs(state[0]) < 1e-3
    environment[EXTERNAL_FORCE_NED] = 0.0
    advance(state, np.zeros(4), p, environment, 1e-3, 1000)
    assert state[AT_REST] == 1.0


def test_one_sided_thrust_on_the_ground_tips_it_over_and_it_comes_to_rest():
    _vehicle, state, p, environment = standing("px4_sih")
    for _ in range(1000):
        advance(state, np.array([0.7, 0.0, 0.0, 0.7]), p, environment, 1e-3, 1)
        if 1 - 2 * (state[7] ** 2 + state[8] ** 2) < 0.2:
            break
    assert state[7] < -0.5  # lift on the right: rolled to the left
    advance(state, np.zeros(4), p, environment, 1e-3, 8000)
    assert state[AT_REST] == 1.0
    assert _lowest_corner_height(state, p, environment) > -1e-6
    assert np.isfinite(state[RIGID]).all()


def test_the_ground_may_lie_elsewhere():
    _vehicle, state, p, environment = standing("qball2", (3.0, -2.0, -8.0))
    environment[GROUND_DOWN] = -5.0
    advance(state, np.zeros(4), p, environment, 1e-3, 3000)
    assert state[2] == pytest.approx(-5.25, abs=1e-4)
    assert state[AT_REST] == 1.0


def test_rest_ends_when_the_ground_goes_away():
    _vehicle, state, p, environment = standing("px4_sih")
    advance(state, np.zeros(4), p, environment, 1e-3, 10)
    assert state[AT_REST] == 1.0
    environment[GROUND_DOWN] += 2.0
    advance(state, np.zeros(4), p, environment, 1e-3, 500)
    assert state[AT_REST] == 0.0
    assert state[2] == pytest.approx(0.5 * 9.80665 * 0.25, rel=0.02)
