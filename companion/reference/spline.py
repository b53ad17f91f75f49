"""The smoothest curve through points: piecewise 7th order, least integral of squared snap.

Used for waypoints (minimum snap) and for sampled files (interpolation). Between knots the minimiser is a
7th-order polynomial; whatever is not prescribed at a knot is continuous through the 6th derivative.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.control.structs import Reference, Vector
from companion.reference.polynomial import DERIVATIVE, FROM_BOUNDARY, ORDER, motion_from
from companion.reference.trajectory import held_outside


def _snap_cost() -> Vector:
    """(8, 8): snap integral over s in [0, 1] as a quadratic form of the boundary values [p, v, a, j] twice."""
    cost = np.zeros((ORDER + 1, ORDER + 1))
    for i in range(4, ORDER + 1):
        for j in range(4, ORDER + 1):
            cost[i, j] = math.perm(i, 4) * math.perm(j, 4) / (i + j - ORDER)
    return FROM_BOUNDARY.T @ cost @ FROM_BOUNDARY


_SNAP_COST = _snap_cost()


def minimum_snap_derivatives(times_s: Vector, values: Vector, fixed: NDArray[np.bool_]) -> Vector:
    """Return values (n, 4, c) at all knots with the free ones chosen for the least integral of squared snap.

    `times_s` (n,) increasing; `values` (n, 4, c): position, velocity, acceleration, jerk of c axes at each
    knot, read only where `fixed` (n, 4) is True. Positions have to be fixed, and enough else for the curve
    to be determined (four fixed values or more). One symmetric block-tridiagonal solve, linear in n.
    """
    n = times_s.size
    lengths = np.diff(times_s)
    unit = float(np.exp(np.log(lengths).mean()))  # derivatives in this unit of time keep the blocks alike
    stretch = lengths / unit
    powers = stretch[:, None] ** np.arange(4.0)
    scaling = np.concatenate([powers, powers], axis=1)  # (n-1, 8)
    cost = _SNAP_COST * scaling[:, :, None] * scaling[:, None, :] / (stretch**7)[:, None, None]

    diagonal = np.zeros((n, 4, 4))
    diagonal[:-1] += cost[:, :4, :4]
    diagonal[1:] += cost[:, 4:, 4:]
    upper = cost[:, :4, 4:]

    in_units = values * (unit ** np.arange(4.0))[None, :, None]
    known = np.where(fixed[:, :, None], in_units, 0.0)
    force = -(diagonal @ known)
    force[:-1] -= upper @ known[1:]
    force[1:] -= np.swapaxes(upper, 1, 2) @ known[:-1]
    force = np.where(fixed[:, :, None], known, force)
    free = ~fixed
    diagonal = diagonal * (free[:, :, None] & free[:, None, :]) + np.eye(4) * fixed[:, None, :]
    upper = upper * (free[:-1, :, None] & free[1:, None, :])

    # Block elimination without pivoting: the reduced form is positive definite.
    carry = np.zeros((n, 4, 4))
    reduced = force.copy()
    pivot = diagonal[0]
    for i in range(n - 1):
        both = np.linalg.solve(pivot, np.concatenate([upper[i], reduced[i]], axis=1))
        carry[i], reduced[i] = both[:, :4], both[:, 4:]
        pivot = diagonal[i + 1] - upper[i].T @ carry[i]
        reduced[i + 1] = reduced[i + 1] - upper[i].T @ reduced[i]
    reduced[-1] = np.linalg.solve(pivot, reduced[-1])
    for i in range(n - 2, -1, -1):
        reduced[i] -= carry[i] @ reduced[i + 1]
    return reduced / (unit ** np.arange(4.0))[None, :, None]


def snap_integral(times_s: Vector, derivatives: Vector, weights: Vector) -> tuple[float, Vector]:
    """Return the integral of squared snap and its slope (n-1,) in each segment's length.

    `derivatives` (n, 4, c) from `minimum_snap_derivatives`; axis i counts with `weights[i]`. As the free
    derivatives are at their optimum, the slope is that with all of them held.
    """
    lengths = np.diff(times_s)[:, None, None]
    order = np.tile(np.arange(4.0), 2)[None, :, None]
    values = np.concatenate([derivatives[:-1], derivatives[1:]], axis=1) * lengths**order
    moment = _SNAP_COST @ values
    weigh = weights / lengths[:, 0] ** 7
    cost = (values * moment).sum(axis=1) * weigh
    slope = (2.0 * (order * values * moment).sum(axis=1) * weigh - 7.0 * cost) / lengths[:, 0]
    return float(cost.sum()), slope.sum(axis=1)


@dataclass(frozen=True, slots=True)
class Spline:
    """A trajectory of 7th-order pieces between knots, the first at time 0."""

    duration_s: float
    _knots: list[float]  # (n,) s
    _lengths: list[float]  # (n-1,) s
    _tables: Vector  # (n-1, 20, 8) coefficients of derivatives 0 to 4, as in `polynomial.Piece`

    def sample(self, time_s: float) -> Reference:
        """Return the reference at `time_s`; outside the knots it stands still at that end."""
        if not 0.0 <= time_s <= self.duration_s:
            return held_outside(self, time_s)
        i = min(bisect_right(self._knots, time_s) - 1, len(self._lengths) - 1)
        return motion_from(self._tables[i], (time_s - self._knots[i]) / self._lengths[i])

    @property
    def knot_times_s(self) -> Vector:
        """(n,) times of the knots, from 0 to `duration_s`."""
        return np.array(self._knots)


def spline_through(times_s: Vector, derivatives: Vector) -> Spline:
    """Return the spline with `derivatives` (n, 4, 4) [p, v, a, j; x, y, z, yaw] at `times_s` (n,); starts at 0."""
    knots = times_s - times_s[0]
    lengths = np.diff(knots)
    powers = (lengths[:, None] ** np.arange(4.0))[:, :, None]
    boundary = np.concatenate([derivatives[:-1] * powers, derivatives[1:] * powers], axis=1)
    coefficients = np.swapaxes(FROM_BOUNDARY @ boundary, 1, 2)  # (n-1, 4, 8)
    return spline_of(lengths, coefficients)


def spline_of(lengths: Vector, coefficients: Vector) -> Spline:
    """Return the spline of pieces `lengths` (n,) s long; `coefficients` (n, 4, 8) in ascending powers of t / length."""
    knots = np.concatenate([[0.0], np.cumsum(lengths)])
    tables = np.concatenate(
        [coefficients @ DERIVATIVE[k].T / (lengths**k)[:, None, None] for k in range(5)], axis=1
    )
    return Spline(float(knots[-1]), knots.tolist(), lengths.tolist(), np.ascontiguousarray(tables))


def peaks_by_segment(times_s: Vector, derivatives: Vector, samples: int = 33) -> Vector:
    """(5, n-1): largest speed, acceleration, jerk, yaw rate, yaw acceleration in each segment."""
    spline = spline_through(times_s, derivatives)
    s = np.linspace(0.0, 1.0, samples)
    motion = spline._tables @ (s[:, None] ** np.arange(ORDER + 1.0)).T  # (n-1, 20, samples)
    motion = motion.reshape(-1, 5, 4, samples)
    spatial = np.linalg.norm(motion[:, 1:4, :3], axis=2).max(axis=2)
    turning = np.abs(motion[:, 1:3, 3]).max(axis=2)
    return np.concatenate([spatial, turning], axis=1).T
