"""Wind: a steady part and Dryden gusts for low altitude (MIL-F-8785C, section 3.7.3.4, below 1000 ft).

With h the height and W₂₀ the wind at 20 ft, all in feet and feet per second:

    σ_w = 0.1 W₂₀,  σ_u = σ_v = σ_w / (0.177 + 0.000823 h)^0.4
    L_w = h,        L_u = L_v = h / (0.177 + 0.000823 h)^1.2
    H_u = σ_u √(2L_u/πV) / (1 + L_u s/V),  H_v,w = σ √(L/πV) (1 + √3 L s/V) / (1 + L s/V)²

u blows along the steady wind, v to its right, w down. V is the speed with which the vehicle and the frozen gust field pass
each other: the speed relative to the steady wind, not less than `LEAST_AIRSPEED` (hovering in a calm, gusts would stand
still; with the gust itself counted in, slow moments would last longer than fast ones and bend the mean).
Each filter is stepped exactly for white noise, so the standard deviations hold for any step. Height is held within
10 and 1000 ft, where the formulas are meant for.
"""

from __future__ import annotations

import math

import numpy as np

from sitl_stub.physics.compiled import compiled
from sitl_stub.physics.noise import RandomState, random_state, standard_normal
from sitl_stub.physics.vehicle import GROUND_DOWN, POSITION, VELOCITY, WIND, FloatArray

FOOT = 0.3048
LEAST_AIRSPEED = 1.0  # m/s

STEADY = 0  # (3,) NED, m/s
SPEED_AT_20_FEET = 3  # m/s: W₂₀, the strength of the gusts
GUST_U = 4  # unit variance
GUST_V = 5  # (2,) cascade of two lags
GUST_W = 7  # (2,)
WIND_STATE_SIZE = 9


@compiled
def step_lag(wind: FloatArray, at: int, keep: float, random: RandomState) -> None:
    """One exact step of a first-order lag on white noise, scaled to unit variance; `keep` = exp(−dt V/L)."""
    wind[at] = keep * wind[at] + math.sqrt(max(1.0 - keep * keep, 0.0)) * standard_normal(random)


@compiled
def step_double_lag(wind: FloatArray, at: int, ratio: float, random: RandomState) -> None:
    """One exact step of two equal lags in a row on white noise, `ratio` = dt V/L: variances 1 and ½, covariance ½."""
    keep = math.exp(-ratio)
    # Q = P − Φ P Φᵀ with Φ = keep [[1, 0], [ratio, 1]], P = [[1, ½], [½, ½]]
    q00 = 1.0 - keep * keep
    q01 = 0.5 - keep * keep * (ratio + 0.5)
    q11 = 0.5 - keep * keep * (ratio * ratio + ratio + 0.5)
    l00 = math.sqrt(max(q00, 0.0))
    l10 = q01 / l00 if l00 > 0.0 else 0.0
    l11 = math.sqrt(max(q11 - l10 * l10, 0.0))
    first, second = standard_normal(random), standard_normal(random)
    one = wind[at]
    wind[at] = keep * one + l00 * first
    wind[at + 1] = keep * (ratio * one + wind[at + 1]) + l10 * first + l11 * second


@compiled
def advance_wind(
    wind: FloatArray, random: RandomState, state: FloatArray, environment: FloatArray, dt_s: float
) -> None:
    """Move the gusts on by `dt_s` and write the wind (NED, m/s) into `environment[WIND:]`.

    wind (WIND_STATE_SIZE,) and random (4,) from `Wind`; state and environment as in `vehicle.py`. Call it at a fixed rate
    (the noise depends on the number of calls). Without wind and gusts it writes zeros and draws nothing.
    """
    strength = wind[SPEED_AT_20_FEET]
    if strength <= 0.0:
        for j in range(3):
            environment[WIND + j] = wind[STEADY + j]
        return
    height = (environment[GROUND_DOWN] - state[POSITION + 2]) / FOOT
    height = min(max(height, 10.0), 1000.0)
    factor = 0.177 + 0.000823 * height
    sd_w = 0.1 * strength
    sd_u = sd_w / factor**0.4
    length_u = height / factor**1.2 * FOOT
    length_w = height * FOOT
    speed = 0.0
    for j in range(3):
        relative = state[VELOCITY + j] - wind[STEADY + j]
        speed += relative * relative
    speed = max(math.sqrt(speed), LEAST_AIRSPEED)
    step_lag(wind, GUST_U, math.exp(-dt_s * speed / length_u), random)
    step_double_lag(wind, GUST_V, dt_s * speed / length_u, random)
    step_double_lag(wind, GUST_W, dt_s * speed / length_w, random)
    # (1 + √3 τs)/(1 + τs)² = √3/(1 + τs) + (1 − √3)/(1 + τs)²; its variance with this scaling is 2
    root = math.sqrt(3.0)
    gust_u = sd_u * wind[GUST_U]
    gust_v = sd_u * (root * wind[GUST_V] + (1.0 - root) * wind[GUST_V + 1]) / math.sqrt(2.0)
    gust_w = sd_w * (root * wind[GUST_W] + (1.0 - root) * wind[GUST_W + 1]) / math.sqrt(2.0)
    along_n, along_e = 1.0, 0.0
    horizontal = math.hypot(wind[STEADY], wind[STEADY + 1])
    if horizontal > 0.0:
        along_n, along_e = wind[STEADY] / horizontal, wind[STEADY + 1] / horizontal
    environment[WIND] = wind[STEADY] + along_n * gust_u - along_e * gust_v
    environment[WIND + 1] = wind[STEADY + 1] + along_e * gust_u + along_n * gust_v
    environment[WIND + 2] = wind[STEADY + 2] + gust_w


class Wind:
    """Steady wind `steady_ned` (m/s, where the air goes) with gusts of a wind of `gust_speed_m_s` at 20 ft (0: none)."""

    def __init__(
        self,
        steady_ned: tuple[float, float, float] = (0.0, 0.0, 0.0),
        gust_speed_m_s: float = 0.0,
        seed: int = 0,
    ) -> None:
        if not (np.isfinite(steady_ned).all() and np.isfinite(gust_speed_m_s) and gust_speed_m_s >= 0.0):
            raise ValueError(
                f"wind {steady_ned} with gusts {gust_speed_m_s} m/s: finite numbers, gusts not negative"
            )
        self.random = random_state(seed, stream=2)
        self.wind = np.zeros(WIND_STATE_SIZE)
        self.wind[STEADY : STEADY + 3] = steady_ned
        self.wind[SPEED_AT_20_FEET] = gust_speed_m_s
        # start in the stationary distribution
        draws = [standard_normal(self.random) for _ in range(5)]
        self.wind[GUST_U] = draws[0]
        for at, (one, two) in zip((GUST_V, GUST_W), (draws[1:3], draws[3:5]), strict=True):
            self.wind[at], self.wind[at + 1] = one, 0.5 * (one + two)

    def update(self, state: FloatArray, environment: FloatArray, dt_s: float) -> None:
        """`advance_wind` on this wind."""
        advance_wind(self.wind, self.random, state, environment, dt_s)
