"""Derivatives of a stream that has none, or fewer: a cubic by least squares in which the past counts less and less.

The square of a deviation counts e^(−forgetting · age): at even times this is the fading-memory filter, all of whose poles
lie at −forgetting (Morrison, Introduction to Sequential Smoothing and Prediction, 1969). Carried along as normal equations
about the newest point, so that a point costs the same however many there were.
"""

from __future__ import annotations

import math

import numpy as np

from companion.control.structs import Vector

UNIT_S = 0.1
"""Time is counted in this, so that the powers of ages that count are of one size."""
_SIZE = 4
_BINOMIALS = np.array([[float(math.comb(n, k)) for k in range(_SIZE)] for n in range(_SIZE)])
_STEPS = np.maximum(np.arange(_SIZE)[:, None] - np.arange(_SIZE), 0)


class FadingFit:
    """Four columns (x, y, z, yaw), fitted together."""

    def __init__(self) -> None:
        self.count = 0
        """Points so far."""
        self._time_s = 0.0
        self._anchor: Vector = np.zeros(4)
        self._normal: Vector = np.zeros((_SIZE, _SIZE))
        self._right: Vector = np.zeros((_SIZE, 4))
        self._before: list[tuple[float, Vector]] = []  # the last three
        self._square, self._weight = 0.0, 0.0  # of what is rough

    def add(self, time_s: float, values: Vector, forgetting_1_s: float) -> None:
        """Take in `values` (4,) of `time_s`, which is later than those before."""
        fading = 0.0
        if self.count:
            since_s = time_s - self._time_s
            fading = math.exp(-forgetting_1_s * since_s)
            step = -since_s / UNIT_S
            powers = np.array((1.0, step, step * step, step**3))
            shift = _BINOMIALS * powers[_STEPS]
            self._normal = fading * shift.dot(self._normal).dot(shift.T)
            self._right = fading * shift.dot(self._right)
        else:
            self._anchor = values.copy()
        from_anchor = values - self._anchor
        if len(self._before) == 3:
            self._see_roughness(time_s, from_anchor, fading)
            del self._before[0]
        self._before.append((time_s, from_anchor))
        self._time_s = time_s
        self._normal[0, 0] += 1.0
        self._right[0] += from_anchor
        self.count += 1

    @property
    def rough_m(self) -> float:
        """Standard deviation of what is no motion: how far x, y or z lies off a parabola through the three before."""
        return math.sqrt(self._square / self._weight) if self._weight else 0.0

    def _see_roughness(self, time_s: float, values: Vector, fading: float) -> None:
        (t0, p0), (t1, p1), (t2, p2) = self._before
        w0 = (time_s - t1) * (time_s - t2) / ((t0 - t1) * (t0 - t2))
        w1 = (time_s - t0) * (time_s - t2) / ((t1 - t0) * (t1 - t2))
        w2 = 1.0 - w0 - w1
        off = values - w0 * p0 - w1 * p1 - w2 * p2
        square = max(d * d for d in off[:3].tolist()) / (1.0 + w0 * w0 + w1 * w1 + w2 * w2)
        self._square = fading * self._square + square
        self._weight = fading * self._weight + 1.0

    def derivatives(self, degree: int) -> Vector:
        """(4, 4) at the newest point: x, y, z, yaw by value and derivatives up to `degree`. Needs more points than that."""
        size = degree + 1
        found = np.linalg.solve(self._normal[:size, :size], self._right[:size])
        out = np.zeros((4, 4))
        out[:, :size] = found.T * _SCALES[:size]
        out[:, 0] += self._anchor
        return out


_SCALES = np.array([1.0, 1.0 / UNIT_S, 2.0 / UNIT_S**2, 6.0 / UNIT_S**3])
