"""Horizontal drag per mass, found in flight: what slows the vehicle beyond what its tilt explains.

Rotors that move sideways push back in proportion to speed, on every multirotor, by 0.1 to 0.5 m/s² for each m/s:

    v̇ = g r₃,xy / r₃,z − d v + c ,   c: wind, and an attitude that is off

d and c are a least-squares fit over spans of `SPAN_S`, horizontal axes alike, with what is usual as a prior. Flown with
it, a reference's acceleration is the one that thrust has to make, p̈ + d ṗ, and its derivatives likewise: the laws stay
as they are, and steps repeat from what is logged of their inputs.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from companion.control.structs import Reference, Vector

GRAVITY = 9.81
SPAN_S = 0.2
USUAL_1_S = 0.15
SPREAD_1_S = 0.15
MOST_1_S = 1.0
LEAST_NOISE_M_S2 = 0.1
FEWEST_SPANS = 10
SETTLING_S = 2.0
"""Time constant with which the value flown with follows the one measured."""
_ACROSS = np.array([1.0, 1.0, 0.0])


class DragMeter:
    """See the module."""

    def __init__(self) -> None:
        self.drag_1_s = USUAL_1_S  # flown with
        self._started_s = math.nan
        self._last_s = math.nan
        self._from: Vector = np.zeros(2)  # velocity at the beginning of a span, xy
        self._tilting: Vector = np.zeros(2)  # ∫ g r₃,xy / r₃,z dt since then
        self._moved: Vector = np.zeros(2)  # ∫ v dt
        self._count = 0
        self._sums: Vector = np.zeros((2, 5))  # Σ v, Σ y, Σ v², Σ v y, Σ y² of each axis

    def update(
        self, time_s: float, velocity_enu: Vector, quaternion_wxyz: Vector, trusted: bool = True
    ) -> None:
        """Take a state; untrusted ones (ground, jumps) begin a new span."""
        elapsed_s = time_s - self._last_s
        self._last_s = time_s
        velocity = velocity_enu[:2]
        if not trusted or not 0.0 < elapsed_s < SPAN_S:
            self._started_s = math.nan
        if math.isnan(self._started_s):
            self._begin(time_s, velocity)
            return
        w, x, y, z = quaternion_wxyz.tolist()
        upright = 1.0 - 2.0 * (x * x + y * y)
        if upright < 0.3:
            self._started_s = math.nan
            return
        self._tilting += GRAVITY * elapsed_s / upright * np.array((2 * (x * z + w * y), 2 * (y * z - w * x)))
        self._moved += elapsed_s * velocity
        if (span_s := time_s - self._started_s) >= SPAN_S:
            self._note(self._moved / span_s, (velocity - self._from - self._tilting) / span_s)
            self._begin(time_s, velocity)
        share = -math.expm1(-elapsed_s / SETTLING_S)
        self.drag_1_s += share * (self.measured()[0] - self.drag_1_s)

    def _begin(self, time_s: float, velocity: Vector) -> None:
        self._started_s, self._from = time_s, velocity.copy()
        self._tilting, self._moved = np.zeros(2), np.zeros(2)

    def _note(self, v: Vector, y: Vector) -> None:
        self._count += 1
        self._sums += np.column_stack((v, y, v * v, v * y, y * y))

    def measured(self) -> tuple[float, float]:
        """d in 1/s, and its standard deviation."""
        if self._count < FEWEST_SPANS:
            return USUAL_1_S, SPREAD_1_S
        n = self._count
        v, y, vv, vy, yy = self._sums.T
        moving = float(np.sum(vv - v * v / n))
        together = float(np.sum(vy - v * y / n))
        slope = together / max(moving, 1e-6)
        left = float(np.sum(yy - y * y / n)) - slope * together
        noise = max(left / (2 * n - 3), LEAST_NOISE_M_S2**2)
        certainty = moving / noise + 1.0 / SPREAD_1_S**2
        drag = (-together / noise + USUAL_1_S / SPREAD_1_S**2) / certainty
        return min(MOST_1_S, max(0.0, drag)), 1.0 / math.sqrt(certainty)

    def with_drag(self, reference: Reference) -> Reference:
        """The reference whose accelerations are those that thrust has to make."""
        d = self.drag_1_s * _ACROSS
        return replace(
            reference,
            acceleration_enu=reference.acceleration_enu + d * reference.velocity_enu,
            jerk_enu=reference.jerk_enu + d * reference.acceleration_enu,
            snap_enu=reference.snap_enu + d * reference.jerk_enu,
        )
