"""The rotational plant of Eq. (1): M(η) and C(η, η̇), which the model-based law needs.

    M(η) η̈ + C(η, η̇) η̇ + D_η η̇ = Φ⁻ᵀ τ + δ_η ,   M = Φ⁻ᵀ I Φ⁻¹

C is taken in the form for which Ṁ − 2C is skew-symmetric (no energy from nowhere, Eq. (31)'s proof):
`C = Φ⁻ᵀ (I d/dt(Φ⁻¹) − [Iω]× Φ⁻¹)`, the same C η̇ as with ω × Iω.
"""

from __future__ import annotations

import numpy as np

from companion.control.compiled import compiled
from companion.control.rotation import (
    inverse_rate_matrix,
    inverse_rate_matrix_derivative,
    times,
    transposed_times,
)
from companion.control.structs import Vector


@compiled
def mass_matrix_times(euler: Vector, inertia: Vector, vector: Vector) -> Vector:
    """M(η) · vector (3,), for a diagonal inertia (3,) kg·m². M = Φ⁻ᵀ I Φ⁻¹."""
    inverse = inverse_rate_matrix(euler)
    momentum = times(inverse, vector)
    for i in range(3):
        momentum[i] *= inertia[i]
    return transposed_times(inverse, momentum)


@compiled
def coriolis_times(euler: Vector, euler_rate: Vector, inertia: Vector, vector: Vector) -> Vector:
    """C(η, η̇) · vector (3,), for a diagonal inertia (3,) kg·m²; C η̇ for vector = η̇."""
    inverse = inverse_rate_matrix(euler)
    body_rate = times(inverse, euler_rate)
    along = times(inverse, vector)
    turned = times(inverse_rate_matrix_derivative(euler, euler_rate), vector)
    a, b, c = inertia[0] * body_rate[0], inertia[1] * body_rate[1], inertia[2] * body_rate[2]
    body = np.empty(3)
    body[0] = inertia[0] * turned[0] - (b * along[2] - c * along[1])
    body[1] = inertia[1] * turned[1] - (c * along[0] - a * along[2])
    body[2] = inertia[2] * turned[2] - (a * along[1] - b * along[0])
    return transposed_times(inverse, body)
