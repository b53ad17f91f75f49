"""Random numbers for compiled code, and coloured noise: Gauss–Markov processes stepped exactly.

The generator is xoshiro256++ (Blackman and Vigna 2019) on a uint64 array (4,), seeded through NumPy's `SeedSequence`,
so that any compiled loop can draw from it and the numbers depend on the seed and on nothing else.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl_stub.physics.compiled import compiled
from sitl_stub.physics.vehicle import FloatArray

RandomState = NDArray[np.uint64]  # (4,)

MARKOV_SIZE = (
    7  # of one packed second-order process: transition (4, row by row), Cholesky factor of the noise (3)
)

_ONE_ULP = 1.0 / 9007199254740992.0  # 2⁻⁵³


def random_state(seed: int, stream: int = 0) -> RandomState:
    """A fresh generator (4,) uint64 for `seed`; different `stream`s of one seed are independent.

    Raises ValueError when either is negative.
    """
    if seed < 0 or stream < 0:
        raise ValueError(f"a seed must not be negative (seed {seed}, stream {stream})")
    return np.asarray(np.random.SeedSequence([seed, stream]).generate_state(4, np.uint64), dtype=np.uint64)


@compiled
def next_bits(random: RandomState) -> int:
    """The next 64 random bits; moves `random` on in place."""
    total = random[0] + random[3]
    result = ((total << np.uint64(23)) | (total >> np.uint64(41))) + random[0]
    kept = random[1] << np.uint64(17)
    random[2] ^= random[0]
    random[3] ^= random[1]
    random[1] ^= random[2]
    random[0] ^= random[3]
    random[2] ^= kept
    random[3] = (random[3] << np.uint64(45)) | (random[3] >> np.uint64(19))
    return result  # type: ignore[no-any-return]


@compiled
def standard_normal(random: RandomState) -> float:
    """One normal number, mean 0, variance 1 (Box and Muller); always takes two draws."""
    radius = (float(next_bits(random) >> np.uint64(11)) + 1.0) * _ONE_ULP  # in (0, 1]: its logarithm exists
    angle = float(next_bits(random) >> np.uint64(11)) * _ONE_ULP
    return math.sqrt(-2.0 * math.log(radius)) * math.cos(2.0 * math.pi * angle)


def second_order_markov(corner_rad_s: float, period_s: float) -> FloatArray:
    """Exact step of the critically damped process ẍ + 2ω ẋ + ω² x = white noise, scaled to var x = 1, var ẋ = ω².

    Its spectrum falls with 1/f⁴ above the corner: what comes out is smooth, has a derivative, and jumps nowhere. Packed
    (MARKOV_SIZE,) for `step_markov`, in units of (x, ẋ/ω), which are uncorrelated at any one time.
    """
    a = corner_rad_s * period_s
    transition = math.exp(-a) * np.array([[1.0 + a, a], [-a, 1.0 - a]])
    covariance = np.eye(2) - transition @ transition.T
    l00 = math.sqrt(max(covariance[0, 0], 0.0))
    l10 = covariance[1, 0] / l00 if l00 > 0.0 else 0.0
    l11 = math.sqrt(max(covariance[1, 1] - l10 * l10, 0.0))
    return np.array([*transition.ravel(), l00, l10, l11])


@compiled
def step_markov(
    noise: FloatArray, at: int, process: FloatArray, process_at: int, random: RandomState
) -> None:
    """One step of the process packed at `process[process_at:]`; `noise[at]` is x (variance 1), `noise[at + 1]` is ẋ/ω."""
    first, second = standard_normal(random), standard_normal(random)
    x, rate = noise[at], noise[at + 1]
    p = process_at
    noise[at] = process[p] * x + process[p + 1] * rate + process[p + 4] * first
    noise[at + 1] = (
        process[p + 2] * x + process[p + 3] * rate + process[p + 5] * first + process[p + 6] * second
    )
