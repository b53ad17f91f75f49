"""Allocation `[F, τ] = B T` for any rotor layout, and its inverse within the rotors' bounds.

control_laws.md, section 2: the report prints `F = 4ΣT` and signs of τ that contradict its own matrix; the matrix
is right. Columns of B are rotors, rows are thrust and torque about x (forward), y (left), z (up), body FLU.
"""

from __future__ import annotations

import numpy as np

from companion.control.bounds import ROLL_PITCH_TORQUE, THRUST_FOR_TORQUE, YAW_TORQUE
from companion.control.compiled import compiled
from companion.control.structs import Vector


def allocation_matrix(arms: Vector, spins: Vector, torque_per_newton: float) -> Vector:
    """B (4, n) of n rotors at `arms` (n, 2) m, x forward and y left of the centre of mass.

    `spins` (n,): sign of the reaction torque about z up, +1 for a rotor that turns clockwise seen from above.
    `torque_per_newton` is kτ in m. Raises ValueError when the layout cannot steer all four of F and τ.
    """
    arms = np.asarray(arms, dtype=np.float64)
    B = np.vstack(
        [np.ones(len(arms)), arms[:, 1], -arms[:, 0], torque_per_newton * np.asarray(spins, dtype=np.float64)]
    )
    if np.linalg.matrix_rank(B, tol=1e-9) < 4:
        raise ValueError(
            "this rotor layout cannot set thrust, roll, pitch and yaw independently: "
            "at least four rotors, not in one line, with both signs of spin"
        )
    return B


@compiled
def _widest_step(base: Vector, direction: Vector, count: int, low: float, high: float) -> float:
    """The greatest s in [0, 1] for which base + s·direction lies within [low, high] for every rotor."""
    step = 1.0
    for k in range(count):
        if direction[k] > 0.0:
            step = min(step, (high - base[k]) / direction[k])
        elif direction[k] < 0.0:
            step = min(step, (low - base[k]) / direction[k])
    return max(0.0, step)


@compiled
def allocate(
    mixer: Vector,
    count: int,
    low: float,
    high: float,
    thrust: float,
    torque: Vector,
    rotors: Vector,
    got: Vector,
) -> int:
    """Rotor thrusts for F and τ (3,), each within [low, high] N; the bits of what had to be cut.

    `mixer` (8, 4) is the pseudo-inverse of B; `rotors` (8,) and `got` (4,) = [F, τ] as achieved are filled in.
    Thrust, roll and pitch go before yaw: yaw is cut first, then the thrust is moved so that roll and pitch
    fit (their loss turns a vehicle over, a moment of wrong thrust does not), roll and pitch last.
    """
    flags = 0
    tilting = np.zeros(mixer.shape[0])
    turning = np.zeros(mixer.shape[0])
    least, most = np.inf, -np.inf
    for k in range(count):
        tilting[k] = mixer[k, 1] * torque[0] + mixer[k, 2] * torque[1]
        turning[k] = mixer[k, 3] * torque[2]
        least, most = min(least, tilting[k]), max(most, tilting[k])
    tilt_share = 1.0
    if most - least > high - low:
        tilt_share = (high - low) / (most - least)
        flags |= ROLL_PITCH_TORQUE
    # Bounds on the thrust within which every rotor can give its part of roll and pitch. A layout may
    # share the thrust unevenly, so they are found rotor by rotor.
    thrust_low, thrust_high = -np.inf, np.inf
    for k in range(count):
        share = mixer[k, 0]
        tilting[k] *= tilt_share
        if share > 1e-12:
            thrust_low = max(thrust_low, (low - tilting[k]) / share)
            thrust_high = min(thrust_high, (high - tilting[k]) / share)
    total = min(max(thrust, thrust_low), thrust_high)
    if abs(total - thrust) > 1e-9 * (1.0 + abs(thrust)):
        flags |= THRUST_FOR_TORQUE
    for k in range(count):
        rotors[k] = mixer[k, 0] * total + tilting[k]
    turn_share = _widest_step(rotors, turning, count, low, high)
    if turn_share < 1.0:
        flags |= YAW_TORQUE
    for k in range(count):
        rotors[k] = min(high, max(low, rotors[k] + turn_share * turning[k]))
    got[0] = total
    got[1], got[2], got[3] = tilt_share * torque[0], tilt_share * torque[1], turn_share * torque[2]
    return flags
