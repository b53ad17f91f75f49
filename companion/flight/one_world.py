"""Whether two accounts of one movement are of one world: poses from outside against the autopilot's estimate, and the
estimate's positions against its own velocities.

A source whose axes, units or heading are wrong is fed to the autopilot's estimator and flies the vehicle into the wall. At
rest its tilt can be told, for the autopilot knows gravity by itself, and its heading where that comes from a compass; an
estimator that takes its heading from the source agrees with it whatever it says. As soon as something moves, so can the
direction and the length of the way: an estimator that is led by a wrong source either rejects it, and then the two part,
or says so by its innovations (`innovation_ratio`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from companion.control.structs import Vector, VehicleState
from companion.mavlink.frames import enu_from_ned, quaternion_enu_flu_from_ned_frd
from companion.mavlink.pose_datagram import OutsidePose

WINDOW_S = 1.0
MOVED_M = 0.3  # within the window; less is the noise of an estimate that follows poses
SELF_MOVED_M = 1.0
"""The same for positions against velocities: PX4's with GPS are pulled about by half a metre a second (its capture)."""
SPACING_S = 0.03  # between samples
RECENT = 8  # samples whose median counts
STALE_S = 0.5

TILT_WARNED_DEG, TILT_WRONG_DEG = 10.0, 25.0
HEADING_WARNED_DEG, HEADING_WRONG_DEG = 20.0, 45.0
MOTION_WARNED, MOTION_WRONG = 0.5, 0.8


class TwoPaths:
    """Two accounts of where something went, sample by sample. Only their displacements count, so origins may differ."""

    def __init__(self, least_m: float = MOVED_M) -> None:
        """Below `least_m` of movement nothing is said."""
        self._least_m = least_m
        self._past: deque[tuple[float, Sequence[float], Sequence[float]]] = deque()

    def add(self, time_s: float, one: Sequence[float], other: Sequence[float]) -> None:
        """Note both positions (3,) m at `time_s`; too soon after the last is left out, older than WINDOW_S forgotten."""
        past = self._past
        if past:
            since_s = time_s - past[-1][0]
            if since_s < 0.0:
                past.clear()
            elif since_s < SPACING_S:
                return
        past.append((time_s, one, other))
        while past[0][0] < time_s - WINDOW_S:
            past.popleft()

    def clear(self) -> None:
        """Forget: one of the two was moved without moving."""
        self._past.clear()

    @property
    def moved(self) -> tuple[list[float], list[float]]:
        """Both displacements (3,) m within the window."""
        if not self._past:
            return [0.0] * 3, [0.0] * 3
        (_, one_0, other_0), (_, one_1, other_1) = self._past[0], self._past[-1]
        return (
            [b - a for a, b in zip(one_0, one_1, strict=True)],
            [b - a for a, b in zip(other_0, other_1, strict=True)],
        )

    @property
    def difference(self) -> float | None:
        """Length of the displacements' difference over the longer one: 0 the same, √2 at right angles, 2 opposite, 1 where
        only one moved. None where neither moved by the least.
        """
        one, other = self.moved
        longest_m = max(math.hypot(*one), math.hypot(*other))
        return math.dist(one, other) / longest_m if longest_m >= self._least_m else None


@dataclass(frozen=True, slots=True)
class PoseFigures:
    """How poses from outside stand to the autopilot's estimate; medians of the last samples."""

    tilt_deg: float  # between both's vertical, seen from the body
    heading_deg: float  # the pose's less the estimate's, counter-clockwise, −180 to 180
    motion: float | None  # `TwoPaths.difference`
    moved_m: tuple[float, float]  # within WINDOW_S: by the poses, by the estimate
    looks_like: str  # the mistake that would explain it, with the remedy; empty where nothing is wrong or nothing fits


@dataclass(frozen=True, slots=True)
class _Mistake:
    """A way to describe the same pose wrongly: what it is called, and how to undo it."""

    name: str
    remedy: str
    position: Vector  # (3, 3): undoes it in a position
    quaternion: Callable[[Vector], Vector]  # undoes it in an attitude


