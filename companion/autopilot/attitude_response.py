"""How the attitude loop really answers, found in flight from the motion that climb and transit make anyway.

A bank of models, second-order with dead time as in the profile, follows the setpoints that were sent; each keeps the
sum of squares by which it misses the attitude, an offset apart. Their weights are the likelihood of what was seen times
what the parameters suggest, so that little motion changes little, and without any the result is what was told. Nothing is
drawn or iterated: the same setpoints and states give the same numbers.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from companion.config.profile import SecondOrder
from companion.control.compiled import compiled
from companion.control.structs import Vector

DEAD_TIMES_S = (0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 0.13, 0.16, 0.2, 0.25)
FREQUENCIES_RAD_S = tuple(3.0 * 1.2**k for k in range(11))
DAMPINGS = (0.35, 0.45, 0.6, 0.8, 1.0, 1.25, 1.6)
SPREAD_LAG, SPREAD_DAMPING, SPREAD_DEAD = 0.4, 0.35, 0.7
"""By how much the parameters' word may be wrong, standard deviations of logarithms."""
LEAST_DEAD_S = 0.02
"""Added to dead times before their logarithms are compared: link and loop, which everybody has."""
SETTLING_S = 1.0
"""Left out at the beginning: what the vehicle did before is not known."""
INDEPENDENT_S = 0.25
"""Neighbours in time are not independent: one sample counts for each so long."""
LEAST_NOISE_RAD = math.radians(0.1)
LONGEST_GAP_S = 0.25
SUBSTEP_S = 0.005
MOST_PENDING = 256
SURE = 0.2
"""Relative deviation of the total lag from which on a measurement is used."""


@dataclass(frozen=True, slots=True)
class MeasuredResponse:
    """What the bank has come to."""

    dead_time_s: float
    tilt: SecondOrder
    deviation: float  # of the total lag, relative

    @property
    def sure(self) -> bool:
        """Whether it is worth more than what was told."""
        return self.deviation < SURE


@compiled
def _follow(
    bank: Vector,
    states: Vector,
    sums: Vector,
    sent: Vector,
    count: int,
    time_s: float,
    dt: float,
    motion: Vector,
    summing: bool,
) -> None:
    """Let every model of `bank` (n, 3: dead time s, ω², 2ζω) go on by `dt` s to `time_s`, and compare with `motion` (2,).

    `states` (n, 2, 2) hold angle and rate of roll and pitch, `sums` (n, 2, 2) of error and its square, `sent` (m, 3) the
    newest `count` setpoints: time, roll, pitch.
    """
    substeps = max(1, math.ceil(dt / SUBSTEP_S))
    h = dt / substeps
    for k in range(bank.shape[0]):
        row = count - 1
        acts = time_s - 0.5 * dt - bank[k, 0]
        while row > 0 and sent[row, 0] > acts:
            row -= 1
        for axis in range(2):
            wanted, x, v = sent[row, 1 + axis], states[k, axis, 0], states[k, axis, 1]
            for _ in range(substeps):
                middle_x, middle_v = (
                    x + 0.5 * h * v,
                    v + 0.5 * h * (bank[k, 1] * (wanted - x) - bank[k, 2] * v),
                )
                x += h * middle_v
                v += h * (bank[k, 1] * (wanted - middle_x) - bank[k, 2] * middle_v)
            states[k, axis, 0], states[k, axis, 1] = x, v
            if summing:
                error = x - motion[axis]
                sums[k, axis, 0] += error
                sums[k, axis, 1] += error * error


class AttitudeResponseMeter:
    """See the module. Angles are ZYX roll and pitch, rad; times are on the autopilot's clock."""

    def __init__(self, dead_time_s: float, tilt: SecondOrder) -> None:
        """Begin with what the parameters tell, and compile (seconds the first time: before arming)."""
        grid = list(itertools.product(DEAD_TIMES_S, FREQUENCIES_RAD_S, DAMPINGS))
        self._dead, self._omega, self._zeta = np.array(grid).T
        self._bank = np.column_stack((self._dead, self._omega**2, 2.0 * self._zeta * self._omega))
        self._log_lag = np.log(self._dead + 2.0 * self._zeta / self._omega)
        told_lag = math.log(dead_time_s + tilt.lag_s)
        dead_ratio = np.log((self._dead + LEAST_DEAD_S) / (dead_time_s + LEAST_DEAD_S))
        self._prior = -0.5 * (
            ((self._log_lag - told_lag) / SPREAD_LAG) ** 2
            + (np.log(self._zeta / tilt.damping) / SPREAD_DAMPING) ** 2
            + (dead_ratio / SPREAD_DEAD) ** 2
        )
        self._states = np.zeros((len(grid), 2, 2))
        self._sums = np.zeros((len(grid), 2, 2))
        self._sent = np.zeros((2 * MOST_PENDING, 3))
        self._count = 0
        self._samples = 0
        self._summed_s = 0.0
        self._last_s = math.nan
        self._running_s = 0.0
        _follow(
            self._bank[:1], self._states[:1], self._sums[:1], self._sent, 1, 0.0, 0.01, np.zeros(2), False
        )

    def sent(self, time_s: float, quaternion_wxyz: Vector) -> None:
        """Note an attitude setpoint (4,) that reaches the autopilot at `time_s`."""
        if self._count == len(self._sent):
            self._sent[:MOST_PENDING] = self._sent[MOST_PENDING:]
            self._count = MOST_PENDING
        self._sent[self._count] = (time_s, *_roll_pitch(quaternion_wxyz))
        self._count += 1

    def update(self, time_s: float, quaternion_wxyz: Vector) -> None:
        """Take an attitude (4,); states in order."""
        elapsed_s = time_s - self._last_s
        self._last_s = time_s
        motion = np.array(_roll_pitch(quaternion_wxyz))
        if (
            not 0.0 < elapsed_s < LONGEST_GAP_S or not self._count
        ):  # the first, or a gap: where it was is not known
            self._states[:, :, 0], self._states[:, :, 1] = motion, 0.0
            self._running_s = 0.0
            return
        self._running_s += elapsed_s
        summing = self._running_s > SETTLING_S
        _follow(
            self._bank, self._states, self._sums, self._sent, self._count, time_s, elapsed_s, motion, summing
        )
        if summing:
            self._samples += 1
            self._summed_s += elapsed_s

    def measured(self) -> MeasuredResponse:
        """The mean over the models, weighed by how well each fits."""
        weights = self._weights()
        log_lag = float(weights @ self._log_lag)
        deviation = math.sqrt(max(0.0, float(weights @ (self._log_lag - log_lag) ** 2)))
        omega = math.exp(float(weights @ np.log(self._omega)))
        zeta = math.exp(float(weights @ np.log(self._zeta)))
        tilt = SecondOrder(natural_frequency_rad_s=round(omega, 3), damping=round(zeta, 3))
        return MeasuredResponse(round(float(weights @ self._dead), 4), tilt, deviation)

    def _weights(self) -> Vector:
        likely = self._prior.copy()
        if self._samples:
            squares = (self._sums[:, :, 1] - self._sums[:, :, 0] ** 2 / self._samples).sum(axis=1)
            variance = max(float(squares.min()) / (2 * self._samples), LEAST_NOISE_RAD**2)
            counting = self._summed_s / INDEPENDENT_S / self._samples
            likely -= 0.5 * counting * squares / variance
        weights = np.exp(likely - likely.max())
        return np.asarray(weights / weights.sum())


def _roll_pitch(quaternion_wxyz: Vector) -> tuple[float, float]:
    w, x, y, z = quaternion_wxyz.tolist()
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    return math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)), pitch
