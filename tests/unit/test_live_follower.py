"""What a stream of points becomes: the same motion where it is dense, a smooth one within limits where it is not."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.live.follower import Follower, Following
from companion.live.point import BadPoint, Point, PolynomialPiece
from companion.reference.lemniscate import Lemniscate
from companion.reference.trajectory import resting
from companion.reference.transit import TransitLimits

LIMITS = TransitLimits(speed_m_s=1.5, acceleration_m_s2=2.0, jerk_m_s3=8.0)
LEMNISCATE = Lemniscate()
STEP_S, LOOK_S = 0.01, 0.08


class Flown:
    """References every 10 ms as a law with 80 ms of dead time asks for them, and the truth beside them."""

    def __init__(self, follower: Follower, arrivals: list[tuple[float, Point]], until_s: float) -> None:
        self.follower = follower
        waiting = sorted(arrivals, key=lambda item: item[0])
        self.times, self.references = [], []
        for step in range(round(until_s / STEP_S)):
            now_s = step * STEP_S
            while waiting and waiting[0][0] <= now_s:
                arrived_s, point = waiting.pop(0)
                try:
                    follower.take(point, arrived_s)
                except BadPoint:
                    continue
            follower.sample(now_s)
            self.times.append(now_s + LOOK_S)
            self.references.append(follower.sample(now_s + LOOK_S))

    def error(self, from_s: float, to_s: float = math.inf) -> float:
        """RMS distance from the lemniscate, m."""
        gaps = [
            np.linalg.norm(r.position_enu - LEMNISCATE.sample(t).position_enu)
            for t, r in zip(self.times, self.references, strict=True)
            if from_s <= t < to_s
        ]
        return float(np.sqrt(np.mean(np.square(gaps))))

    def require_continuous(self, acceleration_m_s2: float, jump_m_s2: float = 1.5) -> None:
        """Position, velocity and acceleration without steps, and accelerations within a bound."""
        p, v, a = (
            np.array([getattr(r, f"{name}_enu") for r in self.references])
            for name in ("position", "velocity", "acceleration")
        )
        assert np.isfinite(p).all() and np.isfinite(v).all() and np.isfinite(a).all()
        assert np.abs(p[1:] - p[:-1] - STEP_S * (v[1:] + v[:-1]) / 2.0).max() < 1e-3
        assert np.abs(v[1:] - v[:-1] - STEP_S * (a[1:] + a[:-1]) / 2.0).max() < 0.02
        assert np.abs(np.diff(a, axis=0)).max() < jump_m_s2
        assert np.linalg.norm(a, axis=1).max() < acceleration_m_s2


def stream(
    what: str,
    rate_hz: float = 50.0,
    until_s: float = 20.0,
    loss: float = 0.0,
    jitter_s: float = 0.0,
    changed: Callable[[float, Point], Point | None] = lambda t, point: point,
) -> list[tuple[float, Point]]:
    """The report's lemniscate from 1 s on as a client sends it, its clock 100 s ahead: (arrival, point)."""
    draw = random.Random(1)
    sent = []
    for k in range(round((until_s - 1.0) * rate_hz)):
        t = 1.0 + k / rate_hz
        r = LEMNISCATE.sample(t)
        given = {
            name: getattr(r, f"{name}_enu").copy()
            for name in ("position", "velocity", "acceleration")
            if name[0] in what
        }
        point = changed(t, Point(time_s=t + 100.0, **given))
        if point is not None and draw.random() >= loss:
            sent.append((t + draw.random() * jitter_s, point))
    return sent


def at_start() -> Follower:
    return Follower(resting(LEMNISCATE.sample(0.0).position_enu, 0.0), 0.0, LIMITS)


@pytest.mark.parametrize(
    ("what", "rate_hz", "within_m"),
    [
        ("pva", 50, 1e-3),
        ("pv", 50, 1.5e-3),
        ("p", 50, 0.01),
        ("pva", 20, 1.5e-3),
        ("p", 20, 0.012),
        ("p", 100, 0.01),
        ("pv", 10, 3e-3),
        ("p", 10, 0.06),
    ],
)
def test_a_dense_stream_is_followed_as_it_is(what: str, rate_hz: float, within_m: float) -> None:
    flown = Flown(at_start(), stream(what, rate_hz), 20.0)
    assert flown.error(5.0) < within_m
    assert flown.follower.following is Following.STREAM
    flown.require_continuous(acceleration_m_s2=4.5 if "v" in what else 7.0)


