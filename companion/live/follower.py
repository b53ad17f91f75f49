"""From what a client sends to one smooth reference: dense streams as they are, sparse ones and jumps within limits.

What is flown is a course and two offsets that die away, each smooth up to jerk:

- the course (`course.py`) is what the newest points say, extrapolated. Missing derivatives come from the points before;
- each new point changes it a little. The difference goes into the quick offset, which is gone within a few points;
- a great difference (a jump, a point that stands alone, the way to rest) goes into the slow one, which dies away within
  the limits of a transit (`reference/transit.py`).

The law looks ahead of the vehicle by its dead time, so a change can only begin after the latest time that was sampled.
Everything follows from the points, their arrivals and the times sampled: nothing here reads a clock.
"""

from __future__ import annotations

import enum
import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from companion.control.structs import Reference, Vector
from companion.live.client_clock import ClientClock
from companion.live.course import Course, course, fitted
from companion.live.point import BadPoint, Point, PolynomialPiece
from companion.reference.polynomial import Piece, piece, piece_between
from companion.reference.trajectory import resting, wrapped
from companion.reference.transit import TransitLimits, run_out, transit

DENSE_S = 0.15
"""Points closer together than this are a motion; farther apart each is a place to go to and stop at."""
FIT_S = 0.3
"""How far back points are looked at for derivatives that were not given."""
FIT_DEGREE = 3
FIT_LEAST = 6  # points
JOIN_S = (0.08, 0.5)
"""Bounds on how long the quick offset lasts; what would take longer goes into the slow one."""
JUMP_M = 0.5
"""A position farther than this from where its stream was going begins a new one."""
LATE_S = 0.2
"""A point that arrives this much later than the quickest ones is history."""
LOOK_AHEAD_S = 0.12
"""How far ahead of the vehicle the law looks, at most: so much longer a silent stream is extrapolated."""
MOST_PIECES = 64


class Following(enum.Enum):
    """What is being flown."""

    WAITING = "waiting"
    """Nothing has come yet: the place of the start is held."""
    STREAM = "following"
    """The newest points, as they are."""
    TRANSIT = "on the way"
    """Within limits to where the points are."""
    HOLDING = "holding"
    """Nothing has come for too long, or the last point has been reached: at rest, or coming to it."""


@dataclass(frozen=True, slots=True)
class _Offset:
    """What is added to the course from `start_s` on: polynomials, the last of which ends at zero with its derivatives."""

    pieces: tuple[Piece, ...]
    start_s: float

    @property
    def end_s(self) -> float:
        return self.start_s + sum(part.duration_s for part in self.pieces)

    def at(self, time_s: float) -> Vector:
        """(5, 4): value and derivatives to snap; x, y, z, yaw."""
        since_s = max(time_s - self.start_s, 0.0)
        for part in self.pieces:
            if since_s < part.duration_s:
                return _table(part.at(since_s))
            since_s -= part.duration_s
        return np.zeros((5, 4))


