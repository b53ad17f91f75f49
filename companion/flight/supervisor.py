"""Limits of a flight, watched at the loop's rate, apart from the control law. What it says is done.

Each limit has a threshold, how long it must be exceeded, and a reaction. The reactions are ordered; the hardest
one asked for wins.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np

from companion.config.procedure import SafetyLimits
from companion.control.structs import Reference, Vector, VehicleState


class Reaction(enum.IntEnum):
    """What the supervisor wants, from soft to hard."""

    NONE = 0
    """Fly on."""
    FREEZE = 1
    """Fly on, but integrals and weights keep their values."""
    LAND = 2
    """Our control ends; the autopilot lands."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """The hardest reaction asked for, and why, in numbers."""

    reaction: Reaction
    reason: str = ""


CLEAR = Judgement(Reaction.NONE)


class Supervisor:
    """Watches one flight. Keeps only since when each limit has been exceeded."""

    def __init__(self, limits: SafetyLimits, home_enu: Vector) -> None:
        self._limits = limits
        self._home_enu = home_enu
        self._since: dict[str, float] = {}

    def judge(self, state: VehicleState, reference: Reference, position_age_s: float) -> Judgement:
        """Look at one state (before it reaches the law) beside its reference.

        Args:
            state: as assembled from the autopilot's messages.
            reference: at the same time.
            position_age_s: how old the position in `state` is.
        """
        limits = self._limits
        tilt_rad = tilt_of(state.quaternion_wxyz)
        error_m = float(np.linalg.norm(reference.position_enu - state.position_enu))
        away_m = float(np.linalg.norm((state.position_enu - self._home_enu)[:2]))
        height_m = float(state.position_enu[2] - self._home_enu[2])
        checks = (
            ("tilt", math.degrees(tilt_rad), limits.tilt_deg, "°", limits.tilt_duration_s),
            ("position error", error_m, limits.position_error_m, "m", limits.position_error_duration_s),
            ("distance from take-off", away_m, limits.fence_radius_m, "m", 0.0),
            ("height above take-off", height_m, limits.fence_height_m, "m", 0.0),
            ("age of the position", position_age_s, limits.position_age_s, "s", 0.0),
        )
        for name, value, limit, unit, duration_s in checks:
            if self._exceeded(name, value > limit, state.time_s, duration_s):
                return Judgement(Reaction.LAND, f"{name} {value:.2f} {unit}, limit {limit:g} {unit}")
        if position_age_s > limits.position_age_s / 2.0:
            return Judgement(Reaction.FREEZE, f"position is {position_age_s:.2f} s old")
        return CLEAR

    def _exceeded(self, name: str, above: bool, time_s: float, duration_s: float) -> bool:
        if not above:
            self._since.pop(name, None)
            return False
        return time_s - self._since.setdefault(name, time_s) >= duration_s


def tilt_of(quaternion_wxyz: Vector) -> float:
    """Angle between body z and world z in rad: cos tilt = 1 − 2(x² + y²)."""
    x, y = float(quaternion_wxyz[1]), float(quaternion_wxyz[2])
    return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))
