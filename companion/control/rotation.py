"""Attitude: quaternions, ZYX Euler angles, rotation matrices and the kinematics η̇ = Φ(η) ω.

Body FLU to world ENU, Hamilton quaternions scalar first, angles in rad, η = [roll φ, pitch θ, yaw ψ].
Φ is singular at θ = ±90°. Nothing here guards against it: the law refuses to run long before
(`bounds.py`), so that no division by a small cos θ is ever reached.
"""

from __future__ import annotations

import math

import numpy as np

from companion.control.compiled import compiled
from companion.control.structs import Vector


@compiled
def wrap_angle(angle: float) -> float:
    """The same angle in [-π, π]."""
    return math.atan2(math.sin(angle), math.cos(angle))


@compiled
def euler_from_quaternion(quaternion: Vector) -> Vector:
    """η (3,) of a unit quaternion (4,). Exact up to θ = ±90°, where roll and yaw are not defined apart."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    euler = np.empty(3)
    euler[0] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    euler[1] = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    euler[2] = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return euler


@compiled
def quaternion_from_euler(euler: Vector) -> Vector:
    """Unit quaternion (4,) of η (3,): yaw, then pitch, then roll."""
    cr, sr = math.cos(0.5 * euler[0]), math.sin(0.5 * euler[0])
    cp, sp = math.cos(0.5 * euler[1]), math.sin(0.5 * euler[1])
    cy, sy = math.cos(0.5 * euler[2]), math.sin(0.5 * euler[2])
    quaternion = np.empty(4)
    quaternion[0] = cr * cp * cy + sr * sp * sy
    quaternion[1] = sr * cp * cy - cr * sp * sy
    quaternion[2] = cr * sp * cy + sr * cp * sy
    quaternion[3] = cr * cp * sy - sr * sp * cy
    return quaternion


@compiled
def rotation_from_quaternion(quaternion: Vector) -> Vector:
    """R (3, 3), body to world: its third column is r₃, the direction of thrust."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return R


@compiled
def thrust_direction(euler: Vector) -> Vector:
    """r₃(η) (3,): the body's z axis in the world, third column of R(η)."""
    cr, sr = math.cos(euler[0]), math.sin(euler[0])
    cp, sp = math.cos(euler[1]), math.sin(euler[1])
    cy, sy = math.cos(euler[2]), math.sin(euler[2])
    direction = np.empty(3)
    direction[0] = cr * sp * cy + sr * sy
    direction[1] = cr * sp * sy - sr * cy
    direction[2] = cr * cp
    return direction


@compiled
def quaternion_product(left: Vector, right: Vector) -> Vector:
    """left ⊗ right (4,): the rotation `right` in the frame that `left` makes."""
    a, b, c, d = left[0], left[1], left[2], left[3]
    e, f, g, h = right[0], right[1], right[2], right[3]
    product = np.empty(4)
    product[0] = a * e - b * f - c * g - d * h
    product[1] = a * f + b * e + c * h - d * g
    product[2] = a * g - b * h + c * e + d * f
    product[3] = a * h + b * g - c * f + d * e
    return product


@compiled
def quaternion_from_rotation_vector(rotation: Vector) -> Vector:
    """Unit quaternion (4,) of a turn by |rotation| rad about `rotation` (3,)."""
    half = 0.5 * math.sqrt(rotation[0] ** 2 + rotation[1] ** 2 + rotation[2] ** 2)
    ratio = 0.5 * (math.sin(half) / half if half > 1e-8 else 1.0 - half * half / 6.0)
    quaternion = np.empty(4)
    quaternion[0] = math.cos(half)
    for i in range(3):
        quaternion[i + 1] = ratio * rotation[i]
    return quaternion


@compiled
def rate_matrix(euler: Vector) -> Vector:
    """Φ(η) (3, 3): body rate to Euler rate."""
    cr, sr = math.cos(euler[0]), math.sin(euler[0])
    cp, tp = math.cos(euler[1]), math.tan(euler[1])
    Phi = np.zeros((3, 3))
    Phi[0, 0], Phi[0, 1], Phi[0, 2] = 1.0, sr * tp, cr * tp
    Phi[1, 1], Phi[1, 2] = cr, -sr
    Phi[2, 1], Phi[2, 2] = sr / cp, cr / cp
    return Phi


@compiled
def inverse_rate_matrix(euler: Vector) -> Vector:
    """Φ⁻¹(η) (3, 3): Euler rate to body rate. Defined everywhere."""
    cr, sr = math.cos(euler[0]), math.sin(euler[0])
    cp, sp = math.cos(euler[1]), math.sin(euler[1])
    inverse = np.zeros((3, 3))
    inverse[0, 0], inverse[0, 2] = 1.0, -sp
    inverse[1, 1], inverse[1, 2] = cr, sr * cp
    inverse[2, 1], inverse[2, 2] = -sr, cr * cp
    return inverse


@compiled
def inverse_rate_matrix_derivative(euler: Vector, euler_rate: Vector) -> Vector:
    """d/dt Φ⁻¹(η) (3, 3), for C(η, η̇)."""
    cr, sr = math.cos(euler[0]), math.sin(euler[0])
    cp, sp = math.cos(euler[1]), math.sin(euler[1])
    roll_rate, pitch_rate = euler_rate[0], euler_rate[1]
    out = np.zeros((3, 3))
    out[0, 2] = -cp * pitch_rate
    out[1, 1] = -sr * roll_rate
    out[1, 2] = cr * cp * roll_rate - sr * sp * pitch_rate
    out[2, 1] = -cr * roll_rate
    out[2, 2] = -sr * cp * roll_rate - cr * sp * pitch_rate
    return out


@compiled
def times(matrix: Vector, vector: Vector) -> Vector:
    """matrix (3, 3) · vector (3,). A loop: for three numbers a call into BLAS costs more than the work."""
    product = np.empty(3)
    for i in range(3):
        product[i] = matrix[i, 0] * vector[0] + matrix[i, 1] * vector[1] + matrix[i, 2] * vector[2]
    return product


@compiled
def transposed_times(matrix: Vector, vector: Vector) -> Vector:
    """matrixᵀ (3, 3) · vector (3,)."""
    product = np.empty(3)
    for i in range(3):
        product[i] = matrix[0, i] * vector[0] + matrix[1, i] * vector[1] + matrix[2, i] * vector[2]
    return product