class Follower:
    """A `Trajectory` in the autopilot's time whose future is told while it is flown."""

    duration_s = math.inf

    def __init__(
        self,
        start: Reference,
        now_s: float,
        limits: TransitLimits,
        silence_s: float = 0.2,
        allowed: Callable[[Vector], str] = lambda position: "",
    ) -> None:
        """Stand at `start` until points come.

        Args:
            start: in the axes of the points; where it moves, it is brought to rest.
            now_s: autopilot's clock, as all times here.
            limits: of transits; a stream's own speed is followed whatever they are.
            silence_s: without a point for so long, a stream is brought to rest.
            allowed: why a position (3,) m may not be flown to; empty when it may.
        """
        self._limits = limits
        self._silence_s = silence_s
        self._allowed = allowed
        self._clock = ClientClock()
        self._course: Course
        self._slow: _Offset | None = None
        self._quick: _Offset | None = None
        self._pieces: deque[Course] = deque()
        self._past: deque[tuple[float, Point]] = deque()  # with the autopilot's time of each point
        self._front_s = now_s  # the latest time sampled: what comes after it can still be changed
        self._newest_s = -math.inf  # autopilot's time of the newest point
        self._interval_s = math.inf  # of the stream
        self.heard_s = now_s
        """When the newest point that is followed arrived; a polynomial counts until its end."""
        self.following = Following.WAITING
        self.counters: Counter[str] = Counter()
        """What was followed, and what was refused by its reason."""
        self._rest_after(start)

    # What comes in ------------------------------------------------------------------------------------------

    def take(self, asked: Point | PolynomialPiece, arrived_s: float) -> None:
        """Follow `asked` from now on.

        Raises BadPoint with the reason for one that is not followed; `counters` has it too.
        """
        try:
            asked.require_sane()
            if isinstance(asked, PolynomialPiece):
                self.heard_s = max(arrived_s, self._take_piece(asked, arrived_s))
            else:
                self._take_point(asked, arrived_s)
                self.heard_s = arrived_s
        except BadPoint as bad:
            self.counters[str(bad).partition(":")[0]] += 1
            raise
        self.counters["followed"] += 1

    def _take_piece(self, asked: PolynomialPiece, arrived_s: float) -> float:
        """Put a piece behind those that are there; returns when it ends."""
        if len(self._pieces) >= MOST_PIECES:
            raise BadPoint(f"too many: {MOST_PIECES} pieces are waiting already")
        start_s = self._clock.take(asked.time_s, arrived_s)
        if math.isnan(asked.time_s):
            before_s = self._pieces[-1].until_s if self._pieces else self._course.until_s
            start_s = max(self._front_s, before_s) if math.isfinite(before_s) else self._front_s
        until_s = start_s + asked.duration_s
        if until_s <= self._front_s:
            raise BadPoint("late: the piece is over")
        coefficients = np.array(asked.coefficients, dtype=np.float64)
        if np.isnan(coefficients[3]).any():
            coefficients[3] = 0.0
            coefficients[3, 0] = self._now().yaw_rad
        exponents = np.arange(coefficients.shape[1])
        for moment_s in np.linspace(0.0, asked.duration_s, 9):
            self._require_allowed(coefficients[:3] @ moment_s**exponents)
        self._past.clear()
        self._pieces.append(course(coefficients, start_s, until_s))
        return until_s

    def _take_point(self, point: Point, arrived_s: float) -> None:
        time_s = self._clock.take(point.time_s, arrived_s)
        if time_s == self._newest_s:
            raise BadPoint("repeated: a point of this time has come")
        if time_s < self._newest_s:
            raise BadPoint("out of order: a newer point has come")
        if arrived_s - time_s > LATE_S:
            raise BadPoint(f"late: by {arrived_s - time_s:.2f} s")
        flown = self._course.at(self._front_s)
        whole = _completed(point, flown)
        self._require_allowed(whole.position)
        if math.isfinite(self._newest_s):
            gap_s = time_s - self._newest_s
            known = math.isfinite(self._interval_s)
            self._interval_s = 0.7 * self._interval_s + 0.3 * gap_s if known else gap_s
        self._newest_s = time_s
        self._pieces.clear()
        if self._past and self._jumped(point, time_s):
            self._past.clear()
        self._past.append((time_s, point))
        while self._past[0][0] < time_s - FIT_S:
            self._past.popleft()
        dense = self._interval_s < DENSE_S
        moves = not np.isnan(point.velocity).all() or not np.isnan(point.acceleration).all()
        alone = not dense and not np.isnan(point.position).any() and math.isfinite(self._interval_s)
        if alone or not (moves or dense):
            self._change_to(_standing(whole.position, whole.yaw_rad, time_s), smoothly=True)
        elif (
            moves or len(self._past) >= FIT_LEAST
        ):  # of a dense stream's first positions nothing can be made yet
            self._change_to(self._course_of(whole, time_s, flown))

    def _jumped(self, point: Point, time_s: float) -> bool:
        """Whether the point lies off where the one before was going."""
        before_s, before = self._past[-1]
        way = np.nan_to_num(point.position - before.position)
        going = self._course.at(time_s).velocity_enu * (time_s - before_s)
        return min(float(np.linalg.norm(way)), float(np.linalg.norm(way - going))) > JUMP_M

    def _require_allowed(self, position: Vector) -> None:
        why = self._allowed(position)
        if why:
            raise BadPoint(why)

    def _course_of(self, point: Point, time_s: float, flown: Reference) -> Course:
        """The newest point with its derivatives: given, or found from the points before it."""
        given = np.stack([point.position, point.velocity, point.acceleration, point.jerk], axis=1)
        derivatives = np.zeros((4, 4))  # rows x, y, z, yaw; columns p, v, a, j
        derivatives[:3] = np.nan_to_num(given)
        derivatives[3, :2] = point.yaw_rad, np.nan_to_num(point.yaw_rate_rad_s)
        if len(self._past) >= FIT_LEAST:
            self._find_derivatives(derivatives, given, point.yaw_rate_rad_s)
        free = np.flatnonzero(np.isnan(self._past[-1][1].position))
        ahead_s = self._front_s - time_s
        for axis in free:  # no place was asked for: the course goes on from where it is
            _, v, a, j = derivatives[axis]
            derivatives[axis, 0] = flown.position_enu[axis] - ahead_s * (
                v + ahead_s * (a / 2.0 + ahead_s * j / 6.0)
            )
        until_s = time_s + self._silence_s + LOOK_AHEAD_S
        return course(derivatives / _FACTORIALS, time_s, until_s)

    def _find_derivatives(self, derivatives: Vector, given: Vector, yaw_rate_rad_s: float) -> None:
        """Fill what was not given, in place: the highest derivative that always was given tells those above it."""
        times = np.array([moment_s for moment_s, _ in self._past])
        table = np.array(
            [(p.position, p.velocity, p.acceleration) for _, p in self._past]
        )  # (n, order, axis)
        series = np.zeros((len(times), 4))
        series[:, 3] = [p.yaw_rad for _, p in self._past]
        known = ~np.isnan(table).any(axis=0)
        highest = np.array([int(np.flatnonzero(column)[-1]) if column.any() else -1 for column in known.T])
        for axis in np.flatnonzero(highest >= 0):
            series[:, axis] = table[:, highest[axis], axis]
        turns = not np.isnan(series[:, 3]).any()
        series[:, 3] = np.unwrap(series[:, 3]) if turns else 0.0
        above = fitted(times, series, FIT_DEGREE) * _FACTORIALS  # (4, 4): the series and its derivatives
        for axis in np.flatnonzero(highest >= 0):
            for order in range(highest[axis] + 1, 4):
                if math.isnan(given[axis, order]):
                    derivatives[axis, order] = above[axis, order - highest[axis]]
        if turns and math.isnan(yaw_rate_rad_s):
            derivatives[3, 1:] = above[3, 1:]

    # What is flown ------------------------------------------------------------------------------------------

    def sample(self, time_s: float) -> Reference:
        """The reference at `time_s`, autopilot's clock. Raises ValueError for NaN."""
        if math.isnan(time_s):
            raise ValueError("trajectory sampled at time NaN")
        while self._pieces and time_s >= self._pieces[0].start_s:
            self._change_to(self._pieces.popleft())
        if time_s > self._course.until_s and not self._pieces:
            self._rest_after(self._now())
            self.following = Following.HOLDING
            self.counters["smooth stops"] += 1
        self._front_s = max(self._front_s, time_s)
        if self._slow is not None and self._front_s >= self._slow.end_s:
            self._slow = None
            if self.following is Following.TRANSIT:
                self.following = (
                    Following.STREAM if math.isfinite(self._course.until_s) else Following.HOLDING
                )
        return self._at(time_s)

    def _now(self) -> Reference:
        """What is flown at the first moment that can still be changed."""
        return self._at(self._front_s)

    def _at(self, time_s: float) -> Reference:
        course = self._course.at(time_s)
        if self._slow is None and self._quick is None:
            return course
        return _reference(
            _table(course) + self._offset(self._slow, time_s) + self._offset(self._quick, time_s)
        )

    @staticmethod
    def _offset(offset: _Offset | None, time_s: float) -> Vector | float:
        return offset.at(time_s) if offset is not None else 0.0

    def _change_to(self, target: Course, smoothly: bool = False) -> None:
        """Fly `target` from now on; the difference to what is flown dies away. `smoothly`: within the limits."""
        from_s = self._front_s
        change = _table(self._course.at(from_s)) - _table(target.at(from_s))
        change[0, 3] = wrapped(change[0, 3])
        gap = change + self._offset(self._quick, from_s)
        self._course = target
        length_s = self._time_for(gap)
        if length_s <= JOIN_S[1] and not smoothly:
            self._quick = _Offset((piece_between(length_s, gap[:4], np.zeros((4, 4))),), from_s)
            if self.following is not Following.TRANSIT:
                self.following = Following.STREAM
            return
        gap += self._offset(self._slow, from_s)
        self._quick = None
        self._slow = _Offset(self._way_out(_reference(gap)), from_s)
        self.following = Following.TRANSIT

    def _way_out(self, gap: Reference) -> tuple[Piece, ...]:
        """How the offset `gap` dies away within the limits: at once, or, where that would break them, after a stop."""
        way = transit(gap, _NOTHING, self._limits)
        if way.within_limits:
            return (way.piece,)
        stop = run_out(gap, self._limits)
        return stop.piece, transit(stop.sample(stop.duration_s), _NOTHING, self._limits).piece

    def _time_for(self, gap: Vector) -> float:
        """How long the offset `gap` (5, 4) takes to die away without asking for much acceleration of its own, s."""
        sizes = np.sqrt((gap[:2, :3] ** 2).sum(axis=1))
        accelerations = np.array([self._limits.acceleration_m_s2, self._limits.yaw_acceleration_rad_s2])
        ways = np.array([sizes[0], abs(gap[0, 3])]) / accelerations
        speeds = np.array([sizes[1], abs(gap[1, 3])]) / accelerations
        least_s = max(3.0 * self._interval_s if self._interval_s < DENSE_S else 0.0, JOIN_S[0])
        return max(min(least_s, JOIN_S[1]), math.sqrt(10.0 * float(ways.max())), 5.0 * float(speeds.max()))

    def _rest_after(self, now: Reference) -> None:
        """The smooth stop from `now`; what stands at its end is held for good."""
        way = run_out(now, self._limits)
        end = way.sample(way.duration_s)
        self._course = _standing(end.position_enu, end.yaw_rad, self._front_s)
        coefficients = way.piece.coefficients.copy()
        coefficients[:, 0] -= (*end.position_enu, end.yaw_rad)
        self._slow, self._quick = _Offset((piece(way.duration_s, coefficients),), self._front_s), None
        self._past.clear()
        self._interval_s = math.inf