@pytest.mark.parametrize(("what", "within_m"), [("pva", 2e-3), ("p", 0.015)])
def test_loss_jitter_and_reordering_cost_little(what: str, within_m: float) -> None:
    flown = Flown(at_start(), stream(what, loss=0.05, jitter_s=0.04), 20.0)
    assert flown.error(5.0) < within_m
    assert flown.follower.counters["out of order"] > 50
    flown.require_continuous(acceleration_m_s2=9.0, jump_m_s2=4.0)


@pytest.mark.parametrize(("noise_m", "within_m"), [(0.001, 0.015), (0.003, 0.04), (0.02, 0.2)])
def test_noise_and_rounding_make_it_slower_and_not_wild(noise_m: float, within_m: float) -> None:
    """Positions alone of a motion-capture system, or rounded to centimetres (0.003 m): the lemniscate's own 2.5 m/s² and
    what a low-pass leaves of the noise; twice differentiated at 50 Hz as it comes, 0.01 m would be 60 m/s²."""
    draw = random.Random(3)

    def noisy(_t: float, point: Point) -> Point:
        point.position[:] += [draw.gauss(0.0, noise_m) for _ in range(3)]
        return point

    flown = Flown(at_start(), stream("p", changed=noisy), 20.0)
    assert flown.error(5.0) < within_m
    flown.require_continuous(acceleration_m_s2=7.0)
    assert flown.follower.following is Following.STREAM


def test_a_point_from_which_no_stop_stays_inside_is_refused() -> None:
    """At 3 m/s: 0.32 s of going on, then 3²/2.5 · 0.94 = 3.4 m: 4.3 m and a bit before the wall at 10 m."""
    follower = Follower(
        resting(np.array([3.0, 0.0, 2.0]), 0.0),
        0.0,
        LIMITS,
        allowed=lambda p, a: "outside" if p[0] > 10 else "",
    )
    fast = np.array([3.0, 0.0, 0.0])
    follower.take(Point(1.0, np.array([5.0, 0.0, 2.0]), fast), 1.0)
    with pytest.raises(BadPoint, match="too fast to stop in time: outside"):
        follower.take(Point(1.1, np.array([6.0, 0.0, 2.0]), fast), 1.1)
    follower.sample(1.3)
    follower.take(Point(1.3, np.array([9.9, 0.0, 2.0]), np.zeros(3)), 1.3)


def test_velocity_alone_is_integrated() -> None:
    flown = Flown(at_start(), stream("v"), 20.0)
    velocities = np.array([r.velocity_enu for r in flown.references[500:]])
    true = np.array([LEMNISCATE.sample(t).velocity_enu for t in flown.times[500:]])
    assert np.abs(velocities - true).max() < 0.02
    apart = [
        r.position_enu - LEMNISCATE.sample(t).position_enu
        for t, r in zip(flown.times, flown.references, strict=True)
    ]
    assert (
        np.ptp(np.array(apart[500:]), axis=0).max() < 0.02
    )  # it is offset by what it missed at first, and does not drift


def test_single_positions_are_places_to_stop_at() -> None:
    """Two metres away with 1.5 m/s, 2 m/s² and 8 m/s³: rest to rest in 35/16·2/1.5 = 2.9 s."""
    follower = Follower(resting(np.zeros(3), 0.0), 0.0, LIMITS)
    flown = Flown(follower, [(1.0, Point(position=np.array([2.0, 0.0, 0.0]), yaw_rad=1.0))], 8.0)
    x = np.array([r.position_enu[0] for r in flown.references])
    arrived_s = flown.times[int(np.argmax(x > 2.0 - 1e-6))]
    assert arrived_s == pytest.approx(1.0 + 35.0 / 16.0 * 2.0 / 1.5, abs=0.15)
    assert x[-1] == pytest.approx(2.0) and flown.references[-1].yaw_rad == pytest.approx(1.0)
    assert max(np.linalg.norm(r.velocity_enu) for r in flown.references) < 1.5 * 1.001
    assert follower.following is Following.HOLDING


