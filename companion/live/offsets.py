"""What is added to a course while the difference to what was flown before dies away."""

from __future__ import annotations

import math

import numpy as np

from companion.control.structs import Vector
from companion.live.course import Course, course, reference_of
from companion.reference.polynomial import Piece
from companion.reference.trajectory import resting
from companion.reference.transit import TransitLimits, run_out, transit

_NOTHING = resting(np.zeros(3), 0.0)


class Decay:
    """A linear filter with a fourfold pole at −λ: x⁗ = −(4λ x‴ + 6λ² ẍ + 4λ³ ẋ + λ⁴ x).

    A jump of 1 m asks for 0.31 λ² m/s² at most, one of 1 m/s for 0.6 λ.
    """

    def __init__(self, table: Vector, start_s: float, pole_1_s: float) -> None:
        """Go on from `table` (5, 4), of which the rows up to jerk count."""
        # e^(λt) x is a cubic, so x and its derivatives are cubics times e^(−λt): four rows of their coefficients
        cubic = _shifted(4, pole_1_s).dot(table[:4])
        back = _shifted(5, -pole_1_s)[:, :4]
        rows = [back.dot(cubic)]
        for k in range(1, 4):
            cubic[:-1], cubic[-1] = cubic[1:].copy(), 0.0
            rows.append(back.dot(cubic) / math.factorial(k))
        self._rows = np.stack([row.reshape(20) for row in rows], axis=1)
        self._pole_1_s = pole_1_s
        self.start_s = start_s
        self.end_s = start_s + 30.0 / pole_1_s
        """From here on it is below 10⁻⁹ of what it was."""

    def at(self, time_s: float) -> Vector:
        """(5, 4): value and derivatives to snap; x, y, z, yaw."""
        t = max(time_s - self.start_s, 0.0)
        out: Vector = self._rows.dot(np.array((1.0, t, t * t, t * t * t)) * math.exp(-self._pole_1_s * t))
        return out.reshape(5, 4)


def place_left(table: Vector, pole_1_s: float) -> Vector:
    """(4,) from where a `Decay` of this velocity, acceleration and jerk comes to zero without turning back.

    Its velocity dies away with a threefold pole then, and this is minus its way: −(3λ² v + 3λ a + j)/λ³.
    """
    _, v, a, j = table[:4]
    place: Vector = -((j / pole_1_s + 3.0 * a) / pole_1_s + 3.0 * v) / pole_1_s
    return place


class Way:
    """Polynomials, the last of which ends at zero with its derivatives: within the limits of a transit."""

    def __init__(self, pieces: tuple[Piece, ...], start_s: float) -> None:
        """Begin at `start_s` with the first of `pieces`."""
        self._courses: list[Course] = []
        for part in pieces:
            powers = part.duration_s ** np.arange(part.coefficients.shape[1])
            self._courses.append(course(part.coefficients / powers, start_s, start_s + part.duration_s))
            start_s += part.duration_s
        self.end_s = start_s

    def at(self, time_s: float) -> Vector:
        """(5, 4): value and derivatives to snap; x, y, z, yaw."""
        for part in self._courses:
            if time_s < part.until_s:
                return part.at(max(time_s, part.start_s))
        return np.zeros((5, 4))


def way_out(gap: Vector, limits: TransitLimits, start_s: float) -> Way:
    """How the offset `gap` (5, 4) dies away within the limits: at once, or, where that would break them, after a stop."""
    now = reference_of(gap)
    way = transit(now, _NOTHING, limits)
    if way.within_limits:
        return Way((way.piece,), start_s)
    stop = run_out(now, limits)
    return Way((stop.piece, transit(stop.sample(stop.duration_s), _NOTHING, limits).piece), start_s)


def _shifted(rows: int, pole: float) -> Vector:
    """(rows, rows): derivatives of f → those of e^(pole·t) f, at t = 0 (Leibniz)."""
    powers = np.array((1.0, pole, pole**2, pole**3, pole**4))
    return _BINOMIALS[:rows, :rows] * powers[_STEPS[:rows, :rows]]


_BINOMIALS = np.array([[float(math.comb(n, k)) for k in range(5)] for n in range(5)])
_STEPS = np.maximum(np.arange(5)[:, None] - np.arange(5), 0)
