"""Force to attitude (16)–(18), its derivatives by flatness, the command filter, bounds, M and C."""

import math

import numpy as np
import pytest
from control_plant import GRAVITY, rotation_zyx, sinusoid, skew
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm

from companion.control import bounds, flatness, plant, rotation
from companion.control.bounds import Bound
from companion.control.command_filter import command_filter_transition

YAW = st.floats(-math.pi, math.pi)


@pytest.mark.parametrize(
    ("force", "yaw", "euler"),
    [
        # by hand: 10 N up and 10·tan(0.2) N along x
        ((10 * math.tan(0.2), 0, 10), 0.0, (0.0, 0.2, 0.0)),
        ((0, 10 * math.tan(0.2), 10), 0.0, (-0.2, 0.0, 0.0)),
        ((0, 10 * math.tan(0.2), 10), math.pi / 2, (0.0, 0.2, math.pi / 2)),
        ((10 * math.tan(0.2), 0, 10), math.pi / 2, (0.2, 0.0, math.pi / 2)),
    ],
)
def test_desired_tilt_by_hand(force, yaw, euler):
    np.testing.assert_allclose(
        flatness.euler_from_force(np.array(force, dtype=float), yaw), euler, atol=1e-12
    )


@given(st.floats(-20, 20), st.floats(-20, 20), st.floats(1, 40), YAW)
def test_thrust_along_the_desired_attitude_is_the_force(fx, fy, fz, yaw):
    """Eqs. (16)–(18) together: f = F r₃(η_d), with r₃ from a rotation matrix built by hand."""
    force = np.array([fx, fy, fz])
    euler = flatness.euler_from_force(force, yaw)
    F = fz / (math.cos(euler[0]) * math.cos(euler[1]))
    np.testing.assert_allclose(F * rotation_zyx(*euler)[:, 2], force, atol=1e-9)
    np.testing.assert_allclose(flatness.force_from_euler(euler, fz), force, atol=1e-9)


def test_flat_attitude_differentiates_itself():
    """η̇ and η̈ along a fast path with turning heading, against differences of η itself."""

    def rows(t):
        axes = [sinusoid(t, a, T, ph) for a, T, ph in ((0.5, 3.0, 0.1), (1.0, 5.0, 1.2), (0.4, 2.5, -0.4))]
        p = np.array(axes).T
        yaw = sinusoid(t, 1.5, 6.0, 0.3)
        return flatness.flat_attitude(p[2], p[3], p[4], yaw[0], yaw[1], yaw[2], GRAVITY)

    h = 1e-4
    for t in np.linspace(0, 6, 25):
        before, now, after = rows(t - h), rows(t), rows(t + h)
        np.testing.assert_allclose(now[1], (after[0] - before[0]) / (2 * h), atol=1e-6)
        np.testing.assert_allclose(now[2], (after[1] - before[1]) / (2 * h), atol=1e-5)


def test_flat_attitude_of_a_falling_reference_stays_defined():
    a, z = np.array([1.0, 0.0, -15.0]), np.ones(3)
    assert np.isfinite(flatness.flat_attitude(a, z, z, 0.0, 0.0, 0.0, GRAVITY)).all()


@given(st.floats(0.1, 60), st.floats(0.05, 3), st.floats(0, 5))
def test_command_filter_is_the_exact_solution(frequency, damping, dt):
    A = np.array([[0, 1], [-(frequency**2), -2 * damping * frequency]])
    transition = command_filter_transition(frequency, damping, dt)
    np.testing.assert_allclose(transition, expm(A * dt), atol=2e-6 * (1 + frequency))
    assert np.abs(np.linalg.eigvals(transition)).max() <= 1 + 1e-9


def test_force_is_kept_up_and_in_the_cone():
    force = np.array([3.0, -4.0, 1.0])
    flags = Bound(bounds.bound_force(force, 2.0, math.radians(45)))
    np.testing.assert_allclose(force, [1.2, -1.6, 2.0])
    assert flags == Bound.FORCE_Z | Bound.TILT
    free = np.array([1.0, 1.0, 10.0])
    assert bounds.bound_force(free, 2.0, math.radians(45)) == 0
    np.testing.assert_array_equal(free, [1.0, 1.0, 10.0])


