"""From normalised torque and thrust to motor commands: PX4's normalised pseudo-inverse and its order of giving way.

Two normalisations exist and differ for a plus frame: PX4 since 1.14 divides the roll and pitch columns by
`‖column‖ / √(rotors that act / 2)` (ActuatorEffectiveness), so ±0.707 a motor on both X and plus frames; the fixed
mixers of 1.13 divide by `‖column‖ / √(all rotors / 2)`, so ±0.707 on X and ±1 on plus.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl_stub.physics.compiled import compiled
from sitl_stub.physics.vehicle import VehicleParameters

FloatArray = NDArray[np.float64]
YAW_HEADROOM = 0.15
"""Share of the motors' range that yaw may take above full thrust before it gives way (PX4's MINIMUM_YAW_MARGIN)."""


def mixer_matrix(vehicle: VehicleParameters, count_all_rotors: bool = False) -> FloatArray:
    """Mixer (N, 4): motor command per unit of roll, pitch, yaw torque (FRD) and thrust, each column normalised.

    `count_all_rotors` gives the normalisation of PX4 1.13's mixers.
    """
    effectiveness = vehicle.allocation_frd()[[1, 2, 3, 0]] / vehicle.max_thrust_newton.mean()
    mix = np.linalg.pinv(effectiveness)
    mix[np.abs(mix) < 1e-6] = 0.0
    scales = []
    for axis in (0, 1):
        acting = mix.shape[0] if count_all_rotors else np.count_nonzero(np.abs(mix[:, axis]) > 1e-3)
        scales.append(float(np.linalg.norm(mix[:, axis]) / np.sqrt(acting / 2.0)))
    mix[:, :2] /= max(scales)
    mix[:, 2] /= mix[:, 2].max()
    mix[:, 3] /= np.abs(mix[:, 3]).mean()
    return mix


def full_torque_newton_metre(vehicle: VehicleParameters, mixer: FloatArray) -> FloatArray:
    """Torque (3,) in N·m about FRD axes for normalised torque one, far from saturation, with a linear thrust curve."""
    torque: FloatArray = np.diag(
        vehicle.allocation_frd()[1:] @ (mixer[:, :3] * vehicle.max_thrust_newton[:, None])
    ).copy()
    return torque


@compiled
def _gain_to_unsaturate(motors: FloatArray, column: FloatArray, count: int, highest: float) -> float:
    """How far along `column` to go so that the worst excesses above `highest` and below 0 balance or vanish."""
    least = 0.0
    most = 0.0
    for i in range(count):
        if abs(column[i]) < 1e-6:
            continue
        if motors[i] < 0.0:
            k = (0.0 - motors[i]) / column[i]
            least, most = min(least, k), max(most, k)
        if motors[i] > highest:
            k = (highest - motors[i]) / column[i]
            least, most = min(least, k), max(most, k)
    return least + most


@compiled
def _unsaturate(
    motors: FloatArray, column: FloatArray, count: int, highest: float, only_reduce: bool
) -> None:
    """Move `motors` (N,) in place along `column` out of saturation as far as both ends allow."""
    gain = _gain_to_unsaturate(motors, column, count, highest)
    if only_reduce and gain > 0.0:
        return
    for i in range(count):
        motors[i] += gain * column[i]
    gain = 0.5 * _gain_to_unsaturate(motors, column, count, highest)
    for i in range(count):
        motors[i] += gain * column[i]


@compiled
def mix(
    roll: float,
    pitch: float,
    yaw: float,
    thrust: float,
    mixer: FloatArray,
    columns: FloatArray,
    motors: FloatArray,
    wanted: FloatArray,
    high: FloatArray,
    low: FloatArray,
) -> None:
    """Motor commands 0..1 into `motors` (N,) with PX4's order of giving way without airmode (MC_AIRMODE 0).

    Thrust is lowered first, then roll and pitch, and yaw gets what is left. `columns` is `mixer` transposed and
    contiguous (4, N); `wanted` (N,) is scratch; `high` and `low` (3,) say which torques could not be given in full
    (1.0), for the integrators.
    """
    count = mixer.shape[0]
    for i in range(count):
        wanted[i] = mixer[i, 3] * thrust + mixer[i, 0] * roll + mixer[i, 1] * pitch
        motors[i] = wanted[i]
        wanted[i] += mixer[i, 2] * yaw
    _unsaturate(motors, columns[3], count, 1.0, True)
    _unsaturate(motors, columns[0], count, 1.0, False)
    _unsaturate(motors, columns[1], count, 1.0, False)
    for i in range(count):
        motors[i] += mixer[i, 2] * yaw
    _unsaturate(motors, columns[2], count, 1.0 + YAW_HEADROOM, False)
    _unsaturate(motors, columns[3], count, 1.0, True)
    for i in range(count):
        motors[i] = min(max(motors[i], 0.0), 1.0)
    for axis in range(3):
        # Torque that was asked for and not given, in units of the asked (the columns are orthogonal).
        missing = 0.0
        norm = 0.0
        for i in range(count):
            missing += mixer[i, axis] * (wanted[i] - motors[i])
            norm += mixer[i, axis] * mixer[i, axis]
        missing /= norm
        high[axis] = 1.0 if missing > 1e-3 else 0.0
        low[axis] = 1.0 if missing < -1e-3 else 0.0


def transposed(mixer: FloatArray) -> FloatArray:
    """`mixer` (N, 4) as contiguous columns (4, N)."""
    result: Any = np.ascontiguousarray(mixer.T)
    return result  # type: ignore[no-any-return]
