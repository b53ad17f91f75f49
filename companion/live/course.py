"""A course: polynomials in time for x, y, z and yaw. What a stream of points says about the near future."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.control.structs import Reference, Vector
from companion.live.point import DEGREE

_SHIFT = np.diag(np.arange(1.0, DEGREE + 1), 1)


@dataclass(frozen=True, slots=True)
class Course:
    """Motion from `start_s` on; after `until_s` nobody has said anything."""

    start_s: float  # autopilot's clock
    until_s: float
    _table: Vector  # (20, 10) coefficients of the derivatives 0 to 4, row 4k + axis

    def at(self, time_s: float) -> Vector:
        """(5, 4) at `time_s`, autopilot's clock, not clamped: value and derivatives to snap; x, y, z, yaw."""
        t = time_s - self.start_s
        t2 = t * t
        t4 = t2 * t2
        t3, t6, t8 = t2 * t, t4 * t2, t4 * t4
        out: Vector = self._table.dot(np.array((1.0, t, t2, t3, t4, t4 * t, t6, t6 * t, t8, t8 * t)))
        return out.reshape(5, 4)

    def moved(self, shift: Vector) -> Course:
        """The same motion elsewhere: `shift` (4,) x, y, z, yaw."""
        table = self._table.copy()
        table[:4, 0] += shift
        return Course(self.start_s, self.until_s, table)


def course(coefficients: Vector, start_s: float, until_s: float = math.inf) -> Course:
    """The course with `coefficients` (4, n ≤ 10), ascending powers of the time since `start_s`, m and rad."""
    rows = np.zeros((5, 4, DEGREE + 1))
    rows[0, :, : coefficients.shape[1]] = coefficients
    for k in range(4):
        rows[k + 1] = rows[k].dot(_SHIFT.T)
    return Course(start_s, until_s, rows.reshape(20, DEGREE + 1))


def reference_of(table: Vector) -> Reference:
    """The reference that `table` (5, 4) stands for; keeps views of it."""
    yaw, yaw_rate, yaw_acceleration = table[:3, 3].tolist()
    return Reference(
        table[0, :3], table[1, :3], table[2, :3], table[3, :3], table[4, :3], yaw, yaw_rate, yaw_acceleration
    )


def table_of(reference: Reference) -> Vector:
    """(5, 4), `reference_of` turned round; yaw's jerk and snap are not known to a reference: 0."""
    table = np.zeros((5, 4))
    table[0, :3], table[1, :3] = reference.position_enu, reference.velocity_enu
    table[2, :3], table[3, :3] = reference.acceleration_enu, reference.jerk_enu
    table[4, :3] = reference.snap_enu
    table[:3, 3] = reference.yaw_rad, reference.yaw_rate_rad_s, reference.yaw_acceleration_rad_s2
    return table