@given(st.floats(-2.5, 2.5), st.floats(-2.5, 2.5), YAW)
def test_setpoint_tilt_is_bounded_and_keeps_its_direction(roll, pitch, yaw):
    limit = math.radians(35)
    euler = np.array([roll, pitch, yaw])
    flags = bounds.bound_tilt(euler, limit)
    r3 = rotation_zyx(*euler)[:, 2]
    assert math.acos(min(1.0, r3[2])) <= limit + 1e-9
    assert euler[2] == yaw
    if flags:
        assert math.acos(min(1.0, r3[2])) == pytest.approx(limit, abs=1e-6)
        if abs(roll) < 1.5 and abs(pitch) < 1.5:
            before = rotation_zyx(roll, pitch, yaw)[:2, 2]
            assert (
                before @ r3[:2] >= 0 and abs(np.cross(np.append(before, 0), np.append(r3[:2], 0))[2]) < 1e-9
            )
    else:
        np.testing.assert_array_equal(euler, [roll, pitch, yaw])


def mass_matrix(euler, inertia):
    inverse = rotation.inverse_rate_matrix(euler)
    return inverse.T @ np.diag(inertia) @ inverse


INERTIA = np.array([0.03, 0.035, 0.05])
EULERS = arrays(np.float64, 3, elements=st.floats(-1.3, 1.3))
RATES = arrays(np.float64, 3, elements=st.floats(-4, 4))


@given(EULERS, RATES)
def test_mass_matrix(euler, vector):
    np.testing.assert_allclose(
        plant.mass_matrix_times(euler, INERTIA, vector), mass_matrix(euler, INERTIA) @ vector, atol=1e-12
    )


@given(EULERS, RATES)
def test_coriolis_term_is_that_of_christoffel_symbols(euler, rate):
    """C η̇ from the derivatives of M alone: Σ (∂M_ij/∂η_k − ½ ∂M_jk/∂η_i) η̇_j η̇_k."""
    h = 1e-6
    dM = np.array(
        [
            (mass_matrix(euler + h * e, INERTIA) - mass_matrix(euler - h * e, INERTIA)) / (2 * h)
            for e in np.eye(3)
        ]
    )
    expected = np.einsum("kij,j,k->i", dM, rate, rate) - 0.5 * np.einsum("ijk,j,k->i", dM, rate, rate)
    np.testing.assert_allclose(plant.coriolis_times(euler, rate, INERTIA, rate), expected, atol=2e-8)


@given(EULERS, RATES, RATES)
def test_m_dot_less_two_c_is_skew(euler, rate, x):
    """xᵀ(Ṁ − 2C)x = 0: the Coriolis term does no work (proof of Eq. (31))."""
    h = 1e-6
    M_dot = (mass_matrix(euler + h * rate, INERTIA) - mass_matrix(euler - h * rate, INERTIA)) / (2 * h)
    assert x @ M_dot @ x == pytest.approx(2 * x @ plant.coriolis_times(euler, rate, INERTIA, x), abs=1e-7)


@given(EULERS, RATES, RATES)
def test_lagrange_and_newton_euler_agree(euler, rate, acceleration):
    """Φᵀ(M η̈ + C η̇) is the torque I ω̇ + ω × Iω, with ω̇ from differences of Φ⁻¹ η̇."""
    h = 1e-6
    w = rotation.inverse_rate_matrix(euler) @ rate
    ahead = rotation.inverse_rate_matrix(euler + h * rate) @ (rate + h * acceleration)
    behind = rotation.inverse_rate_matrix(euler - h * rate) @ (rate - h * acceleration)
    torque = INERTIA * (ahead - behind) / (2 * h) + skew(w) @ (INERTIA * w)
    generalised = plant.mass_matrix_times(euler, INERTIA, acceleration) + plant.coriolis_times(
        euler, rate, INERTIA, rate
    )
    np.testing.assert_allclose(rotation.rate_matrix(euler).T @ generalised, torque, atol=1e-7)
