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
QUICKEST_RAD_S = 20.0
DEGREE = 9
"""Of polynomial pieces, at most."""
LONGEST_S = 3600.0
"""A polynomial piece, at most."""


class BadPoint(ValueError):
    """A point that is not followed. The text says why, for client and log; what stands before a colon is counted."""


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
        position, velocity, acceleration = (
            value.tolist() for value in (self.position, self.velocity, self.acceleration)
        )
        for name, values, bound, unit in (
            ("position", position, FARTHEST_M, "m"),
            ("velocity", velocity, FASTEST_M_S, "m/s"),
            ("acceleration", acceleration, HARDEST_M_S2, "m/s²"),
            ("jerk", self.jerk.tolist(), math.inf, "m/s³"),
            ("yaw", (self.yaw_rad,), math.inf, "rad"),
            ("yaw rate", (self.yaw_rate_rad_s,), QUICKEST_RAD_S, "rad/s"),
            ("time", (self.time_s,), math.inf, "s"),
        ):
            for value in values:
                if math.isinf(value):
                    raise BadPoint(f"{name} is infinite")
                if abs(value) > bound:
                    raise BadPoint(f"{name}: {value:g} {unit} is beyond {bound:g} {unit}")
        if all(math.isnan(value) for value in (*position, *velocity, *acceleration)):
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
