"""One polynomial piece of motion in x, y, z and yaw, evaluated through snap in one product."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.control.structs import Reference, Vector

ORDER = 7  # seven is the least order that meets position to jerk at both ends
_EXPONENT = np.arange(ORDER + 1)


def _derivative_factors() -> Vector:
    """(5, 8, 8): factors[k] maps coefficients of s^n to those of the k-th derivative, ascending powers."""
    factors = np.zeros((5, ORDER + 1, ORDER + 1))
    factors[0] = np.eye(ORDER + 1)
    shift = np.diag(_EXPONENT[1:].astype(np.float64), 1)  # n · s^(n-1) goes one row up
    for k in range(1, 5):
        factors[k] = shift @ factors[k - 1]
    return factors


DERIVATIVE = _derivative_factors()


def _boundary_inverse() -> Vector:
    """(8, 8): from [p, v, a, j] at s = 0 and at s = 1 to ascending coefficients in s."""
    ones = np.ones(ORDER + 1)
    at_start = DERIVATIVE[:4, 0, :]
    at_end = np.stack([ones @ DERIVATIVE[k] for k in range(4)])
    return np.linalg.inv(np.vstack([at_start, at_end]))


# The entries are small rationals with denominator 6 at most; rounding takes the inversion's error away.
FROM_BOUNDARY = np.round(_boundary_inverse() * 6.0) / 6.0


def motion_from(table: Vector, s: float) -> Reference:
    """Return the reference that `table` (20, 8) gives at `s`: rows 4k + axis, ascending powers of s."""
    s2 = s * s
    s3 = s2 * s
    s4 = s2 * s2
    out = table.dot(np.array((1.0, s, s2, s3, s4, s4 * s, s4 * s2, s4 * s3)))
    return Reference(
        out[0:3],
        out[4:7],
        out[8:11],
        out[12:15],
        out[16:19],
        float(out[3]),
        float(out[7]),
        float(out[11]),
    )


@dataclass(frozen=True, slots=True)
class Piece:
    """x, y, z and yaw as 7th-order polynomials of s = t / duration_s."""

    duration_s: float
    coefficients: Vector  # (4, 8) ascending powers of s; rows x, y, z in m and yaw in rad
    _table: Vector  # (20, 8) coefficients of the derivatives 0 to 4 in time, row 4k + axis

    def at(self, time_s: float) -> Reference:
        """Return the polynomial and its derivatives at `time_s` after its start; not clamped."""
        return motion_from(self._table, time_s / self.duration_s)


def piece(duration_s: float, coefficients: Vector) -> Piece:
    """Return the piece with `coefficients` (4, 8), ascending powers of s = t / `duration_s`."""
    table = np.concatenate([coefficients @ DERIVATIVE[k].T / duration_s**k for k in range(5)])
    return Piece(duration_s, coefficients, np.ascontiguousarray(table))


def piece_between(duration_s: float, start: Vector, end: Vector) -> Piece:
    """Return the piece between two boundary states, each (4, 4): rows p, v, a, j; columns x, y, z, yaw."""
    powers = duration_s ** np.arange(4.0)[:, None]
    boundary = np.vstack([start * powers, end * powers])
    return piece(duration_s, np.ascontiguousarray((FROM_BOUNDARY @ boundary).T))


def boundary_of(reference: Reference) -> Vector:
    """Return `reference` as a boundary state (4, 4) of `piece_between`; yaw jerk is taken as 0."""
    state = np.zeros((4, 4))
    state[0, :3] = reference.position_enu
    state[1, :3] = reference.velocity_enu
    state[2, :3] = reference.acceleration_enu
    state[3, :3] = reference.jerk_enu
    state[:3, 3] = reference.yaw_rad, reference.yaw_rate_rad_s, reference.yaw_acceleration_rad_s2
    if not np.isfinite(state).all():
        raise ValueError("a transit needs finite states at both ends")
    return state


def derivative_basis(samples: Vector) -> Vector:
    """(4, n, 8): row i of [k] times boundary values (in s) gives the k-th derivative in s at samples[i]."""
    powers = samples[:, None] ** _EXPONENT
    return np.stack([powers @ DERIVATIVE[k] @ FROM_BOUNDARY for k in range(4)])


def is_positive_duration(duration_s: float) -> bool:
    """Whether a piece can last that long."""
    return math.isfinite(duration_s) and duration_s > 0.0
