"""The shipped trajectories: derivatives, ends, numbers worked out by hand, and where they are laid out."""

from __future__ import annotations

import itertools
import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config.errors import UserError
from companion.control.structs import Reference
from companion.reference.circle import Circle
from companion.reference.csv_file import csv_trajectory
from companion.reference.hold import Hold
from companion.reference.lemniscate import Lemniscate
from companion.reference.minimum_snap import Waypoints, minimum_snap
from companion.reference.step import Step
from companion.reference.trajectory import Frame, Trajectory, place, placed, resting, wrapped
from companion.reference.transit import TransitLimits, run_in, run_out, transit

ORDERS = ("position_enu", "velocity_enu", "acceleration_enu", "jerk_enu", "snap_enu")
YAW = ("yaw_rad", "yaw_rate_rad_s", "yaw_acceleration_rad_s2")
# Central difference of order 8: error h^8/630 times the 9th derivative.
STENCIL = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}


def stack(reference: Reference) -> np.ndarray:
    return np.stack([getattr(reference, name) for name in ORDERS])


def difference(trajectory: Trajectory, name: str, time_s: float, h: float) -> np.ndarray:
    total = np.zeros_like(np.asarray(getattr(trajectory.sample(time_s), name)), dtype=float)
    for k, weight in STENCIL.items():
        ahead = np.asarray(getattr(trajectory.sample(time_s + k * h), name))
        behind = np.asarray(getattr(trajectory.sample(time_s - k * h), name))
        total = total + weight * (ahead - behind) / h
    return total


def waypoints() -> Trajectory:
    points = np.array([[0.0, 0, 1], [2, 0, 1.5], [2, 2, 1], [0, 1, 1.2]])
    return minimum_snap(Waypoints(points, np.array([0.0, 1.0, 2.5, 2.0]), None, TransitLimits()))


def moving_transit() -> Trajectory:
    circle = Circle(radius_m=2.0, look_ahead=True)
    return transit(Lemniscate().sample(2.3), circle.sample(0.7), TransitLimits())


