"""B against the report's matrix, its inverse, and who loses when the rotors cannot give everything."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.settings import load_profile
from companion.control.allocation import allocate, allocation_matrix
from companion.control.bounds import Bound

L, K = 0.2, 1 / 30
PLUS = np.array([[L, 0], [0, -L], [-L, 0], [0, L]])
SPINS = np.array([-1.0, 1.0, -1.0, 1.0])


def mixer_of(B):
    mixer = np.zeros((8, 4))
    mixer[: B.shape[1]] = np.linalg.pinv(B)
    return mixer


def run(thrust, torque, B=None, low=0.0, high=12.0):
    B = allocation_matrix(PLUS, SPINS, K) if B is None else B
    rotors, got = np.zeros(8), np.zeros(4)
    flags = allocate(mixer_of(B), B.shape[1], low, high, thrust, np.array(torque, dtype=float), rotors, got)
    return rotors[: B.shape[1]], got, Bound(flags), B


def test_qball2_has_the_matrix_of_the_report():
    B = allocation_matrix(PLUS, SPINS, K)
    expected = [[1, 1, 1, 1], [0, -L, 0, L], [-L, 0, L, 0], [-K, K, -K, K]]
    np.testing.assert_allclose(B, expected)
    profile = load_profile("qball2")
    rotors = profile.rotors
    np.testing.assert_allclose(allocation_matrix(rotors.arms_m, rotors.spins, rotors.torque_per_newton_m), B)


@pytest.mark.parametrize(
    ("torque", "changes"),
    [
        # by hand: τ = 0.4 N·m over two arms of 0.2 m is 1 N up on one side and 1 N down on the other
        ((0.4, 0, 0), (0, -1, 0, 1)),  # roll: left up
        ((0, 0.4, 0), (-1, 0, 1, 0)),  # pitch: nose down, rear rotor up
        ((0, 0, 0.4), (-3, 3, -3, 3)),  # yaw left: the clockwise rotors 2 and 4 speed up; 0.4 / (4/30) = 3 N
    ],
)
def test_signs_of_every_rotor(torque, changes):
    rotors, got, flags, _ = run(16.0, torque)
    np.testing.assert_allclose(rotors - 4.0, changes, atol=1e-12)
    np.testing.assert_allclose(got, [16.0, *torque])
    assert flags == 0


@given(
    st.floats(12, 24),
    st.floats(-0.4, 0.4),
    st.floats(-0.4, 0.4),
    st.floats(-0.03, 0.03),
    st.floats(-0.5, 0.5),
)
def test_inverse_gives_back_what_was_asked(thrust, roll, pitch, yaw, turn):
    """Any layout: six rotors, unevenly placed."""
    angles = np.arange(6) * np.pi / 3 + turn
    arms = 0.3 * np.column_stack([np.cos(angles), np.sin(angles)]) + [0.02, -0.01]
    B = allocation_matrix(arms, np.array([1, -1, 1, -1, 1, -1.0]), 0.02)
    rotors, got, flags, _ = run(thrust, (roll, pitch, yaw), B=B)
    np.testing.assert_allclose(B @ rotors, [thrust, roll, pitch, yaw], atol=1e-9)
    np.testing.assert_allclose(got, [thrust, roll, pitch, yaw], atol=1e-9)
    assert flags == 0


@given(st.floats(0, 60), st.floats(-6, 6), st.floats(-6, 6), st.floats(-3, 3))
def test_saturated_rotors_keep_their_bounds_and_say_what_was_cut(thrust, roll, pitch, yaw):
    rotors, got, flags, B = run(thrust, (roll, pitch, yaw))
    assert rotors.min() >= 0.0 and rotors.max() <= 12.0
    np.testing.assert_allclose(B @ rotors, got, atol=1e-9)
    asked = np.array([thrust, roll, pitch, yaw])
    changed = np.abs(got - asked) > 1e-6
    assert changed[0] <= bool(flags & Bound.THRUST_FOR_TORQUE)
    assert changed[1:3].any() <= bool(flags & Bound.ROLL_PITCH_TORQUE)
    assert changed[3] <= bool(flags & Bound.YAW_TORQUE)


def test_yaw_goes_first():
    """2 N a rotor: yaw may take 2 N off the slowest, 4/30 · 2 = 0.2667 N·m; 1 N·m was asked."""
    _, got, flags, _ = run(8.0, (0, 0, 1.0))
    np.testing.assert_allclose(got, [8.0, 0, 0, 8 / 30])
    assert flags == Bound.YAW_TORQUE


def test_then_thrust_moves_for_roll():
    """Roll of 1.2 N·m needs rotors 2 and 4 3 N apart from the mean: 12 N in all, though 4 were asked."""
    _, got, flags, _ = run(4.0, (1.2, 0, 0))
    np.testing.assert_allclose(got, [12.0, 1.2, 0, 0])
    assert flags == Bound.THRUST_FOR_TORQUE


def test_roll_and_pitch_go_last():
    """6 N·m of roll is 15 N either way; the rotors span 12 N: 12/30 of it is left, at half thrust."""
    _, got, flags, _ = run(10.0, (6.0, 0, 0))
    np.testing.assert_allclose(got, [24.0, 2.4, 0, 0])
    assert Bound.ROLL_PITCH_TORQUE in flags


@pytest.mark.parametrize(
    ("arms", "spins"),
    [(np.array([[0.2, 0], [0.1, 0], [-0.1, 0], [-0.2, 0]]), SPINS), (PLUS, np.ones(4))],
    ids=["in one line", "all turn alike"],
)
def test_a_layout_that_cannot_steer_is_refused(arms, spins):
    with pytest.raises(ValueError, match="independently"):
        allocation_matrix(arms, spins, K)
