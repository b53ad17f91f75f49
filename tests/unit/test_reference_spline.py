"""Minimum snap against SciPy's heptic splines and a brute-force quadratic programme; time allocation."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.reference.minimum_snap import Waypoints, minimum_snap
from companion.reference.spline import minimum_snap_derivatives, snap_integral, spline_through
from companion.reference.transit import TransitLimits

interpolate = pytest.importorskip("scipy.interpolate")
optimize = pytest.importorskip("scipy.optimize")

ORDERS = ("position_enu", "velocity_enu", "acceleration_enu", "jerk_enu", "snap_enu")


def problem(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return np.concatenate([[0.0], np.cumsum(rng.uniform(0.5, 2.0, n - 1))]), rng.normal(size=(n, 4))


def clamped(times: np.ndarray, points: np.ndarray) -> np.ndarray:
    values = np.zeros((times.size, 4, 4))
    values[:, 0] = points
    fixed = np.zeros((times.size, 4), dtype=bool)
    fixed[:, 0] = fixed[0] = fixed[-1] = True
    return minimum_snap_derivatives(times, values, fixed)


@pytest.mark.parametrize(("seed", "n"), [(1, 2), (2, 3), (3, 9), (4, 40)])
def test_from_rest_to_rest_it_is_scipys_clamped_heptic_spline(seed: int, n: int) -> None:
    # The minimiser of the integral of squared snap through points is the C⁶ spline of degree 7.
    times, points = problem(seed, n)
    spline = spline_through(times, clamped(times, points))
    rest = [(k, np.zeros(4)) for k in (1, 2, 3)]
    other = interpolate.make_interp_spline(times, points, k=7, bc_type=(rest, rest))
    for time_s in np.linspace(0.0, times[-1], 60):
        reference = spline.sample(time_s)
        for order, name in enumerate(ORDERS):
            expected = other(time_s, nu=order)[:3]
            np.testing.assert_allclose(getattr(reference, name), expected, rtol=1e-6, atol=1e-6)
        assert reference.yaw_rad == pytest.approx(other(time_s)[3], abs=1e-8)


def test_free_ends_are_natural() -> None:
    times, points = problem(5, 8)
    values = np.zeros((8, 4, 4))
    values[:, 0] = points
    fixed = np.zeros((8, 4), dtype=bool)
    fixed[:, 0] = True
    spline = spline_through(times, minimum_snap_derivatives(times, values, fixed))
    natural = [(k, np.zeros(4)) for k in (4, 5, 6)]
    other = interpolate.make_interp_spline(times, points, k=7, bc_type=(natural, natural))
    for time_s in np.linspace(0.0, times[-1], 40):
        np.testing.assert_allclose(spline.sample(time_s).position_enu, other(time_s)[:3], atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_the_cost_is_the_integral_and_nothing_beats_the_solution(seed: int) -> None:
    times, points = problem(seed, 5)
    best = clamped(times, points)
    spline = spline_through(times, best)
    weights = np.ones(3)
    cost, _ = snap_integral(times, best[:, :, :3], weights)
    nodes, node_weights = np.polynomial.legendre.leggauss(4)  # exact: snap squared has degree 6
    quadrature = 0.0
    for left, right in itertools.pairwise(times):
        for node, weight in zip(nodes, node_weights, strict=True):
            snap = spline.sample((left + right + node * (right - left)) / 2.0).snap_enu
            quadrature += weight * (right - left) / 2.0 * float(snap @ snap)
    assert cost == pytest.approx(quadrature, rel=1e-9)
    rng = np.random.default_rng(seed)
    for size in (1e-3, 0.1, 1.0):
        other = best.copy()
        other[1:-1, 1:] += size * rng.normal(size=other[1:-1, 1:].shape)
        assert snap_integral(times, other[:, :, :3], weights)[0] > cost


def test_slope_of_the_cost_in_the_lengths() -> None:
    times, points = problem(11, 6)

    def cost(lengths: np.ndarray) -> float:
        at = np.concatenate([[0.0], np.cumsum(lengths)])
        return snap_integral(at, clamped(at, points), np.ones(4))[0]

    lengths = np.diff(times)
    slope = snap_integral(times, clamped(times, points), np.ones(4))[1]
    for i in range(5):
        h = 1e-4 * np.eye(5)[i]
        assert slope[i] == pytest.approx((cost(lengths + h) - cost(lengths - h)) / 2e-4, rel=1e-4)


def test_times_are_as_good_as_an_optimiser_finds() -> None:
    _, points = problem(21, 5)
    points[:, 3] = 0.0
    spline = minimum_snap(Waypoints(points[:, :3], points[:, 3], None, TransitLimits()))

    def cost(logs: np.ndarray) -> float:
        lengths = np.exp(logs)
        at = np.concatenate([[0.0], np.cumsum(lengths)])
        return math.log(snap_integral(at, clamped(at, points), np.ones(4))[0]) + 7.0 * math.log(at[-1])

    found = cost(np.log(np.diff(spline.knot_times_s)))
    best = optimize.minimize(cost, np.zeros(4), method="Nelder-Mead", options={"maxiter": 4000}).fun
    assert found <= best + 0.02


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    n=st.integers(2, 12),
    speed=st.floats(0.3, 4.0),
    acceleration=st.floats(0.3, 6.0),
)
def test_waypoints_are_met_from_rest_to_rest_within_the_limits(
    seed: int, n: int, speed: float, acceleration: float
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-5.0, 5.0, (n, 3))
    yaw = np.unwrap(rng.uniform(-3.0, 3.0, n))
    limits = TransitLimits(speed_m_s=speed, acceleration_m_s2=acceleration)
    spline = minimum_snap(Waypoints(points, yaw, None, limits))
    for time_s, point, angle in zip(spline.knot_times_s, points, yaw, strict=True):
        reference = spline.sample(time_s)
        np.testing.assert_allclose(reference.position_enu, point, atol=1e-7)
        assert reference.yaw_rad == pytest.approx(angle, abs=1e-7)
    for time_s in (0.0, spline.duration_s):
        for name in ORDERS[1:4]:
            np.testing.assert_allclose(getattr(spline.sample(time_s), name), 0.0, atol=1e-7)
    sampled = [spline.sample(t) for t in np.linspace(0.0, spline.duration_s, 400)]
    speeds = max(float(np.linalg.norm(r.velocity_enu)) for r in sampled)
    accelerations = max(float(np.linalg.norm(r.acceleration_enu)) for r in sampled)
    turning = max(abs(r.yaw_rate_rad_s) for r in sampled)
    # 1 %: limits are enforced at 33 points of each segment.
    assert speeds <= 1.01 * speed
    assert accelerations <= 1.01 * acceleration
    assert turning <= 1.01 * limits.yaw_rate_rad_s
    # And one of them is reached: no time is wasted.
    jerks = max(float(np.linalg.norm(r.jerk_enu)) for r in sampled)
    spinning = max(abs(r.yaw_acceleration_rad_s2) for r in sampled)
    use = (
        speeds / speed,
        accelerations / acceleration,
        jerks / limits.jerk_m_s3,
        turning / limits.yaw_rate_rad_s,
        spinning / limits.yaw_acceleration_rad_s2,
    )
    assert max(use) >= 0.9


def test_joins_are_continuous_through_snap() -> None:
    times, points = problem(31, 7)
    spline = spline_through(times, clamped(times, points))
    for knot in times[1:-1]:
        left, right = spline.sample(math.nextafter(knot, 0.0)), spline.sample(knot)
        for name in ORDERS:
            np.testing.assert_allclose(getattr(left, name), getattr(right, name), rtol=1e-8, atol=1e-8)


def test_a_square_is_not_left_by_far() -> None:
    square = np.array([[0.0, 0, 1], [2, 0, 1], [2, 2, 1], [0, 2, 1], [0, 0, 1]])
    yaw = np.radians([0.0, 90.0, 180.0, 270.0, 270.0])
    spline = minimum_snap(Waypoints(square, yaw, None, TransitLimits(speed_m_s=2.0, acceleration_m_s2=2.0)))
    way = np.array([spline.sample(t).position_enu for t in np.linspace(0.0, spline.duration_s, 500)])
    assert way[:, :2].min() > -0.6
    assert way[:, :2].max() < 2.6


def test_ten_thousand_knots_are_solved_quickly_and_well() -> None:
    times = np.arange(10_000) * 0.02
    values = np.zeros((times.size, 4, 1))
    values[:, 0, 0] = np.sin(times)
    fixed = np.zeros((times.size, 4), dtype=bool)
    fixed[:, 0] = True
    got = minimum_snap_derivatives(times, values, fixed)[100:-100, :, 0]
    inner = times[100:-100]
    expected = np.stack([np.sin(inner), np.cos(inner), -np.sin(inner), -np.cos(inner)], axis=1)
    np.testing.assert_allclose(got, expected, atol=1e-4)
