"""From what a client sends to one smooth reference: dense streams as they are, sparse ones and jumps within limits.

What is flown is a course and two offsets that die away, all of it smooth up to jerk:

- the course (`course.py`) is what the newest points say, extrapolated. Missing derivatives come from the points before,
  by least squares that forget (the older a point, the less it counts), so that noise and rounding stay small;
- each new point changes it a little. The difference goes into the quick offset, a linear filter with one fourfold pole:
  whatever is put into it, it stays bounded and dies away;
- a great difference (a jump, the start of a stream, a point that stands alone, the way to rest) goes into the slow one,
  planned once within the limits of a transit (`reference/transit.py`).

So a smooth stream is flown without lag, and a rough one as a low-pass would. The law looks ahead of the vehicle by its
dead time, so a change can only begin after the latest time that was sampled. Everything follows from the points, their
arrivals and the times sampled: nothing here reads a clock.
"""

from __future__ import annotations

import bisect
import enum
import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from companion.control.structs import Reference, Vector
from companion.live.client_clock import ClientClock
from companion.live.course import Course, course, reference_of
from companion.live.fading_fit import FadingFit
from companion.live.offsets import Decay, Way, place_left, way_out
from companion.live.point import BadPoint, Point, PolynomialPiece
from companion.reference.polynomial import piece
from companion.reference.trajectory import wrapped
from companion.reference.transit import TransitLimits, run_out

DENSE_S = 0.15
"""Points closer together than this are a motion; farther apart each is a place to go to and stop at."""
FIT_POINTS = (12, 20, 30)
"""From so many points on a stream without derivatives is followed: by a straight line, a parabola, a cubic."""
FORGETTING = 1.2
"""How quickly a fit forgets, in the poles of what follows it: a point's square counts e^(−1.2 λ · age)."""
QUICKEST_1_S, SLOWEST_1_S = 12.0, 5.0
"""Bounds of the quick offset's pole: 12/s works 0.1 m off with 4.5 m/s² at most, 5/s with 0.8."""
ROUGH_M = 1.5e-3
"""Noise up to which a stream is followed as quickly as that; with more, its fourth root as much more slowly."""
JUMP_M = 0.15
"""A position farther than this from where its stream was going begins a new one."""
JUMP_M_S, JUMP_RAD = 0.5, 0.5
"""Likewise for a velocity that was given, and for yaw."""
JUMPS_APART_S = 0.2
"""Planning a way within limits takes milliseconds: more often than this jumps are refused."""
LATE_S = 0.2
"""A point that arrives this much later than the quickest ones is history."""
LOOK_AHEAD_S = 0.12
"""How far ahead of the vehicle the law looks, at most: so much longer a silent stream is extrapolated."""
STOP_M_S2, STOP_M_S3 = 2.5, 10.0
"""Least limits of a stop after silence: a stream may have been quicker than transits are, and the fence near."""
STOP_SHARE = 0.55
"""Way of a stop (`run_out`), as a share of its speed and time: a half, and what a duration tried is too long."""
MOST_PIECES = 64
PIECE_SAMPLES = 33
_STILL: Vector = np.zeros(3)
_NONE: Vector = np.zeros(4, dtype=bool)


class OutOfBounds(BadPoint):
    """A point that is well meant and may not be flown: its client is there."""


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