_FACTORIALS = np.array([1.0, 1.0, 2.0, 6.0])
_NOTHING = resting(np.zeros(3), 0.0)


def _standing(position: Vector, yaw_rad: float, from_s: float) -> Course:
    """The course that stays at `position` (3,) m."""
    return course(np.array([*position, yaw_rad])[:, None], from_s)


def _table(reference: Reference) -> Vector:
    """(5, 4): rows p, v, a, j, s; columns x, y, z, yaw. Yaw's jerk and snap are not known to a reference: 0."""
    table = np.zeros((5, 4))
    table[0, :3], table[1, :3] = reference.position_enu, reference.velocity_enu
    table[2, :3], table[3, :3], table[4, :3] = (
        reference.acceleration_enu,
        reference.jerk_enu,
        reference.snap_enu,
    )
    table[:3, 3] = reference.yaw_rad, reference.yaw_rate_rad_s, reference.yaw_acceleration_rad_s2
    return table


def _reference(table: Vector) -> Reference:
    rows = np.ascontiguousarray(table[:, :3])
    yaw, yaw_rate, yaw_acceleration = table[:3, 3].tolist()
    return Reference(rows[0], rows[1], rows[2], rows[3], rows[4], yaw, yaw_rate, yaw_acceleration)


def _completed(point: Point, flown: Reference) -> Point:
    """`point` with what it leaves to us: place, speed and heading of the course as it is."""
    position = np.where(np.isnan(point.position), flown.position_enu, point.position)
    free = np.isnan(point.position) & np.isnan(point.velocity)
    velocity = np.where(free, flown.velocity_enu, point.velocity)
    yaw_rad = flown.yaw_rad if math.isnan(point.yaw_rad) else point.yaw_rad
    return replace(point, position=position, velocity=velocity, yaw_rad=yaw_rad)