def test_a_place_that_is_sent_again_and_again_is_gone_to_at_once() -> None:
    """As MAVSDK repeats a position setpoint 20 times a second: two metres in 2.9 s, and the second point tells it."""
    places = [(1.0 + 0.05 * k, Point(position=np.array([2.0 * (k >= 40), 0.0, 0.0]))) for k in range(160)]
    flown = Flown(Follower(resting(np.zeros(3), 0.0), 0.0, LIMITS), places, 8.9)
    x = np.array([r.position_enu[0] for r in flown.references])
    arrived_s = flown.times[int(np.argmax(x > 2.0 - 1e-6))]
    assert arrived_s == pytest.approx(3.0 + 35.0 / 16.0 * 2.0 / 1.5, abs=0.25)
    assert max(np.linalg.norm(r.velocity_enu) for r in flown.references) < 1.5 * 1.001
    assert x[-1] == pytest.approx(2.0, abs=1e-6)


def test_a_stick_by_velocities_starts_and_stops_smoothly() -> None:
    """1 m/s along x for 3 s at 20 Hz, then 0: 3 m, and what starting and stopping within 2 m/s² and 8 m/s³ take."""
    sent = [(1.0 + 0.05 * k, Point(velocity=np.array([1.0 * (k < 60), 0.0, 0.0]))) for k in range(140)]
    flown = Flown(Follower(resting(np.zeros(3), 0.0), 0.0, LIMITS), sent, 8.0)
    flown.require_continuous(acceleration_m_s2=3.0)
    velocities = np.array([r.velocity_enu[0] for r in flown.references])
    assert velocities[300:380] == pytest.approx(1.0, abs=0.01) and velocities[-50:] == pytest.approx(
        0.0, abs=0.01
    )
    assert flown.references[-1].position_enu[0] == pytest.approx(3.0, abs=0.1)


def test_a_stream_that_stops_comes_to_rest_and_goes_on_when_it_returns() -> None:
    silent = stream("pva", until_s=25.0, changed=lambda t, point: None if 10.0 < t < 14.0 else point)
    flown = Flown(at_start(), silent, 25.0)
    at_rest = [r for t, r in zip(flown.times, flown.references, strict=True) if 13.0 < t < 14.0]
    assert max(np.linalg.norm(r.velocity_enu) for r in at_rest) < 1e-9
    assert flown.follower.counters["smooth stops"] == 1
    # 0.2 s of silence and the look-ahead, then 1.1 m/s are taken off within the limits
    stopped_at = next(r.position_enu for t, r in zip(flown.times, flown.references, strict=True) if t > 13.0)
    assert np.linalg.norm(stopped_at - LEMNISCATE.sample(10.3).position_enu) < 1.0
    assert flown.error(20.0) < 1e-3
    flown.require_continuous(acceleration_m_s2=5.5)


@pytest.mark.parametrize("what", ["pva", "p"])
def test_a_jump_of_ten_metres_is_flown_within_limits(what: str) -> None:
    def moved(t: float, point: Point) -> Point:
        if 8.0 < t < 16.0:
            point.position[0] += 10.0
        return point

    flown = Flown(at_start(), stream(what, until_s=40.0, changed=moved), 40.0)
    speeds = [np.linalg.norm(r.velocity_enu) for r in flown.references]
    assert max(speeds) < 1.5 + 1.2  # the transit's and the stream's own
    flown.require_continuous(acceleration_m_s2=2.0 + (2.5 if what == "pva" else 4.0))
    assert flown.error(34.0) < 0.01


def test_what_cannot_be_followed_is_counted_and_refused_in_words() -> None:
    follower = Follower(
        resting(np.zeros(3), 0.0),
        0.0,
        LIMITS,
        allowed=lambda p, a: "outside: of the fence" if p[0] > 5 else "",
    )
    here = np.array([0.1, 0.0, 0.0])
    follower.take(Point(10.0, here), 1.0)
    for point, words in (
        (Point(10.0, here), "repeated"),
        (Point(9.9, here), "out of order"),
        (Point(10.05, np.array([math.inf, 0, 0])), "position is infinite"),
        (Point(10.05), "holds neither position"),
        (Point(10.05, np.array([2e5, 0, 0])), "beyond 100000 m"),
        (Point(10.05, here, velocity=np.array([0, 80.0, 0])), "beyond 50 m/s"),
        (Point(10.05, np.array([6.0, 0, 0])), "outside: of the fence"),
        (PolynomialPiece(np.zeros((4, 12)), 1.0), "1 to 10 coefficients"),
        (PolynomialPiece(np.full((4, 3), math.nan), 1.0), "not a finite number"),
        (PolynomialPiece(np.zeros((4, 3)), -1.0), "duration"),
    ):
        with pytest.raises(BadPoint, match=words):
            follower.take(point, 1.05)
    with pytest.raises(BadPoint, match=r"late: by 0\.35 s"):
        follower.take(Point(10.1, here), 1.45)
    assert follower.counters["followed"] == 1 and sum(follower.counters.values()) == 12
    assert follower.heard_s == 1.05  # by the one outside the fence: its client is there


