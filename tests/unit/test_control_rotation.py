"""Kinematics against rotation matrices built by hand, and the signs of ENU/FLU on single axes."""

import math

import numpy as np
import pytest
from control_plant import exp_so3, matrix_of, quaternion_of, rotation_zyx
from hypothesis import given
from hypothesis import strategies as st

from companion.control import rotation

ANGLE = st.floats(-math.pi, math.pi)
TILT = st.floats(-1.4, 1.4)
RATE = st.floats(-5.0, 5.0)


@given(ANGLE, TILT, ANGLE)
def test_quaternion_makes_the_same_matrix_as_three_turns_about_axes(roll, pitch, yaw):
    q = rotation.quaternion_from_euler(np.array([roll, pitch, yaw]))
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-12)
    R = rotation_zyx(roll, pitch, yaw)
    np.testing.assert_allclose(rotation.rotation_from_quaternion(q), R, atol=1e-12)
    np.testing.assert_allclose(rotation.thrust_direction(np.array([roll, pitch, yaw])), R[:, 2], atol=1e-12)


@given(ANGLE, TILT, ANGLE)
def test_euler_round_trip(roll, pitch, yaw):
    back = rotation.euler_from_quaternion(quaternion_of(rotation_zyx(roll, pitch, yaw)))
    gaps = [rotation.wrap_angle(a - b) for a, b in zip(back, (roll, pitch, yaw), strict=True)]
    np.testing.assert_allclose(gaps, 0.0, atol=1e-7)


@pytest.mark.parametrize(
    ("euler", "direction"),
    [
        # FLU: positive roll lifts the left side, so thrust leans right (-y); positive pitch drops the nose, thrust forward
        ((0.1, 0.0, 0.0), (0.0, -math.sin(0.1), math.cos(0.1))),
        ((0.0, 0.1, 0.0), (math.sin(0.1), 0.0, math.cos(0.1))),
        ((0.0, 0.1, math.pi / 2), (0.0, math.sin(0.1), math.cos(0.1))),
        ((0.1, 0.0, math.pi / 2), (math.sin(0.1), 0.0, math.cos(0.1))),
    ],
)
def test_where_thrust_points(euler, direction):
    np.testing.assert_allclose(rotation.thrust_direction(np.array(euler)), direction, atol=1e-12)


@given(ANGLE, TILT, ANGLE)
def test_rate_matrix_times_its_inverse_is_one(roll, pitch, yaw):
    euler = np.array([roll, pitch, yaw])
    product = rotation.rate_matrix(euler) @ rotation.inverse_rate_matrix(euler)
    np.testing.assert_allclose(product, np.eye(3), atol=1e-9)


@given(ANGLE, st.floats(-1.2, 1.2), ANGLE, RATE, RATE, RATE)
def test_rate_matrix_is_the_derivative_of_the_angles(roll, pitch, yaw, a, b, c):
    """η̇ = Φ ω against a small turn of the rotation matrix itself."""
    w, h = np.array([a, b, c]), 1e-6
    R = rotation_zyx(roll, pitch, yaw)
    ahead = rotation.euler_from_quaternion(quaternion_of(R @ exp_so3(w * h)))
    behind = rotation.euler_from_quaternion(quaternion_of(R @ exp_so3(-w * h)))
    numeric = [rotation.wrap_angle(x - y) / (2 * h) for x, y in zip(ahead, behind, strict=True)]
    np.testing.assert_allclose(
        rotation.times(rotation.rate_matrix(np.array([roll, pitch, yaw])), w),
        numeric,
        atol=3e-4 + 1e-6 * np.abs(w).max(),
    )


@given(ANGLE, TILT, ANGLE, RATE, RATE, RATE)
def test_derivative_of_the_inverse_rate_matrix(roll, pitch, yaw, a, b, c):
    euler, rate, h = np.array([roll, pitch, yaw]), np.array([a, b, c]), 1e-6
    numeric = rotation.inverse_rate_matrix(euler + h * rate) - rotation.inverse_rate_matrix(euler - h * rate)
    np.testing.assert_allclose(
        rotation.inverse_rate_matrix_derivative(euler, rate), numeric / (2 * h), atol=1e-7
    )


@given(RATE, RATE, RATE, ANGLE, TILT, ANGLE)
def test_product_and_rotation_vector(a, b, c, roll, pitch, yaw):
    R = rotation_zyx(roll, pitch, yaw)
    turn = np.array([a, b, c]) / 3
    q = rotation.quaternion_product(quaternion_of(R), rotation.quaternion_from_rotation_vector(turn))
    np.testing.assert_allclose(matrix_of(q), R @ exp_so3(turn), atol=1e-9)


def test_transposed_product():
    A = np.arange(9.0).reshape(3, 3)
    v = np.array([1.0, -2.0, 3.0])
    np.testing.assert_allclose(rotation.transposed_times(A, v), A.T @ v)
    np.testing.assert_allclose(rotation.times(A, v), A @ v)


@given(st.floats(-50, 50))
def test_wrap(angle):
    wrapped = rotation.wrap_angle(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-9)