SMOOTH = {
    "lemniscate": (Lemniscate(), 9.0),
    "lemniscate fast": (Lemniscate(speed=1.7, scale=0.6, height_m=2.0, yaw_rad=0.3), 6.0),
    "circle": (Circle(radius_m=1.5, speed_m_s=2.0), 8.0),
    "circle ahead": (Circle(radius_m=1.5, speed_m_s=2.0, look_ahead=True, clockwise=True), 8.0),
    "transit": (moving_transit(), moving_transit().duration_s),
    "run in": (run_in(Lemniscate(), TransitLimits()), run_in(Lemniscate(), TransitLimits()).duration_s),
    "waypoints": (waypoints(), waypoints().duration_s),
    "placed": (placed(Lemniscate(yaw_rad=0.2), np.array([3.0, -4.0, 0.5]), 2.2), 9.0),
    "hold": (Hold(1.0, 2.0, 3.0), 5.0),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_each_derivative_is_that_of_the_one_before(name: str) -> None:
    trajectory, span = SMOOTH[name]
    h = span / 3000
    for time_s in np.linspace(4.01 * h, span - 4.01 * h, 41):
        reference = trajectory.sample(time_s)
        for lower, upper in itertools.pairwise(ORDERS):
            expected = difference(trajectory, lower, time_s, h)
            np.testing.assert_allclose(getattr(reference, upper), expected, rtol=1e-6, atol=2e-6)
        for lower, upper in itertools.pairwise(YAW):
            expected = difference(trajectory, lower, time_s, h)
            np.testing.assert_allclose(getattr(reference, upper), expected, rtol=1e-6, atol=2e-6)


def test_lemniscate_by_hand() -> None:
    start = Lemniscate().sample(0.0)
    quarter = math.pi / 4
    # d³/dt³ of -0.7 exp(-0.1 t³) at 0 is 0.7 · 0.1 · 3! = 0.42.
    np.testing.assert_allclose(start.position_enu, [0.0, 1.0, 0.3], atol=1e-15)
    np.testing.assert_allclose(start.velocity_enu, [quarter, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(start.acceleration_enu, [0.0, -(quarter**2), 0.0], atol=1e-15)
    np.testing.assert_allclose(start.jerk_enu, [-0.5 * (math.pi / 2) ** 3, 0.0, 0.42], atol=1e-15)
    np.testing.assert_allclose(start.snap_enu, [0.0, quarter**4, 0.0], atol=1e-15)
    # At t = 2: x back at 0, y = cos(π/2), z = 1 - 0.7 e^-0.8.
    np.testing.assert_allclose(
        Lemniscate().sample(2.0).position_enu, [0.0, 0.0, 1.0 - 0.7 * 0.44932896411722156], atol=1e-15
    )


def test_lemniscate_has_the_reports_height_up_to_the_jump_it_smooths() -> None:
    trajectory = Lemniscate()
    for time_s in np.linspace(0.0, 12.0, 2401):
        report = 1.0 - 0.7 * math.exp(-0.1 * time_s**3) if time_s <= 5.0 else 1.0
        allowed = 0.0 if time_s <= 5.0 else 2.61e-6
        assert abs(trajectory.sample(time_s).position_enu[2] - report) <= allowed + 1e-15
    assert trajectory.sample(5.0).position_enu[2] - 1.0 == pytest.approx(-2.6e-6, rel=0.01)
    # The exponential is left out where it has become too small to matter: nothing may change there.
    cut = (100.0 / 0.1) ** (1 / 3)
    before, after = stack(trajectory.sample(cut - 1e-6))[:, 2], stack(trajectory.sample(cut + 1e-6))[:, 2]
    np.testing.assert_allclose(before, after, rtol=0.0, atol=1e-30)


def test_speed_factor_scales_derivatives() -> None:
    slow, fast = Lemniscate(), Lemniscate(speed=2.0)
    for time_s in (0.0, 0.4, 1.7):
        factors = (2.0 ** np.arange(5))[:, None]
        np.testing.assert_allclose(
            stack(fast.sample(time_s)), stack(slow.sample(2.0 * time_s)) * factors, rtol=1e-13, atol=1e-13
        )


def test_circle_by_hand() -> None:
    radius, speed = 2.5, 3.0
    for clockwise in (False, True):
        circle = Circle(radius_m=radius, speed_m_s=speed, clockwise=clockwise, look_ahead=True)
        for time_s in (0.0, 0.9, 7.3):
            reference = circle.sample(time_s)
            position, velocity = reference.position_enu[:2], reference.velocity_enu[:2]
            assert np.hypot(*position) == pytest.approx(radius)
            assert np.hypot(*velocity) == pytest.approx(speed)
            # a = v²/r towards the centre
            np.testing.assert_allclose(
                reference.acceleration_enu[:2], -position / radius * speed**2 / radius, atol=1e-12
            )
            turning = position[0] * velocity[1] - position[1] * velocity[0]
            assert (turning < 0) == clockwise
            assert wrapped(reference.yaw_rad - math.atan2(velocity[1], velocity[0])) == pytest.approx(0.0)


FINITE = {
    "lemniscate": Lemniscate(duration_s=7.0),
    "circle": Circle(duration_s=5.0, look_ahead=True),
    "transit": moving_transit(),
    "run out": run_out(Lemniscate().sample(11.0), TransitLimits()),
    "waypoints": waypoints(),
    "hold": Hold(duration_s=3.0),
    "step": Step(),
    "placed": placed(Lemniscate(duration_s=7.0), np.ones(3), 0.4),
}


@pytest.mark.parametrize("name", FINITE)
def test_outside_its_duration_a_trajectory_stands_still_at_the_nearer_end(name: str) -> None:
    trajectory = FINITE[name]
    assert isinstance(trajectory, Trajectory)
    for inside, outside in (
        (0.0, (-1e-9, -3.0, -math.inf)),
        (trajectory.duration_s, (trajectory.duration_s + 1e-9, trajectory.duration_s + 9.0, math.inf)),
    ):
        end = trajectory.sample(inside)
        for time_s in outside:
            still = trajectory.sample(time_s)
            np.testing.assert_allclose(still.position_enu, end.position_enu, atol=1e-15)
            assert still.yaw_rad == end.yaw_rad
            assert not stack(still)[1:].any()
            assert still.yaw_rate_rad_s == still.yaw_acceleration_rad_s2 == 0.0
    with pytest.raises(ValueError, match="NaN"):
        trajectory.sample(math.nan)


def test_ends_keep_their_motion() -> None:
    assert np.linalg.norm(FINITE["lemniscate"].sample(0.0).velocity_enu) == pytest.approx(math.pi / 4)
    assert np.linalg.norm(FINITE["lemniscate"].sample(7.0).velocity_enu) > 0.1


@pytest.mark.parametrize("name", sorted(SMOOTH))
def test_samples_are_new_writable_contiguous_float64(name: str) -> None:
    # A compiled law is compiled for one kind of array; another kind would compile in flight.
    trajectory, span = SMOOTH[name]
    for time_s in (-1.0, 0.3 * span):
        first, second = trajectory.sample(time_s), trajectory.sample(time_s)
        for order in ORDERS:
            array = getattr(first, order)
            assert array.shape == (3,)
            assert array.dtype == np.float64
            assert array.flags.c_contiguous
            assert array.flags.writeable
            assert not np.shares_memory(array, getattr(second, order))
        for field in YAW:
            assert type(getattr(first, field)) is float


@pytest.mark.parametrize("name", sorted(SMOOTH))
def test_a_sample_is_cheap(name: str) -> None:
    trajectory, span = SMOOTH[name]
    best = math.inf
    for _ in range(20):
        began = time.perf_counter()
        for _ in range(100):
            trajectory.sample(0.4 * span)
        best = min(best, (time.perf_counter() - began) / 100)
    # The aim is 15 µs; a machine shared with other work is allowed four times that.
    assert best < 60e-6


angles = st.floats(-10.0, 10.0)
coordinates = st.floats(-100.0, 100.0)
vectors = st.tuples(coordinates, coordinates, coordinates).map(np.array)


@settings(max_examples=60, deadline=None)
@given(origin=vectors, heading=angles, time_s=st.floats(-1.0, 12.0))
def test_placing_turns_about_the_vertical_and_moves(
    origin: np.ndarray, heading: float, time_s: float
) -> None:
    own = Circle(radius_m=2.0, height_m=1.3, look_ahead=True)
    before, after = own.sample(time_s), placed(own, origin, heading).sample(time_s)
    # By complex numbers: turning by ψ multiplies x + iy by e^{iψ}.
    turn = complex(math.cos(heading), math.sin(heading))
    for k, name in enumerate(ORDERS):
        a, b = getattr(before, name), getattr(after, name) - (origin if k == 0 else 0.0)
        assert complex(b[0], b[1]) == pytest.approx(turn * complex(a[0], a[1]), abs=1e-11)
        assert b[2] == pytest.approx(a[2], abs=1e-12)
    assert after.yaw_rad == before.yaw_rad + heading
    assert after.yaw_rate_rad_s == before.yaw_rate_rad_s


@settings(max_examples=40, deadline=None)
@given(first=angles, second=angles, a=vectors, b=vectors, time_s=st.floats(0.0, 9.0))
def test_placing_twice_is_placing_once(
    first: float, second: float, a: np.ndarray, b: np.ndarray, time_s: float
) -> None:
    own = Lemniscate()
    twice = placed(placed(own, a, first), b, second).sample(time_s)
    once = placed(own, placed(Hold(*a), b, second).sample(0.0).position_enu, first + second).sample(time_s)
    np.testing.assert_allclose(stack(twice), stack(once), atol=1e-10)
    assert wrapped(twice.yaw_rad - once.yaw_rad) == pytest.approx(0.0, abs=1e-12)


def test_frames() -> None:
    ahead = Hold(x_m=2.0, y_m=1.0, height_m=1.5, yaw_rad=0.1)
    takeoff = np.array([10.0, 20.0, 0.25])
    north = math.pi / 2
    # Facing north: two metres ahead is north, one metre to the left is west, height from the ground there.
    laid = place(ahead, Frame.TAKEOFF, takeoff, north).sample(0.0)
    np.testing.assert_allclose(laid.position_enu, [9.0, 22.0, 1.75], atol=1e-12)
    assert laid.yaw_rad == pytest.approx(north + 0.1)
    local = place(ahead, Frame.LOCAL, takeoff, north).sample(0.0)
    np.testing.assert_array_equal(local.position_enu, [2.0, 1.0, 1.5])
    assert local.yaw_rad == 0.1
    assert Frame("takeoff") is Frame.TAKEOFF
    with pytest.raises(ValueError, match="cannot be placed"):
        placed(ahead, np.array([0.0, math.nan, 0.0]), 0.0)


def test_step_goes_out_and_comes_back() -> None:
    step = Step(x_m=0.4, yaw_rad=0.5, at_s=1.0, hold_s=2.0, height_m=1.2)
    for time_s, x, yaw in ((0.99, 0.0, 0.0), (1.0, 0.4, 0.5), (2.99, 0.4, 0.5), (3.0, 0.0, 0.0)):
        reference = step.sample(time_s)
        np.testing.assert_array_equal(reference.position_enu, [x, 0.0, 1.2])
        assert reference.yaw_rad == yaw
    with pytest.raises(UserError, match="2 m"):
        Step(x_m=3.0)
    with pytest.raises(UserError, match="nothing would be flown"):
        Step(at_s=0.0, hold_s=0.0, settle_s=0.0)


@pytest.mark.parametrize(
    "build",
    [
        lambda: Lemniscate(x_period_s=0.0),
        lambda: Lemniscate(speed=-1.0),
        lambda: Lemniscate(rise_rate=-0.1),
        lambda: Lemniscate(speed=math.nan),
        lambda: Circle(radius_m=0.0),
        lambda: Circle(speed_m_s=math.nan),
    ],
)
def test_parameters_without_meaning_are_refused(build: object) -> None:
    with pytest.raises(UserError, match=r"it (has to|must)"):
        build()  # type: ignore[operator]


def test_resting_copies() -> None:
    point = np.array([1.0, 2.0, 3.0])
    reference = resting(point, 1)
    point[0] = 9.0
    assert reference.position_enu[0] == 1.0


def test_a_file_is_a_trajectory_like_any_other(tmp_path: object) -> None:
    path = tmp_path / "samples.csv"  # type: ignore[operator]
    rows = "\n".join(f"{t},{math.sin(t)},{math.cos(t)},1" for t in np.arange(0.0, 3.0, 0.1))
    path.write_text("t,x,y,z\n" + rows)
    trajectory = csv_trajectory(path)
    assert isinstance(trajectory, Trajectory)
    assert not stack(trajectory.sample(-1.0))[1:].any()
    np.testing.assert_allclose(
        trajectory.sample(1.55).position_enu, [math.sin(1.55), math.cos(1.55), 1], atol=1e-6
    )
