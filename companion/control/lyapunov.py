"""The Lyapunov functions (20) and (32).

    V_p = β/2 e_pᵀe_p + m/2 ŨᵀŨ + ½ ξᵀK_i ξ + ½ tr(W̃ᵀ N⁻¹ W̃)
    V_η = β/2 e_ηᵀe_η + ½ Ũᵀ M(η) Ũ + ½ ξᵀK_i ξ + ½ tr(W̃ᵀ N⁻¹ W̃) ,   W̃ = W − Ŵ

W is the ideal matrix, known in a simulation at best, and m is the true mass. In flight both are replaced
by what there is: W = 0, so that the last term is ½ ‖Ŵ‖²_F / N, and m = m̂. The flown value can therefore rise while the
network learns; it falls for sure only where W and m are the true ones, as in the tests.
"""

from __future__ import annotations

import numpy as np

from companion.control.compiled import compiled
from companion.control.structs import Vector


@compiled
def lyapunov(
    error: Vector,
    U_error: Vector,
    momentum: Vector,
    integral: Vector,
    K_i: Vector,
    weight_distance: float,
    N: float,
    beta: float,
) -> float:
    """V of (20) or (32).

    `momentum` (3,) is m Ũ or M(η) Ũ; `weight_distance` is ‖W − Ŵ‖_F. The network's term is left out
    for laws without one (N = 0).
    """
    total = 0.0
    for i in range(3):
        total += beta * error[i] * error[i] + U_error[i] * momentum[i] + K_i[i] * integral[i] * integral[i]
    if N > 0.0:
        total += weight_distance * weight_distance / N
    return 0.5 * total


def position_lyapunov(
    error: Vector,
    U_error: Vector,
    integral: Vector,
    weights: Vector,
    *,
    mass_kg: float,
    ideal_weights: Vector,
    K_i: Vector,
    N: float,
    beta: float = 1.0,
) -> float:
    """V_p of Eq. (20) with the true mass and the ideal weights (L, 3), for analysis and tests."""
    distance = float(np.linalg.norm(ideal_weights - weights))
    return float(lyapunov(error, U_error, mass_kg * U_error, integral, K_i, distance, N, beta))
