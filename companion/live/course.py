"""A course: polynomials in time for x, y, z and yaw. What a stream of points says about the near future."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.control.structs import Reference, Vector
from companion.live.point import DEGREE

_EXPONENTS = np.arange(DEGREE + 1)
_SHIFT = np.diag(_EXPONENTS[1:].astype(np.float64), 1)


@dataclass(frozen=True, slots=True)
class Course:
    """Motion from `start_s` on; after `until_s` nobody has said anything."""

    start_s: float  # autopilot's clock
    until_s: float
    _table: Vector  # (20, 10) coefficients of the derivatives 0 to 4, row 4k + axis

    def at(self, time_s: float) -> Reference:
        """The reference at `time_s`, autopilot's clock; not clamped."""
        out = self._table @ (time_s - self.start_s) ** _EXPONENTS
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


def course(coefficients: Vector, start_s: float, until_s: float = math.inf) -> Course:
    """The course with `coefficients` (4, n ≤ 10), ascending powers of the time since `start_s`, m and rad."""
    padded = np.zeros((4, DEGREE + 1))
    padded[:, : coefficients.shape[1]] = coefficients
    rows = [padded]
    for _ in range(4):
        rows.append(rows[-1] @ _SHIFT.T)
    return Course(start_s, until_s, np.concatenate(rows))


def fitted(times_s: Vector, values: Vector, degree: int) -> Vector:
    """Least-squares polynomial (columns of `values`, degree + 1) about the last of `times_s`, ascending powers."""
    span = max(float(times_s[-1] - times_s[0]), 1e-6)
    basis = ((times_s - times_s[-1]) / span)[:, None] ** np.arange(degree + 1)
    found: Vector = np.linalg.lstsq(basis, values, rcond=None)[0].T
    return found / span ** np.arange(degree + 1)
