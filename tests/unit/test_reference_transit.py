"""Transits: boundary states, limits, height bounds, the short way round, run-in and run-out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.control.structs import Reference
from companion.reference.circle import Circle
from companion.reference.hold import Hold
from companion.reference.lemniscate import Lemniscate
from companion.reference.polynomial import FROM_BOUNDARY
from companion.reference.trajectory import placed, resting, wrapped
from companion.reference.transit import Transit, TransitLimits, climb, run_in, run_out, transit

LIMITS = TransitLimits(height_min_m=0.1)
BOUNDARY = ("position_enu", "velocity_enu", "acceleration_enu", "jerk_enu")


def triple(size: float) -> st.SearchStrategy[np.ndarray]:
    return st.tuples(*[st.floats(-size, size)] * 3).map(np.array)


@st.composite
def states(draw: st.DrawFn) -> Reference:
    return Reference(
        position_enu=draw(triple(20.0)),
        velocity_enu=draw(triple(2.0)),
        acceleration_enu=draw(triple(2.0)),
        jerk_enu=draw(triple(3.0)),
        snap_enu=np.zeros(3),
        yaw_rad=draw(st.floats(-20.0, 20.0)),
        yaw_rate_rad_s=draw(st.floats(-1.0, 1.0)),
        yaw_acceleration_rad_s2=draw(st.floats(-1.0, 1.0)),
    )


def assert_meets(transit_: Transit, start: Reference, end: Reference) -> None:
    for time_s, state in ((0.0, start), (transit_.duration_s, end)):
        got = transit_.sample(time_s)
        for name in BOUNDARY:
            np.testing.assert_allclose(getattr(got, name), getattr(state, name), rtol=1e-7, atol=1e-6)
        assert wrapped(got.yaw_rad - state.yaw_rad) == pytest.approx(0.0, abs=1e-8)
        assert got.yaw_rate_rad_s == pytest.approx(state.yaw_rate_rad_s, abs=1e-6)
        assert got.yaw_acceleration_rad_s2 == pytest.approx(state.yaw_acceleration_rad_s2, abs=1e-6)


def test_boundary_matrix_is_the_inverse_of_the_boundary_conditions() -> None:
    rng = np.random.default_rng(7)
    polynomial = np.polynomial.Polynomial(rng.normal(size=8))
    boundary = [polynomial.deriv(k)(s) if k else polynomial(s) for s in (0.0, 1.0) for k in range(4)]
    np.testing.assert_allclose(FROM_BOUNDARY @ boundary, polynomial.coef, atol=1e-12)


@settings(max_examples=80, deadline=None)
@given(start=states(), end=states())
def test_both_ends_are_met_whatever_they_are(start: Reference, end: Reference) -> None:
    way = transit(start, end, LIMITS)
    assert_meets(way, start, end)
    assert 0.0 < way.duration_s < math.inf


@settings(max_examples=60, deadline=None)
@given(a=triple(30.0), b=triple(30.0), yaw_a=st.floats(-9.0, 9.0), yaw_b=st.floats(-9.0, 9.0))
def test_from_rest_to_rest_all_limits_are_kept(
    a: np.ndarray, b: np.ndarray, yaw_a: float, yaw_b: float
) -> None:
    way = transit(resting(a, yaw_a), resting(b, yaw_b), LIMITS)
    assert way.within_limits
    tolerance = 1.0 + 1e-9
    for time_s in np.linspace(0.0, way.duration_s, 101):
        at = way.sample(time_s)
        assert np.linalg.norm(at.velocity_enu) <= LIMITS.speed_m_s * tolerance
        assert np.linalg.norm(at.acceleration_enu) <= LIMITS.acceleration_m_s2 * tolerance
        assert np.linalg.norm(at.jerk_enu) <= LIMITS.jerk_m_s3 * tolerance
        assert abs(at.yaw_rate_rad_s) <= LIMITS.yaw_rate_rad_s * tolerance
        assert abs(at.yaw_acceleration_rad_s2) <= LIMITS.yaw_acceleration_rad_s2 * tolerance
        # Straight and never beyond the ends.
        assert min(a[2], b[2]) - 1e-9 <= at.position_enu[2] <= max(a[2], b[2]) + 1e-9
        assert abs(at.yaw_rad - yaw_a) <= math.pi + 1e-9


def test_rest_to_rest_by_hand() -> None:
    # 7th-order rest to rest: x = d (35 s⁴ - 84 s⁵ + 70 s⁶ - 20 s⁷); peak speed 35/16 d/T at the middle.
    limits = TransitLimits(speed_m_s=0.5, acceleration_m_s2=9.0, jerk_m_s3=99.0)
    way = transit(resting(np.zeros(3), 0.0), resting(np.array([4.0, 0.0, 0.0]), 0.0), limits)
    assert way.duration_s == pytest.approx(35 / 16 * 4.0 / 0.5)
    s = 0.3
    expected = 4.0 * (35 * s**4 - 84 * s**5 + 70 * s**6 - 20 * s**7)
    assert way.sample(s * way.duration_s).position_enu[0] == pytest.approx(expected, rel=1e-12)
    assert way.sample(way.duration_s / 2).velocity_enu[0] == pytest.approx(0.5)
    assert way.peaks.speed_m_s == pytest.approx(0.5)
    # Acceleration-limited: peak is 84 √5/25 d/T² = 7.5132 d/T².
    limits = TransitLimits(speed_m_s=99.0, acceleration_m_s2=0.5, jerk_m_s3=99.0)
    way = transit(resting(np.zeros(3), 0.0), resting(np.array([0.0, 4.0, 0.0]), 0.0), limits)
    assert way.duration_s == pytest.approx(math.sqrt(7.51319 * 4.0 / 0.5), rel=1e-5)
    assert way.peaks.acceleration_m_s2 == pytest.approx(0.5, rel=1e-3)
    # Jerk-limited: 105/2 d/T³ at the middle.
    limits = TransitLimits(speed_m_s=99.0, acceleration_m_s2=99.0, jerk_m_s3=0.5)
    way = transit(resting(np.zeros(3), 0.0), resting(np.array([0.0, 0.0, 4.0]), 0.0), limits)
    assert way.duration_s == pytest.approx((52.5 * 4.0 / 0.5) ** (1 / 3))
    assert way.peaks.jerk_m_s3 == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("start", "end", "way_round"),
    [(3.0, -3.0, math.tau - 6.0), (-3.0, 3.0, 6.0 - math.tau), (0.5, 1.5, 1.0), (7.0, 0.0, math.tau - 7.0)],
)
def test_yaw_takes_the_short_way(start: float, end: float, way_round: float) -> None:
    point = np.array([0.0, 0.0, 1.0])
    way = transit(resting(point, start), resting(point, end), LIMITS)
    assert way.sample(0.0).yaw_rad == start
    assert way.sample(way.duration_s).yaw_rad - start == pytest.approx(way_round)


@settings(max_examples=40, deadline=None)
@given(start=states(), end=states(), heading=st.floats(-4.0, 4.0), origin=triple(10.0))
def test_a_transit_does_not_depend_on_where_east_is(
    start: Reference, end: Reference, heading: float, origin: np.ndarray
) -> None:
    def moved(state: Reference) -> Reference:
        still = Hold(*state.position_enu, yaw_rad=state.yaw_rad)
        at = placed(still, origin, heading).sample(0.0)
        turned = [
            placed(Hold(*getattr(state, name)), np.zeros(3), heading).sample(0.0).position_enu
            for name in ("velocity_enu", "acceleration_enu", "jerk_enu", "snap_enu")
        ]
        return Reference(
            at.position_enu, *turned, at.yaw_rad, state.yaw_rate_rad_s, state.yaw_acceleration_rad_s2
        )

    # Half a turn has no short way: rounding may choose either.
    assume(abs(abs(wrapped(end.yaw_rad - start.yaw_rad)) - math.pi) > 1e-6)
    limits = TransitLimits()
    here = transit(start, end, limits)
    there = transit(moved(start), moved(end), limits, duration_s=here.duration_s)
    carried = placed(here, origin, heading)
    for share in (0.1, 0.5, 0.8):
        a, b = carried.sample(share * here.duration_s), there.sample(share * here.duration_s)
        np.testing.assert_allclose(a.position_enu, b.position_enu, atol=1e-7)
        np.testing.assert_allclose(a.acceleration_enu, b.acceleration_enu, atol=1e-6)
        assert a.yaw_rad == pytest.approx(b.yaw_rad, abs=1e-7)


def test_run_in_to_the_lemniscate_is_gentle_and_matched() -> None:
    target = Lemniscate()
    way = run_in(target, LIMITS)
    hold = way.sample(0.0)
    assert way.within_limits
    assert_meets(way, resting(hold.position_enu, hold.yaw_rad), target.sample(0.0))
    assert way.duration_s < 3.0
    assert np.linalg.norm(hold.position_enu - target.sample(0.0).position_enu) < 1.5
    speeds = [np.linalg.norm(way.sample(t).velocity_enu) for t in np.linspace(0.0, way.duration_s, 200)]
    heights = [way.sample(t).position_enu[2] for t in np.linspace(0.0, way.duration_s, 200)]
    assert max(speeds) <= math.pi / 4 + 1e-6  # it never has to be faster than the trajectory itself
    assert min(heights) >= 0.27
    assert max(heights) <= 0.3 + 1e-9


@pytest.mark.parametrize("speed", [0.3, 1.0, 1.5])
@pytest.mark.parametrize("rise", [0.0, 0.7])
def test_run_in_keeps_to_a_floor_just_below_the_start(speed: float, rise: float) -> None:
    target = Lemniscate(speed=speed, rise_m=rise, height_m=0.55 + rise)
    limits = TransitLimits(height_min_m=0.54, acceleration_m_s2=2.0, jerk_m_s3=8.0)
    way = run_in(target, limits)
    assert way.peaks.height_min_m >= 0.54 - 1e-6
    assert way.sample(0.0).position_enu[2] >= 0.54


def test_run_in_to_a_trajectory_at_rest_waits_there() -> None:
    way = run_in(Hold(1.0, 2.0, 3.0, 0.4), LIMITS)
    for time_s in (0.0, 0.3, way.duration_s):
        np.testing.assert_allclose(way.sample(time_s).position_enu, [1.0, 2.0, 3.0], atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(time_s=st.floats(0.0, 30.0), speed=st.floats(0.2, 2.0))
def test_run_out_comes_to_rest_soon_and_keeps_its_height(time_s: float, speed: float) -> None:
    state = Lemniscate(speed=speed).sample(time_s)
    way = run_out(state, LIMITS)
    end = way.sample(way.duration_s)
    assert_meets(way, state, resting(end.position_enu, end.yaw_rad))
    assert way.peaks.height_min_m >= min(0.1, float(state.position_enu[2])) - 1e-6
    # Stopping takes the way it takes at the limit's acceleration, not a tour.
    way_needed = float(np.linalg.norm(state.velocity_enu)) ** 2 / (2 * LIMITS.acceleration_m_s2)
    assert np.linalg.norm(end.position_enu - state.position_enu) <= 4.0 * way_needed + 1.0


def test_run_out_towards_the_ground_stops_above_it() -> None:
    falling = resting(np.array([0.0, 0.0, 1.0]), 0.0)
    falling.velocity_enu[2] = -0.8
    way = run_out(falling, TransitLimits(acceleration_m_s2=2.0, jerk_m_s3=20.0, height_min_m=0.3))
    assert way.peaks.height_min_m >= 0.3 - 1e-6
    assert way.sample(way.duration_s).position_enu[2] >= 0.3


def test_run_in_then_track_then_run_out_is_smooth_at_the_joins() -> None:
    target = placed(Circle(radius_m=2.0, speed_m_s=1.5, look_ahead=True, duration_s=6.0), np.ones(3), 0.8)
    before, after = run_in(target, LIMITS), run_out(target.sample(6.0), LIMITS)
    for left, right in (
        (before.sample(before.duration_s), target.sample(0.0)),
        (target.sample(6.0), after.sample(0.0)),
    ):
        for name in BOUNDARY:
            np.testing.assert_allclose(getattr(left, name), getattr(right, name), atol=1e-9)
        assert wrapped(left.yaw_rad - right.yaw_rad) == pytest.approx(0.0, abs=1e-12)
        assert left.yaw_rate_rad_s == pytest.approx(right.yaw_rate_rad_s)


def test_climb_goes_straight_up_at_its_own_speed() -> None:
    way = climb(resting(np.array([3.0, 4.0, 0.05]), 1.1), 1.5, LIMITS, speed_m_s=0.4)
    assert way.peaks.speed_m_s <= 0.4 + 1e-9
    middle, end = way.sample(way.duration_s / 2), way.sample(way.duration_s)
    np.testing.assert_allclose(middle.position_enu[:2], [3.0, 4.0], atol=1e-12)
    np.testing.assert_allclose(end.position_enu, [3.0, 4.0, 1.5], atol=1e-12)
    assert middle.yaw_rad == pytest.approx(1.1)


def test_what_cannot_keep_to_the_limits_is_planned_all_the_same_and_says_so() -> None:
    falling = resting(np.array([0.0, 0.0, 1.5]), 0.0)
    falling.velocity_enu[:] = (0.0, 0.0, -3.0)
    target = resting(np.array([0.0, 0.0, 1.0]), 0.0)
    way = transit(falling, target, LIMITS)
    assert_meets(way, falling, target)
    # Stopping 3 m/s above the floor at 0.1 m, within 1.4 m, takes 3.2 m/s² at the least (v²/2d).
    assert not way.within_limits
    assert way.peaks.acceleration_m_s2 > 3.2
    assert way.peaks.height_min_m >= 0.1 - 1e-6


def test_what_cannot_be_planned_is_refused() -> None:
    still = resting(np.zeros(3), 0.0)
    with pytest.raises(ValueError, match="finite"):
        transit(still, resting(np.array([math.nan, 0.0, 0.0]), 0.0), LIMITS)
    with pytest.raises(ValueError, match="cannot last"):
        transit(still, still, LIMITS, duration_s=0.0)
    with pytest.raises(ValueError, match="speed_m_s"):
        TransitLimits(speed_m_s=0.0)
    with pytest.raises(ValueError, match="heights"):
        TransitLimits(height_min_m=2.0, height_max_m=1.0)


def test_a_run_out_does_not_wander_off_where_no_duration_keeps_to_the_limits():
    """Found by the campaign: leaving the lemniscate after 5.9 s took 7.4 s and led 2.9 m away."""
    flown = Lemniscate()
    for limits in (
        TransitLimits(0.8, 0.8, 2.0, height_min_m=0.25),
        TransitLimits(1.0, 1.2, 4.0, height_min_m=0.25),
    ):
        for moment_s in np.arange(3.0, 11.0, 0.1):
            state = flown.sample(float(moment_s))
            leave = run_out(state, limits)
            rest = leave.sample(leave.duration_s)
            assert leave.duration_s < 3.0
            assert np.linalg.norm(rest.position_enu - state.position_enu) < 1.6
            assert leave.peaks.acceleration_m_s2 < 2.0 * max(limits.acceleration_m_s2, 1.35)