class PoseComparison:
    """Takes each pose as it came, with the newest state; `figures` sums up."""

    def __init__(self) -> None:
        self._paths = TwoPaths()
        self._samples: deque[tuple[float, float, float, float | None]] = deque(maxlen=RECENT)
        self._newest: tuple[OutsidePose, VehicleState] | None = None
        self._resets = 0

    def add(self, pose: OutsidePose, state: VehicleState) -> None:
        """Compare a pose with the state of the same moment, or of a few hundredths of a second beside it."""
        if self._newest is not None and 0.0 <= state.time_s - self._newest[1].time_s < SPACING_S:
            return
        if pose.reset_counter != self._resets:
            self._resets = pose.reset_counter
            self._paths.clear()
        self._newest = pose, state
        self._paths.add(state.time_s, pose.position_enu.tolist(), state.position_enu.tolist())
        heading = _heading(pose.quaternion_wxyz) - _heading(state.quaternion_wxyz)
        tilt = _between_verticals(pose.quaternion_wxyz, state.quaternion_wxyz)
        self._samples.append((tilt, math.cos(heading), math.sin(heading), self._paths.difference))

    def estimate_jumped(self) -> None:
        """The estimate was reset: what it did before is not comparable."""
        self._paths.clear()

    def figures(self, now_s: float) -> PoseFigures | None:
        """How they stand at `now_s` of the autopilot's time; None without a recent pose."""
        if self._newest is None or abs(now_s - self._newest[1].time_s) > STALE_S:
            return None
        pose, state = self._newest
        tilts, cosines, sines, motions = zip(*self._samples, strict=True)
        known = [motion for motion in motions if motion is not None]
        motion = _median(known) if 2 * len(known) > len(motions) else None
        tilt_deg = math.degrees(_median(tilts))
        heading_deg = math.degrees(math.atan2(sum(sines), sum(cosines)))
        by_pose, by_estimate = self._paths.moved
        wrong = tilt_deg > TILT_WARNED_DEG or abs(heading_deg) > HEADING_WARNED_DEG
        wrong |= motion is not None and motion > MOTION_WARNED
        return PoseFigures(
            tilt_deg,
            heading_deg,
            motion,
            (math.hypot(*by_pose), math.hypot(*by_estimate)),
            self._explanation(pose, state, motion is not None) if wrong else "",
        )

    def _explanation(self, pose: OutsidePose, state: VehicleState, moving: bool) -> str:
        """The mistake that, undone, leaves tilt, heading and movement right."""
        by_pose, by_estimate = self._paths.moved
        for mistake in _MISTAKES:
            quaternion = mistake.quaternion(pose.quaternion_wxyz)
            heading = math.remainder(_heading(quaternion) - _heading(state.quaternion_wxyz), math.tau)
            if math.degrees(_between_verticals(quaternion, state.quaternion_wxyz)) > TILT_WARNED_DEG:
                continue
            if abs(math.degrees(heading)) > HEADING_WARNED_DEG:
                continue
            if moving:
                gap_m = math.dist((mistake.position @ np.array(by_pose)).tolist(), by_estimate)
                if gap_m > MOTION_WARNED * math.hypot(*by_estimate):
                    continue
            return f"{mistake.name}: {mistake.remedy}"
        return ""


def _median(values: list[float] | tuple[float, ...]) -> float:
    return sorted(values)[len(values) // 2]


def _vertical(quaternion_wxyz: Vector) -> tuple[float, float, float]:
    """The world's up in the body's axes: third row of its rotation."""
    w, x, y, z = quaternion_wxyz.tolist()
    return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


def _between_verticals(one: Vector, other: Vector) -> float:
    cosine = sum(a * b for a, b in zip(_vertical(one), _vertical(other), strict=True))
    return math.acos(max(-1.0, min(1.0, cosine)))


def _heading(quaternion_wxyz: Vector) -> float:
    w, x, y, z = quaternion_wxyz.tolist()
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _same(quaternion: Vector) -> Vector:
    return quaternion


def _turned(angle_deg: float) -> _Mistake:
    half = math.radians(angle_deg) / 2.0
    c, s = math.cos(2.0 * half), math.sin(2.0 * half)

    def turn(quaternion: Vector) -> Vector:
        w, x, y, z = quaternion.tolist()
        cw, cz = math.cos(half), math.sin(half)
        return np.array([cw * w - cz * z, cw * x - cz * y, cw * y + cz * x, cw * z + cz * w])

    return _Mistake(
        f"its world is turned by {-angle_deg:+.0f}°",
        f"turn positions and attitudes by {angle_deg:+.0f}° about the vertical: x is east, y north",
        np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]),
        turn,
    )


def _scaled(unit: str, factor: float) -> _Mistake:
    return _Mistake(f"positions in {unit}", "send metres", factor * np.eye(3), _same)


_MISTAKES = (
    _Mistake(
        "NED and FRD given as ENU and FLU",
        "send (y, x, −z) of the position and ½√2 (w+z, x+y, x−y, w−z) of the quaternion (docs/frames.md)",
        np.column_stack([enu_from_ned(axis) for axis in np.eye(3)]),
        quaternion_enu_flu_from_ned_frd,
    ),
    _Mistake(
        "y mirrored",
        "a left-handed world: send (x, −y, z) and (w, −x, y, −z)",
        np.diag([1.0, -1.0, 1.0]),
        lambda q: q * np.array([1.0, -1.0, 1.0, -1.0]),
    ),
    _Mistake(
        "body axes forward, right, down",
        "send the attitude of forward, left, up: (−x, w, z, −y) of the quaternion",
        np.eye(3),
        lambda q: np.array([-q[1], q[0], q[3], -q[2]]),
    ),
    _Mistake(
        "quaternion in the order x, y, z, w",
        "send w first",
        np.eye(3),
        lambda q: q[[3, 0, 1, 2]],
    ),
    _Mistake(
        "quaternion from world to body",
        "send its conjugate: (w, −x, −y, −z)",
        np.eye(3),
        lambda q: q * np.array([1.0, -1.0, -1.0, -1.0]),
    ),
    *(_turned(angle_deg) for angle_deg in (90.0, -90.0, 180.0)),
    _scaled("millimetres", 1e-3),
    _scaled("centimetres", 1e-2),
    _Mistake("z downwards", "send (x, y, −z): up is positive", np.diag([1.0, 1.0, -1.0]), _same),
    _Mistake("positions mirrored in y", "send (x, −y, z)", np.diag([1.0, -1.0, 1.0]), _same),
    _Mistake(
        "x and y of the position changed over",
        "send (y, x, z): x is east, y north",
        np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        _same,
    ),
)
"""What is looked for, the likelier first. A mistake that the movement seen so far does not show is not told from others."""
