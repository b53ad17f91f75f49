"""What a client asks for: a point in time, or a polynomial piece; checked before anything is done with it.

Axes are those of the flight's trajectory (`--frame`): metres, z up, yaw from x towards y. A component that was not given is
NaN. Position and velocity may be mixed by axis, as the masks of SET_POSITION_TARGET_LOCAL_NED allow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from companion.control.structs import Vector

FARTHEST_M = 1e5
FASTEST_M_S = 50.0
HARDEST_M_S2 = 100.0
DEGREE = 9
"""Of polynomial pieces, at most."""
LONGEST_S = 3600.0
"""A polynomial piece, at most."""


class BadPoint(ValueError):
    """A point that is not followed. The text says why, for the client and the log; what stands before a colon is counted."""


def unknown() -> Vector:
    """(3,) of NaN."""
    return np.full(3, math.nan)


@dataclass(frozen=True, slots=True)
class Point:
    """Where to be at one moment, and how to be moving there."""

    time_s: float = math.nan  # the client's clock; NaN: when it arrives
    position: Vector = field(default_factory=unknown)  # (3,) m
    velocity: Vector = field(default_factory=unknown)  # (3,) m/s
    acceleration: Vector = field(default_factory=unknown)  # (3,) m/s²
    jerk: Vector = field(default_factory=unknown)  # (3,) m/s³
    yaw_rad: float = math.nan
    yaw_rate_rad_s: float = math.nan

    def require_sane(self) -> None:
        """Raise BadPoint for what is infinite, absurd, or says nothing about where to go."""
        bounds = (
            ("position", self.position, FARTHEST_M, "m"),
            ("velocity", self.velocity, FASTEST_M_S, "m/s"),
            ("acceleration", self.acceleration, HARDEST_M_S2, "m/s²"),
            ("jerk", self.jerk, math.inf, "m/s³"),
        )
        for name, value, bound, unit in bounds:
            if np.isinf(value).any():
                raise BadPoint(f"{name} is infinite")
            if np.nanmax(np.abs(value), initial=0.0) > bound:
                raise BadPoint(f"{name}: {_numbers(value)} {unit} is beyond {bound:g} {unit}")
        for name, angle in (("yaw", self.yaw_rad), ("yaw rate", self.yaw_rate_rad_s), ("time", self.time_s)):
            if math.isinf(angle):
                raise BadPoint(f"{name} is infinite")
        if (
            np.isnan(self.position).all()
            and np.isnan(self.velocity).all()
            and np.isnan(self.acceleration).all()
        ):
            raise BadPoint("holds neither position nor velocity nor acceleration")


@dataclass(frozen=True, slots=True)
class PolynomialPiece:
    """x, y, z and yaw as polynomials of the time since the piece began."""

    coefficients: Vector  # (4, n ≤ 10) ascending powers; m and rad per sⁿ; yaw row NaN: kept as it is
    duration_s: float
    time_s: float = math.nan  # when it begins, client's clock; NaN: when the piece before ends, or at once

    def require_sane(self) -> None:
        """Raise BadPoint where it is no motion."""
        shape = self.coefficients.shape
        if len(shape) != 2 or shape[0] != 4 or not 1 <= shape[1] <= DEGREE + 1:
            raise BadPoint(f"a piece has 1 to {DEGREE + 1} coefficients for each of x, y, z, yaw")
        if not np.isfinite(self.coefficients[:3]).all() or np.isinf(self.coefficients[3]).any():
            raise BadPoint("a coefficient is not a finite number")
        if not 0.0 < self.duration_s <= LONGEST_S:
            raise BadPoint(f"duration: {self.duration_s:g} s is not between 0 and {LONGEST_S:g} s")
        times = np.linspace(0.0, self.duration_s, 20)[:, None] ** np.arange(shape[1])
        if np.abs(times @ self.coefficients[:3].T).max() > FARTHEST_M:
            raise BadPoint(f"leads farther than {FARTHEST_M:g} m")


def _numbers(value: Vector) -> str:
    return "[" + ", ".join(f"{number:g}" for number in value) + "]"
