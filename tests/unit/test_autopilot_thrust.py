"""Newtons to the autopilot's thrust, and rotor thrusts to actuator controls, against PX4's own mixer tables."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.autopilot.thrust import LEAST_THRUST, ThrustScale, mixer_of

S = math.sqrt(0.5)
PLUS = np.array([[0.2, 0, 0], [0, -0.2, 0], [-0.2, 0, 0], [0, 0.2, 0]])  # front, right, rear, left (FLU)
PLUS_SPINS = (-1, 1, -1, 1)
CROSS = np.array([[0.2, -0.2, 0], [-0.2, 0.2, 0], [0.2, 0.2, 0], [-0.2, -0.2, 0]])  # PX4's order
CROSS_SPINS = (-1, -1, 1, 1)  # reaction about z up: rotors 1 and 2 turn counter-clockwise

# PX4 1.13's tables: roll, pitch, yaw, thrust in FRD
PX4_QUAD_X = np.array([[-S, S, 1, 1], [S, -S, 1, 1], [S, S, -1, 1], [-S, -S, -1, 1]])
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0, 1.0])


def scale(positions=PLUS, spins=PLUS_SPINS):
    return ThrustScale(0.366, 1.79, 12.0, mixer_of(positions, spins))


def test_hover_thrust_carries_the_weight():
    """1.79 kg · 9.81 m/s² = 17.56 N at 0.366; full thrust is 47.98 N, four rotors of 12 N."""
    assert scale().normalised(17.5599) == pytest.approx(0.366)
    assert scale().newton(0.366) == pytest.approx(17.5599)
    assert scale().full_newton == pytest.approx(47.98, abs=0.01)


def test_bounds():
    assert scale().normalised(-5.0) == scale().normalised(0.0) == LEAST_THRUST
    assert scale().normalised(1000.0) == 1.0


@given(st.floats(LEAST_THRUST, 1.0))
def test_comes_back(normalised):
    assert scale().normalised(scale().newton(normalised)) == pytest.approx(normalised)


def test_quad_x_is_px4s():
    np.testing.assert_allclose(mixer_of(CROSS, CROSS_SPINS), PX4_QUAD_X @ FLU_FROM_FRD, atol=1e-12)


def test_plus_rotor_by_rotor():
    """Front pitches up (negative about y left) and turns right; right rolls left; rear and left the other way."""
    expected = [[0, -1, -1, 1], [-1, 0, 1, 1], [0, 1, -1, 1], [1, 0, 1, 1]]
    np.testing.assert_allclose(mixer_of(PLUS, PLUS_SPINS), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("rotor_thrust", "controls"),
    [
        ((6.0, 6.0, 6.0, 6.0), (0.0, 0.0, 0.0, 0.5)),
        ((6.0, 4.8, 6.0, 7.2), (0.1, 0.0, 0.0, 0.5)),  # more on the left: roll right
        ((4.8, 6.0, 7.2, 6.0), (0.0, 0.1, 0.0, 0.5)),  # more at the rear: nose down
        ((4.8, 7.2, 4.8, 7.2), (0.0, 0.0, 0.1, 0.5)),  # more on the pair that reacts to the left
        ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_controls_by_hand(rotor_thrust, controls):
    np.testing.assert_allclose(scale().controls(np.array(rotor_thrust)), controls, atol=1e-12)


@pytest.mark.parametrize(("positions", "spins"), [(PLUS, PLUS_SPINS), (CROSS, CROSS_SPINS)])
@given(thrusts=st.lists(st.floats(0.0, 12.0), min_size=4, max_size=4))
def test_the_mixer_gives_the_rotors_back(positions, spins, thrusts):
    """As long as no control is at its bound, PX4's mixing of our controls is what was asked of each rotor."""
    vehicle = scale(positions, spins)
    controls = vehicle.controls(np.array(thrusts))
    assert np.all(np.abs(controls) <= 1.0)
    np.testing.assert_allclose(12.0 * vehicle.mixer @ controls, thrusts, atol=1e-9)


def test_commands_beyond_a_rotors_range_are_bounded():
    controls = scale().controls(np.array([30.0, -5.0, 6.0, 6.0]))
    np.testing.assert_allclose(controls, scale().controls(np.array([12.0, 0.0, 6.0, 6.0])))
