"""Getting from one state to another: climb, go to start, run in, run out, return, descend.

A transit is one 7th-order polynomial per axis that meets position, velocity, acceleration and jerk at
both ends. Its duration is the shortest tried that keeps to the limits. Planning takes about 1 ms, so it
fits between two control steps, but it does not belong into every one of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from companion.control.structs import Reference, Vector
from companion.reference.polynomial import (
    Piece,
    boundary_of,
    derivative_basis,
    is_positive_duration,
    piece_between,
)
from companion.reference.trajectory import Trajectory, held_outside, resting, wrapped

NEARLY = 1.25  # times the least possible excess, where no duration keeps to all limits
SHORTEST_S = 0.5  # also for a transit to where the vehicle already is

_PLANNING_BASIS = derivative_basis(np.linspace(0.0, 1.0, 41))
_FINE_BASIS = derivative_basis(np.linspace(0.0, 1.0, 201))
_STRETCH = np.geomspace(0.2, 8.0, 48)  # durations tried, in multiples of a first guess

# Largest |derivative| of the 7th-order rest-to-rest profile over unit distance and time: 35/16 at the
# middle; 84 √5/25 at s = 1/2 ± √5/10; 105/2 (in size) at the middle.
REST_PEAK_SPEED = 35.0 / 16.0
REST_PEAK_ACCELERATION = 84.0 * math.sqrt(5.0) / 25.0
REST_PEAK_JERK = 52.5


@dataclass(frozen=True, slots=True)
class TransitLimits:
    """What a transit may ask of the vehicle. Speeds, accelerations and jerks are lengths of 3D vectors."""

    speed_m_s: float = 1.0
    acceleration_m_s2: float = 1.0
    jerk_m_s3: float = 4.0
    yaw_rate_rad_s: float = 0.8
    yaw_acceleration_rad_s2: float = 1.5
    height_min_m: float = -math.inf  # in the frame the transit is flown in
    height_max_m: float = math.inf

    def __post_init__(self) -> None:
        """Refuse limits under which nothing moves."""
        for name in (
            "speed_m_s",
            "acceleration_m_s2",
            "jerk_m_s3",
            "yaw_rate_rad_s",
            "yaw_acceleration_rad_s2",
        ):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"transit limit {name} is {getattr(self, name)}; it has to be above 0")
        if not self.height_min_m <= self.height_max_m:
            raise ValueError(
                f"transit heights: minimum {self.height_min_m} above maximum {self.height_max_m}"
            )


@dataclass(frozen=True, slots=True)
class Peaks:
    """The most a transit asks for along its way."""

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float
    yaw_rate_rad_s: float
    yaw_acceleration_rad_s2: float
    height_min_m: float
    height_max_m: float


@dataclass(frozen=True, slots=True)
class Transit:
    """A planned transit; see `Trajectory` for what `sample` does outside its duration."""

    piece: Piece
    peaks: Peaks
    within_limits: (
        bool  # False where the ends themselves leave no way to keep to the limits: the least bad way
    )

    @property
    def duration_s(self) -> float:
        """Length in s."""
        return self.piece.duration_s

    def sample(self, time_s: float) -> Reference:
        """Return the reference at `time_s`."""
        if not 0.0 <= time_s <= self.piece.duration_s:
            return held_outside(self, time_s)
        return self.piece.at(time_s)


def transit(
    start: Reference, end: Reference, limits: TransitLimits, duration_s: float | None = None
) -> Transit:
    """Plan the way from `start` to `end`, both of them full states that may be moving.

    Position to jerk and yaw to yaw acceleration are met at both ends. Yaw takes the short way: it begins
    at `start.yaw_rad` and ends at `end.yaw_rad` up to whole turns. A limit that an end state itself
    exceeds is raised to that end's value. The duration is the shortest tried that keeps to all limits, or
    `duration_s` where it is given. Raises ValueError for states that are not finite.
    """
    first, last = boundary_of(start), boundary_of(end)
    last[0, 3] = first[0, 3] + wrapped(last[0, 3] - first[0, 3])
    if duration_s is not None:
        if not is_positive_duration(duration_s):
            raise ValueError(f"a transit cannot last {duration_s} s")
        return _planned(duration_s, first, last, limits)

    at_rest = not (first[1:].any() or last[1:].any())
    guess = _first_guess(first, last, limits)
    if at_rest:
        return _planned(guess, first, last, limits)
    durations = np.maximum(guess * _STRETCH, SHORTEST_S)
    ends = np.broadcast_to(last, (durations.size, 4, 4))
    starts = np.broadcast_to(first, (durations.size, 4, 4))
    return _planned(_best(durations, starts, ends, limits), first, last, limits)


def run_in(trajectory: Trajectory, limits: TransitLimits) -> Transit:
    """Plan the way from rest into the state `trajectory` has at its start.

    The hold point is `run_in(...).sample(0)`. It is chosen so that the vehicle only ever speeds up into
    the trajectory: the velocity is the 5th-order polynomial from rest that meets velocity, acceleration and
    jerk, and the hold point is that far back. It is moved where that would be outside the height limits.
    For a trajectory that begins at rest this is a short hold at its start.
    """
    end = trajectory.sample(0.0)
    last = boundary_of(end)
    if not last[1:].any():
        return transit(end, end, limits)
    durations = np.maximum(_first_guess(last, last, limits) * _STRETCH, SHORTEST_S)
    starts = np.stack([_rest_before(T, last, limits) for T in durations])
    ends = np.broadcast_to(last, starts.shape)
    duration = _best(durations, starts, ends, limits)
    return _planned(duration, _rest_before(duration, last, limits), last, limits)


def run_out(state: Reference, limits: TransitLimits) -> Transit:
    """Plan the way from `state` to rest, stopping where the vehicle comes to rest by itself.

    The mirror image of `run_in`: the stopping point follows from the velocity, except that it is kept
    within the height limits.
    """
    first = boundary_of(state)
    if not first[1:].any():
        return transit(state, state, limits)
    durations = np.maximum(_first_guess(first, first, limits) * _STRETCH, SHORTEST_S)
    ends = np.stack([_rest_after(T, first, limits) for T in durations])
    starts = np.broadcast_to(first, ends.shape)
    duration = _best(durations, starts, ends, limits)
    return _planned(duration, first, _rest_after(duration, first, limits), limits)


def climb(
    start: Reference, height_m: float, limits: TransitLimits, speed_m_s: float | None = None
) -> Transit:
    """Plan the way straight up or down from `start` to rest at z = `height_m`, yaw kept.

    `speed_m_s` overrides the speed limit: descents are flown slower than transits.
    """
    end = start.position_enu.copy()
    end[2] = height_m
    if speed_m_s is not None:
        limits = replace(limits, speed_m_s=speed_m_s)
    return transit(start, resting(end, start.yaw_rad), limits)


def _rest_before(duration_s: float, state: Vector, limits: TransitLimits) -> Vector:
    """Boundary state (4, 4) at rest from which `state` is reached in `duration_s` without turning back."""
    # Integrals of the quintic Hermite functions of end value, slope and curvature: 1/2, -1/10, 1/120.
    way = duration_s * state[1] / 2.0 - duration_s**2 * state[2] / 10.0 + duration_s**3 * state[3] / 120.0
    rest = np.zeros((4, 4))
    rest[0] = state[0] - way
    rest[0, 2] = min(max(rest[0, 2], limits.height_min_m), limits.height_max_m)
    return rest


def _rest_after(duration_s: float, state: Vector, limits: TransitLimits) -> Vector:
    """Boundary state (4, 4) at rest that is reached from `state` in `duration_s` without turning back."""
    way = duration_s * state[1] / 2.0 + duration_s**2 * state[2] / 10.0 + duration_s**3 * state[3] / 120.0
    rest = np.zeros((4, 4))
    rest[0] = state[0] + way
    rest[0, 2] = min(max(rest[0, 2], limits.height_min_m), limits.height_max_m)
    return rest


def _first_guess(first: Vector, last: Vector, limits: TransitLimits) -> float:
    """Duration in s; exact for rest to rest, the right size otherwise."""
    way = float(np.linalg.norm(last[0, :3] - first[0, :3]))
    turn = abs(float(last[0, 3] - first[0, 3]))
    speed = max(float(np.linalg.norm(first[1, :3])), float(np.linalg.norm(last[1, :3])))
    yaw_rate = max(abs(float(first[1, 3])), abs(float(last[1, 3])))
    return max(
        SHORTEST_S,
        REST_PEAK_SPEED * way / limits.speed_m_s,
        math.sqrt(REST_PEAK_ACCELERATION * way / limits.acceleration_m_s2),
        math.cbrt(REST_PEAK_JERK * way / limits.jerk_m_s3),
        REST_PEAK_SPEED * turn / limits.yaw_rate_rad_s,
        math.sqrt(REST_PEAK_ACCELERATION * turn / limits.yaw_acceleration_rad_s2),
        1.875 * speed / limits.acceleration_m_s2,  # peak slope of a quintic step of height 1
        math.sqrt(5.7735 * speed / limits.jerk_m_s3),  # its peak curvature
        1.875 * yaw_rate / limits.yaw_acceleration_rad_s2,
    )


def _motion(durations: Vector, starts: Vector, ends: Vector, basis: Vector) -> Vector:
    """(4, n, samples, 4): derivatives 0 to 3 in time along each of n transits."""
    powers = durations[:, None, None] ** np.arange(4.0)[None, :, None]
    boundary = np.concatenate([starts * powers, ends * powers], axis=1)  # (n, 8, 4)
    motion = np.stack([basis[k] @ boundary for k in range(4)])
    for k in range(1, 4):
        motion[k] /= (durations**k)[:, None, None]
    return motion


def _excess(durations: Vector, starts: Vector, ends: Vector, limits: TransitLimits) -> Vector:
    """(n,): by what factor each transit exceeds its worst limit; at most 1 where it keeps to all of them."""
    motion = _motion(durations, starts, ends, _PLANNING_BASIS)
    worst = np.zeros(durations.size)
    bounds = (limits.speed_m_s, limits.acceleration_m_s2, limits.jerk_m_s3)
    for k, bound in enumerate(bounds, start=1):
        size = np.linalg.norm(motion[k, :, :, :3], axis=2)
        # An end that is beyond a limit cannot be changed; the way between shall not be worse.
        allowed = np.maximum(bound, np.maximum(size[:, 0], size[:, -1]) * (1.0 + 1e-6))
        worst = np.maximum(worst, size.max(axis=1) / allowed)
    for k, bound in enumerate((limits.yaw_rate_rad_s, limits.yaw_acceleration_rad_s2), start=1):
        size = np.abs(motion[k, :, :, 3])
        allowed = np.maximum(bound, np.maximum(size[:, 0], size[:, -1]) * (1.0 + 1e-6))
        worst = np.maximum(worst, size.max(axis=1) / allowed)
    height = motion[0, :, :, 2]
    floor = np.minimum(limits.height_min_m, np.minimum(height[:, 0], height[:, -1]))
    ceiling = np.maximum(limits.height_max_m, np.maximum(height[:, 0], height[:, -1]))
    outside = np.maximum(floor - height.min(axis=1), height.max(axis=1) - ceiling)
    # Leaving the height limits weighs more than being brisk: 1 cm counts as 100 % over a limit.
    return np.where(outside > 1e-6, np.maximum(worst, 1.0) + 100.0 * outside, worst)


def _best(durations: Vector, starts: Vector, ends: Vector, limits: TransitLimits) -> float:
    """Shortest duration that keeps to the limits; where none does, the shortest that is nearly the least bad.

    The least bad one itself may be three times as long and lead metres away, for a hundredth of a limit.
    """
    excess = _excess(durations, starts, ends, limits)
    least = float(excess.min())
    good = np.flatnonzero(excess <= (1.0 if least <= 1.0 else NEARLY * least))
    return float(durations[good[0]])


def _planned(duration_s: float, first: Vector, last: Vector, limits: TransitLimits) -> Transit:
    one = np.array([duration_s])
    motion = _motion(one, first[None], last[None], _FINE_BASIS)[:, 0]
    size = np.linalg.norm(motion[1:4, :, :3], axis=2).max(axis=1)
    turning = np.abs(motion[1:3, :, 3]).max(axis=1)
    height = motion[0, :, 2]
    peaks = Peaks(
        speed_m_s=float(size[0]),
        acceleration_m_s2=float(size[1]),
        jerk_m_s3=float(size[2]),
        yaw_rate_rad_s=float(turning[0]),
        yaw_acceleration_rad_s2=float(turning[1]),
        height_min_m=float(height.min()),
        height_max_m=float(height.max()),
    )
    # One part in a thousand: the planning grid is coarser than the one the peaks are read from.
    within = bool(_excess(one, first[None], last[None], limits)[0] <= 1.001)
    return Transit(piece_between(duration_s, first, last), peaks, within)