def test_polynomial_pieces_follow_one_another() -> None:
    """The second begins where and as the first ends: x = t² for a second, then on at 2 m/s."""
    first = np.zeros((4, 10))
    first[0, 2], first[3] = 1.0, math.nan
    second = np.zeros((4, 4))
    second[0, :2] = 1.0, 2.0
    follower = Follower(resting(np.zeros(3), 0.0), 0.0, TransitLimits(3.0, 4.0, 40.0))
    follower.take(PolynomialPiece(first, 1.0), 0.0)
    follower.take(PolynomialPiece(second, 2.0), 0.0)
    x = {t: follower.sample(t).position_enu[0] for t in np.arange(0.0, 6.0, 0.01).round(2).tolist()}
    assert x[0.95] == pytest.approx(0.95**2, abs=0.02)
    assert x[2.5] == pytest.approx(1.0 + 2.0 * 1.5, abs=0.01)
    assert follower.heard_s == pytest.approx(3.0)
    assert follower.following is Following.HOLDING and x[5.99] == pytest.approx(x[5.5])


numbers = st.one_of(st.floats(-3.0, 3.0), st.just(math.nan), st.floats(width=32))
points = st.builds(
    Point,
    time_s=st.one_of(st.just(math.nan), st.floats(0.0, 5.0)),
    position=st.tuples(numbers, numbers, numbers).map(np.array),
    velocity=st.tuples(numbers, numbers, numbers).map(np.array),
    acceleration=st.one_of(st.just(np.full(3, math.nan)), st.tuples(numbers, numbers, numbers).map(np.array)),
    yaw_rad=numbers,
)


@given(st.lists(st.tuples(st.floats(0.0, 3.0), points), max_size=40))
@settings(max_examples=60, deadline=None)
def test_nothing_that_can_come_in_makes_a_step(arrivals: list[tuple[float, Point]]) -> None:
    near = Follower(
        resting(np.zeros(3), 0.0),
        0.0,
        LIMITS,
        allowed=lambda p, a: "far: away" if np.abs(p).max() > 20.0 else "",
    )
    flown = Flown(near, arrivals, 6.0)
    p, v = (
        np.array([getattr(r, f"{name}_enu") for r in flown.references]) for name in ("position", "velocity")
    )
    assert np.isfinite(p).all() and np.isfinite(v).all()
    assert np.abs(p[1:] - p[:-1] - STEP_S * (v[1:] + v[:-1]) / 2.0).max() < 0.05


def test_a_client_with_another_clock_is_followed_once_the_first_is_gone() -> None:
    """Its clock is 0.6 s behind the first one's: without forgetting that one, its points would be 0.6 s late for 5 s."""
    follower = Follower(resting(np.zeros(3), 0.0), 0.0, LIMITS)
    here = np.zeros(3)
    for k in range(20):
        follower.take(Point(100.0 + 0.02 * k, here, here), 1.0 + 0.02 * k)
    other = [(Point(99.4 + 0.5 + 0.02 * k, here, here), 1.5 + 0.02 * k) for k in range(3)]
    with pytest.raises(BadPoint):
        follower.take(*other[0])
    follower.forget_client()
    for point, arrived_s in other[1:]:
        follower.take(point, arrived_s)


def test_a_yaw_rate_alone_turns_at_that_rate_and_a_yaw_that_is_given_is_reached() -> None:
    still = np.zeros(3)
    turning = [(1.0 + 0.05 * k, Point(velocity=still, yaw_rate_rad_s=0.4)) for k in range(80)]
    asked = [(5.0 + 0.05 * k, Point(velocity=np.array([1.0, 0, 0]), yaw_rad=-2.0)) for k in range(140)]
    flown = Flown(Follower(resting(still, 0.0), 0.0, LIMITS), turning + asked, 12.0)
    rates = np.array([r.yaw_rate_rad_s for r in flown.references])
    assert rates[250:450] == pytest.approx(0.4, abs=0.01)
    assert math.remainder(flown.references[-1].yaw_rad + 2.0, math.tau) == pytest.approx(0.0, abs=1e-3)
    assert flown.references[-1].velocity_enu[0] == pytest.approx(1.0, abs=0.01)
