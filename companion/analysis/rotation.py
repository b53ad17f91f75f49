"""Whole columns of attitudes at once: quaternions to the report's Euler angles, and angles without jumps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def euler_from_quaternions(quaternions_wxyz: Array) -> Array:
    """ZYX Euler angles [φ, θ, ψ] (n, 3) rad of Hamilton quaternions (n, 4), body to world."""
    w, x, y, z = np.moveaxis(np.asarray(quaternions_wxyz, dtype=np.float64), -1, 0)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], axis=-1)


def wrap_angle(angle_rad: Array) -> Array:
    """Return the same angles within (-π, π]."""
    return np.pi - np.mod(np.pi - np.asarray(angle_rad), 2.0 * np.pi)
