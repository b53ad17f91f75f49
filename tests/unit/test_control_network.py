"""The network and its adaptation, Eqs. (11), (15), by hand and for every step."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from companion.control import network

FINITE = st.floats(-1e3, 1e3)


def adapt(W, sigma, U, N=2.0, kappa=0.5, bound=1e9, dt=0.1):
    out = np.empty_like(W)
    held = network.adapt(W, sigma, U, N, kappa, bound, dt, out)
    return out, held


def test_one_step_by_hand():
    """σ = (1, -2), Ũ = (3, 0, -4), ‖Ũ‖ = 5, N = 2, κ = 0.5, dt = 0.1, Ŵ₁₁ = 1:
    Ŵ₁₁ ← (1 + 0.1·2·1·3) / (1 + 0.1·2·0.5·5) = 1.6 / 1.5."""
    W = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    out, held = adapt(W, np.array([1.0, -2.0]), np.array([3.0, 0.0, -4.0]))
    expected = np.array([[1.6, 0.0, -0.8], [-1.2, 2.0, 1.6]]) / 1.5
    np.testing.assert_allclose(out, expected, rtol=1e-14)
    assert not held


def test_small_steps_follow_the_differential_equation():
    W, sigma, U = np.array([[0.3, -0.2, 0.1]]), np.array([0.7]), np.array([0.1, 0.2, -0.2])
    out, _ = adapt(W, sigma, U, dt=1e-7)
    expected = 2.0 * (np.outer(sigma, U) - 0.5 * np.linalg.norm(U) * W)
    np.testing.assert_allclose((out - W) / 1e-7, expected, rtol=1e-5)


def test_output_grows_in_the_direction_of_the_error():
    """With the report's printed sign of (15) the output would run away from Ũ (control_laws.md, section 3)."""
    W, sigma, U = np.zeros((4, 3)), np.array([0.5, -0.3, 0.9, -0.1]), np.array([0.2, -0.4, 0.6])
    out, _ = adapt(W, sigma, U)
    output = network.output_layer(out, sigma)
    assert output @ U > 0


@given(
    arrays(np.float64, (5, 3), elements=FINITE),
    arrays(np.float64, 5, elements=st.floats(-1, 1)),
    arrays(np.float64, 3, elements=FINITE),
    st.floats(0, 1e3),
    st.floats(1e-3, 10),
    st.floats(0, 1e3),
)
def test_the_implicit_leak_never_diverges(W, sigma, U, N, kappa, dt):
    """Whatever the step: ‖Ŵ'‖ ≤ max(‖Ŵ‖, ‖σ‖/κ), the norm at which leak and drive balance."""
    out, _ = adapt(W, sigma, U, N=N, kappa=kappa, dt=dt)
    bound = max(np.linalg.norm(W), np.linalg.norm(sigma) / kappa)
    assert np.linalg.norm(out) <= bound * (1 + 1e-9) + 1e-9


@given(
    arrays(np.float64, (5, 3), elements=FINITE),
    arrays(np.float64, 3, elements=FINITE),
    st.floats(0.01, 50),
)
def test_projection_keeps_the_norm_and_the_direction(W, U, bound):
    sigma = np.linspace(-1, 1, 5)
    free, _ = adapt(W, sigma, U)
    out, held = adapt(W, sigma, U, bound=bound)
    norm = np.linalg.norm(free)
    assert np.linalg.norm(out) <= bound * (1 + 1e-12)
    assert held == (norm > bound)
    if held:
        np.testing.assert_allclose(out, free * bound / norm, rtol=1e-9, atol=1e-12)


def test_hidden_layer_is_tanh_of_the_features():
    V = np.zeros((10, 2))
    V[0, 0], V[3, 0], V[4, 0] = 0.1, 2.0, -1.0  # bias, third of a, first of b
    V[9, 1] = 0.5  # third of c
    sigma = network.hidden_layer(V, np.array([9, 9, 0.3]), np.array([0.2, 9, 9]), np.array([9, 9, -4.0]))
    np.testing.assert_allclose(sigma, [math.tanh(0.1 + 0.6 - 0.2), math.tanh(-2.0)], rtol=1e-15)


def test_input_weights_come_from_the_seed_alone():
    scales = np.array([1.0, 0.5, 2.0, 0.1])
    V = network.draw_input_weights(3, 6, scales)
    np.testing.assert_array_equal(V, network.draw_input_weights(3, 6, scales))
    assert not np.array_equal(V, network.draw_input_weights(4, 6, scales))
    assert V.shape == (10, 6)
    for rows, scale in ((slice(0, 1), 1.0), (slice(1, 4), 0.5), (slice(4, 7), 2.0), (slice(7, 10), 0.1)):
        assert np.abs(V[rows]).max() <= scale
    assert np.abs(V[7:]).max() > 0.05


@pytest.mark.parametrize(
    ("value", "width", "expected"),
    [(0.2, 0.1, math.tanh(2)), (-0.2, 0.0, -1.0), (0.0, 0.0, 0.0), (3.0, 0.0, 1.0)],
)
def test_sign_with_and_without_boundary_layer(value, width, expected):
    assert network.smooth_sign(value, width) == pytest.approx(expected)
