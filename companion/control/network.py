"""The functional-link network of Eqs. (11), (26) and its adaptation, Eqs. (15), (29).

    f_W ≈ Wᵀ tanh(Vᵀ γ) ,   γ ∈ R¹⁰ = [1, a, b, c]

a, b, c are ṗ, η, U̇_p or η, η̇, U̇_η, with η as `attitude_feature` gives it.
V (10, L) is drawn once from a seed and stays; only Ŵ (L, 3) adapts, so the output is linear in what is learnt.
"""

from __future__ import annotations

import math

import numpy as np

from companion.control.compiled import compiled
from companion.control.structs import Vector


def draw_input_weights(seed: int, hidden: int, scales: Vector) -> Vector:
    """V (10, L), uniform in ±1 and scaled by row. `scales` (4,): for the bias and the three 3-vectors of γ.

    The scales bring rad, m/s and rad/s² to the range where tanh still tells values apart.
    """
    rows = np.repeat(np.asarray(scales, dtype=np.float64), [1, 3, 3, 3])
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (rows.size, hidden)) * rows[:, None]


@compiled
def hidden_layer(V: Vector, a: Vector, b: Vector, c: Vector) -> Vector:
    """σ = tanh(Vᵀ γ) (L,), γ = [1, a, b, c] of three 3-vectors."""
    sigma = np.empty(V.shape[1])
    for j in range(V.shape[1]):
        total = V[0, j]
        for i in range(3):
            total += V[1 + i, j] * a[i] + V[4 + i, j] * b[i] + V[7 + i, j] * c[i]
        sigma[j] = math.tanh(total)
    return sigma


@compiled
def attitude_feature(euler: Vector, yaw_desired: float) -> Vector:
    """What stands for η in γ_p and γ_η: (3,) [φ, θ, π/2 + sin(ψ − ψ_d)].

    The report has ψ itself, whose jump at ±π would be a jump of the force. Near the desired yaw the sine is the yaw
    error, so a network learns the same thing whichever way the nose points; and it has no jump anywhere, where a wrapped
    difference keeps one behind us. With π/2 it is ψ where the nose points north, as it did when the gains were found:
    without, the hidden layer works at another point (RMS x +8 %, y +18 % in the report's flight, five seeds).
    """
    return np.array((euler[0], euler[1], 0.5 * math.pi + math.sin(euler[2] - yaw_desired)))


@compiled
def about_up(vector: Vector, angle: float) -> Vector:
    """`vector` (3,) turned by `angle` rad about world z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array((c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]))


@compiled
def output_layer(W: Vector, sigma: Vector) -> Vector:
    """Ŵᵀσ (3,), N or N·m."""
    out = np.zeros(3)
    for j in range(sigma.size):
        for i in range(3):
            out[i] += W[j, i] * sigma[j]
    return out


@compiled
def frobenius_norm(W: Vector) -> float:
    """‖W‖_F of (L, 3)."""
    total = 0.0
    for j in range(W.shape[0]):
        total += W[j, 0] * W[j, 0] + W[j, 1] * W[j, 1] + W[j, 2] * W[j, 2]
    return math.sqrt(total)


@compiled
def adapt(
    W: Vector, sigma: Vector, U_error: Vector, N: float, kappa: float, bound: float, dt: float, W_out: Vector
) -> bool:
    """One step of dŴ/dt = N (σ Ũᵀ − κ ‖Ũ‖ Ŵ) into `W_out` (L, 3); True where the bound ‖Ŵ‖_F ≤ bound acted.

    Eqs. (15), (29) with the sign of control_laws.md 3. The leak is taken implicitly,
    `Ŵ ← (Ŵ + dt N σŨᵀ) / (1 + dt N κ‖Ũ‖)`, which cannot diverge for any step.
    """
    size = math.sqrt(U_error[0] ** 2 + U_error[1] ** 2 + U_error[2] ** 2)
    leak = 1.0 / (1.0 + dt * N * kappa * size)
    for j in range(sigma.size):
        for i in range(3):
            W_out[j, i] = (W[j, i] + dt * N * sigma[j] * U_error[i]) * leak
    norm = frobenius_norm(W_out)
    if norm <= bound:
        return False
    for j in range(sigma.size):
        for i in range(3):
            W_out[j, i] *= bound / norm
    return True


@compiled
def smooth_sign(value: float, width: float) -> float:
    """sign(value), or tanh(value / width) where a boundary layer is given (width > 0)."""
    if width > 0.0:
        return math.tanh(value / width)
    return float(np.sign(value))