class Follower:
    """A `Trajectory` in the autopilot's time whose future is told while it is flown."""

    duration_s = math.inf

    def __init__(
        self,
        start: Reference,
        now_s: float,
        limits: TransitLimits,
        silence_s: float = 0.2,
        allowed: Callable[[Vector, Vector], str] = lambda position, acceleration: "",
    ) -> None:
        """Stand at `start` until points come.

        Args:
            start: in the axes of the points; where it moves, it is brought to rest.
            now_s: autopilot's clock, as all times here.
            limits: of transits; a stream's own speed is followed whatever they are.
            silence_s: without a point for so long, a stream is brought to rest.
            allowed: why a position (3,) m may not be flown to with an acceleration (3,) m/s²; empty when it may.
        """
        self._limits = limits
        self._stop_limits = stop_limits(limits)
        self._silence_s = silence_s
        self._allowed = allowed
        self._clock = ClientClock()
        self._course: Course
        self._slow: Way | None = None
        self._quick: Decay | None = None
        self._pole_1_s = QUICKEST_1_S
        self._yaw_rad = 0.0  # of the fit, unwrapped
        self._jump_to_fly = False  # the points have jumped since the course was changed last
        self._planned_s = -math.inf  # when the slow offset was planned
        self._pieces: deque[Course] = deque()
        self._fit = FadingFit()
        self._fitted: tuple[
            int, ...
        ] = ()  # what it is fitted to: the highest derivative given of x, y, z, yaw
        self._last: Vector | None = None  # the newest point of the stream, as `_given`
        self._front_s = now_s  # the latest time sampled: what comes after it can still be changed
        self._newest_s = -math.inf  # autopilot's time of the newest point
        self._interval_s = math.inf  # of the stream
        self.heard_s = now_s
        """When something worth following arrived last; a polynomial counts until its end."""
        self.following = Following.WAITING
        self.counters: Counter[str] = Counter()
        """What was followed, and what was refused by its reason."""
        self._rest_after(start)

    # What comes in ------------------------------------------------------------------------------------------

    @property
    def is_full(self) -> bool:
        """Whether no further piece is taken now."""
        return len(self._pieces) >= MOST_PIECES

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
            if isinstance(bad, OutOfBounds):
                self.heard_s = max(self.heard_s, arrived_s)
            raise
        self.counters["followed"] += 1

    def forget_client(self) -> None:
        """Another may be next, with a clock of its own; what is flown goes on."""
        self._clock, self._newest_s, self._interval_s = ClientClock(), -math.inf, math.inf
        self._forget()

    def _take_piece(self, asked: PolynomialPiece, arrived_s: float) -> float:
        """Put a piece behind those that are there; returns when it ends."""
        if self.is_full:
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
            coefficients[3, 0] = self._table_at(self._front_s)[0, 3]
        way = course(coefficients, start_s, until_s)
        for moment_s in np.linspace(start_s, until_s, PIECE_SAMPLES).tolist():
            self._require_allowed(way, moment_s)
        self._forget()
        self._pieces.append(way)
        return until_s

    def _take_point(self, point: Point, arrived_s: float) -> None:
        time_s = self._clock.take(point.time_s, arrived_s)
        if time_s == self._newest_s:
            raise BadPoint("repeated: a point of this time has come")
        if time_s < self._newest_s:
            raise BadPoint("out of order: a newer point has come")
        if arrived_s - time_s > LATE_S:
            raise BadPoint(f"late: by {arrived_s - time_s:.2f} s")
        given = _given(point)
        unknown = np.isnan(given)
        flown = self._course.at(self._front_s)
        place = np.where(unknown[0], flown[0], given[0])
        self._require_place(place[:3])
        if math.isfinite(self._newest_s):
            gap_s = time_s - self._newest_s
            known = math.isfinite(self._interval_s)
            self._interval_s = 0.7 * self._interval_s + 0.3 * gap_s if known else gap_s
        stands = self._last is not None and np.array_equal(given[0], self._last[0], equal_nan=True)
        jumped = self._jumped(given, time_s)
        self._newest_s, self._last = time_s, given
        self._pieces.clear()
        self._take_into_fit(given, unknown, time_s, jumped)
        self._jump_to_fly |= jumped
        dense = self._interval_s < DENSE_S
        moves = not unknown[1:3, :3].all()
        alone = not dense and not unknown[0, :3].any() and math.isfinite(self._interval_s)
        if alone or not (moves or dense) or (stands and not moves and self._fit.count < FIT_POINTS[0]):
            self._change_to(course(place[:, None], time_s), smoothly=True)
        elif (
            moves or self._fit.count >= FIT_POINTS[0]
        ):  # of the first positions alone nothing can be made yet
            target = self._course_of(given, unknown, time_s, flown)
            self._require_allowed(target, time_s)
            self._change_to(target, found=not moves, free=unknown[0])

    def _jumped(self, given: Vector, time_s: float) -> bool:
        """Whether place or velocity lie off where those before were going."""
        if self._last is None:
            return False
        steps = given[:2, :3] - self._last[:2, :3]
        steps[np.isnan(steps)] = 0.0
        going = self._course.at(time_s)[1:3, :3] * (time_s - self._newest_s)
        return any(
            min(_length(steps[order]), _length(steps[order] - going[order])) > most
            for order, most in enumerate((JUMP_M, JUMP_M_S))
        )

    def _take_into_fit(self, given: Vector, unknown: Vector, time_s: float, jumped: bool) -> None:
        """The highest derivative that is given tells those above it; another one, or a jump, begins a new fit."""
        known = ~unknown
        highest = tuple(2 if a else 1 if v else 0 if p else -1 for p, v, a in known[:3].T.tolist())
        if highest[3] != 0:  # a yaw with its rate is known well enough
            highest = (*highest[:3], -1)
        if jumped or highest != self._fitted:
            self._fit, self._fitted = FadingFit(), highest
        series = np.array([given[h, axis] if h >= 0 else 0.0 for axis, h in enumerate(highest)])
        if highest[3] == 0 and self._fit.count:
            series[3] = self._yaw_rad + wrapped(series[3] - self._yaw_rad)
        self._yaw_rad = float(series[3])
        self._fit.add(time_s, series, FORGETTING * self._pole_1_s)

    def _course_of(self, given: Vector, unknown: Vector, time_s: float, flown: Vector) -> Course:
        """The newest point with its derivatives: given, or found from the points before it."""
        values = np.where(unknown, 0.0, given)
        if self._fit.count >= FIT_POINTS[0]:
            self._find_derivatives(values, unknown)
        ahead_s = self._front_s - time_s
        for axis in np.flatnonzero(unknown[0]).tolist():
            # no place was asked for: the course goes on from where it is
            if unknown[1, axis] and not unknown[2, axis]:
                values[1, axis] = flown[1, axis]
            _, v, a, j = values[:, axis].tolist()
            values[0, axis] = flown[0, axis] - ahead_s * (v + ahead_s * (a / 2.0 + ahead_s * j / 6.0))
        return course(values.T / _FACTORIALS, time_s, time_s + self._silence_s + LOOK_AHEAD_S)

    def _find_derivatives(self, values: Vector, unknown: Vector) -> None:
        """Fill what was not given, in place. Where nothing was but the value, the fit's own is flown: it has less noise."""
        found = self._fit.derivatives(bisect.bisect_right(FIT_POINTS, self._fit.count))
        for axis, highest in enumerate(self._fitted):
            if highest < 0:
                continue
            if highest == 0:
                values[0, axis] = found[axis, 0]
            for order in range(highest + 1, 4):
                if unknown[order, axis]:
                    values[order, axis] = found[axis, order - highest]
        if 0 in self._fitted[:3]:
            slower = (max(self._fit.rough_m, ROUGH_M) / ROUGH_M) ** 0.25
            self._pole_1_s = max(QUICKEST_1_S / slower, SLOWEST_1_S)
        else:
            self._pole_1_s = QUICKEST_1_S

    def _require_place(self, position: Vector, acceleration: Vector = _STILL) -> None:
        why = self._allowed(position, acceleration)
        if why:
            raise OutOfBounds(why)

    def _require_allowed(self, way: Course, time_s: float) -> None:
        """The place on the course at `time_s`, and that where the vehicle would stop if nothing came after it."""
        position, velocity, acceleration = way.at(time_s)[:3, :3]
        self._require_place(position, acceleration)
        speed_m_s, limits = _length(velocity), self._stop_limits
        stop_s = max(
            1.875 * speed_m_s / limits.acceleration_m_s2, math.sqrt(5.7735 * speed_m_s / limits.jerk_m_s3)
        )
        stop = position + velocity * (self._silence_s + LOOK_AHEAD_S + STOP_SHARE * stop_s)
        stop[2] = max(stop[2], position[2])  # a stop ends above the ground anyway
        why = self._allowed(stop, _STILL)
        if why:
            raise OutOfBounds(f"too fast to stop in time: {why}")

    # What is flown ------------------------------------------------------------------------------------------

    def sample(self, time_s: float) -> Reference:
        """The reference at `time_s`, autopilot's clock. Raises ValueError for NaN."""
        if math.isnan(time_s):
            raise ValueError("trajectory sampled at time NaN")
        while self._pieces and time_s >= self._pieces[0].start_s:
            self._change_to(self._pieces.popleft())
        if time_s > self._course.until_s and not self._pieces:
            self._rest_after(self._at(self._front_s))
            self.following = Following.HOLDING
            self.counters["smooth stops"] += 1
        self._front_s = max(self._front_s, time_s)
        if self._quick is not None and self._front_s > self._quick.end_s:
            self._quick = None
        if self._slow is not None and self._front_s >= self._slow.end_s:
            self._slow = None
            if self.following is Following.TRANSIT:
                self.following = (
                    Following.STREAM if math.isfinite(self._course.until_s) else Following.HOLDING
                )
        return self._at(time_s)

    def _at(self, time_s: float) -> Reference:
        return reference_of(self._table_at(time_s))

    def _table_at(self, time_s: float) -> Vector:
        table = self._course.at(time_s)
        for offset in (self._slow, self._quick):
            if offset is not None:
                table += offset.at(time_s)
        return table

    def _change_to(
        self, target: Course, smoothly: bool = False, found: bool = False, free: Vector = _NONE
    ) -> None:
        """Fly `target` from now on; the difference to what is flown dies away. `smoothly`: within the limits.

        Along axes that are `free` (4,) no place was asked for: there a velocity is taken up without making up for the
        way that was lost meanwhile.

        What was `found` from positions seems to jump within a stream where there is noise: there the points tell.
        Raises BadPoint for one jump after another.
        """
        from_s, old = self._front_s, self._course
        gap = old.at(from_s) - target.at(from_s)
        gap[0, 3] = wrapped(float(gap[0, 3]))
        away_m, off_m_s, turned_rad = _length(gap[0, :3]), _length(gap[1, :3]), abs(float(gap[0, 3]))
        may_jump = not found or self._jump_to_fly or math.isinf(old.until_s)
        self._jump_to_fly = False
        jumps = may_jump and (away_m > JUMP_M or off_m_s > JUMP_M_S or turned_rad > JUMP_RAD)
        if self._quick is not None:
            gap += self._quick.at(from_s)
        if not jumps and not (smoothly and away_m + off_m_s + turned_rad > 1e-9):
            if free.any():
                shift = np.where(free, gap[0] - place_left(gap, self._pole_1_s), 0.0)
                target, gap[0] = target.moved(shift), gap[0] - shift
            self._course = target
            self._quick = Decay(gap, from_s, self._pole_1_s) if gap[:4].any() else None
            if self.following is not Following.TRANSIT:
                self.following = Following.STREAM if math.isfinite(target.until_s) else Following.HOLDING
            return
        if from_s - self._planned_s < JUMPS_APART_S:
            raise BadPoint(f"jumps: again within {JUMPS_APART_S:g} s")
        if self._slow is not None:
            gap += self._slow.at(from_s)
        if free[:3].all() and (free[3] or not gap[:, 3].any()):
            self._stop_offset(reference_of(gap), target, self._limits)
        else:
            self._require_way(target.at(from_s)[0, :3], gap[0, :3])
            self._course, self._quick = target, None
            self._slow = way_out(gap, self._limits, from_s)
        self._planned_s = from_s
        self.following = Following.TRANSIT

    def _require_way(self, to: Vector, gap: Vector) -> None:
        """A way within limits is nearly straight: no fence may lie across it, except that one comes from beyond it."""
        if _length(gap) > JUMP_M and not self._allowed(to + gap, _STILL):
            for share in np.linspace(0.1, 0.9, 9).tolist():
                why = self._allowed(to + share * gap, _STILL)
                if why:
                    raise OutOfBounds(f"the way there is barred: {why}")

    def _rest_after(self, now: Reference) -> None:
        """The smooth stop from `now`; what stands at its end is held for good."""
        self._stop_offset(now, course(np.zeros((4, 1)), self._front_s), self._stop_limits)
        self._forget()
        self._interval_s = math.inf

    def _stop_offset(self, gap: Reference, target: Course, limits: TransitLimits) -> None:
        """Let the offset `gap` to `target` come to rest where it does, and let the target go on from there."""
        way = run_out(gap, limits)
        end = way.sample(way.duration_s)
        left = np.array((*end.position_enu, end.yaw_rad))
        coefficients = way.piece.coefficients.copy()
        coefficients[:, 0] -= left
        self._course, self._quick = target.moved(left), None
        self._slow = Way((piece(way.duration_s, coefficients),), self._front_s)

    def _forget(self) -> None:
        """What came until now tells nothing of what comes next."""
        self._fit, self._fitted, self._last = FadingFit(), (), None


def stop_limits(limits: TransitLimits) -> TransitLimits:
    """Limits of the stop after a stream, whose points are refused where it would lead outside."""
    return replace(
        limits,
        acceleration_m_s2=max(limits.acceleration_m_s2, STOP_M_S2),
        jerk_m_s3=max(limits.jerk_m_s3, STOP_M_S3),
    )


_FACTORIALS = np.array([1.0, 1.0, 2.0, 6.0])


def _given(point: Point) -> Vector:
    """(4, 4): rows p, v, a, j; columns x, y, z, yaw; NaN where nothing was given."""
    given = np.full((4, 4), math.nan)
    given[:, :3] = point.position, point.velocity, point.acceleration, point.jerk
    given[:2, 3] = point.yaw_rad, point.yaw_rate_rad_s
    return given


def _length(vector: Vector) -> float:
    return math.hypot(*vector.tolist())
