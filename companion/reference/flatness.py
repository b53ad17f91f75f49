"""What a multirotor has to do to follow a trajectory exactly: thrust, attitude, rates, by flatness.

With the thrust along body z, `m (a + g e₃) + D v = F z_B` gives thrust and body z from the
acceleration; yaw fixes the rest of the attitude (ZYX Euler, as in control_laws.md section 1). Jerk and snap
give the body's rate and angular acceleration as derivatives of that rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.control.structs import Vector
from companion.reference.trajectory import Trajectory

GRAVITY_M_S2 = 9.81
_TINY = 1e-9


@dataclass(frozen=True, slots=True)
class Motion:
    """A trajectory at many times."""

    times_s: Vector  # (n,)
    derivatives: Vector  # (n, 5, 3) position to snap, ENU
    yaw: Vector  # (n, 3) yaw, its rate and acceleration

    def sped_up(self, factor: float) -> Motion:
        """Return the same path flown `factor` times as fast."""
        return Motion(
            self.times_s / factor,
            self.derivatives * (factor ** np.arange(5.0))[None, :, None],
            self.yaw * (factor ** np.arange(3.0))[None, :],
        )


@dataclass(frozen=True, slots=True)
class Demand:
    """What the vehicle has to do along a motion."""

    thrust_newton: Vector  # (n,)
    tilt_rad: Vector  # (n,) angle between body z and the vertical
    body_rate_flu: Vector  # (n, 3) rad/s
    angular_acceleration_flu: Vector  # (n, 3) rad/s²


def sampled(trajectory: Trajectory, times_s: Vector) -> Motion:
    """Sample a trajectory at `times_s` (n,)."""
    derivatives = np.empty((times_s.size, 5, 3))
    yaw = np.empty((times_s.size, 3))
    for i, time_s in enumerate(times_s.tolist()):
        r = trajectory.sample(time_s)
        derivatives[i] = (r.position_enu, r.velocity_enu, r.acceleration_enu, r.jerk_enu, r.snap_enu)
        yaw[i] = r.yaw_rad, r.yaw_rate_rad_s, r.yaw_acceleration_rad_s2
    return Motion(times_s, derivatives, yaw)


def demand(motion: Motion, mass_kg: float, drag_kg_s: Vector | None = None) -> Demand:
    """Return thrust, tilt, body rate and angular acceleration for following `motion` exactly.

    `drag_kg_s` (3,) is the diagonal of D_p in Eq. (1), none by default. In free fall the attitude is not
    defined; rates there come out as very large numbers, not as NaN.
    """
    drag = np.zeros(3) if drag_kg_s is None else np.asarray(drag_kg_s, dtype=np.float64)
    along = motion.derivatives
    force = mass_kg * along[:, 2:5] + drag * along[:, 1:4]  # (n, 3, 3): force and its two derivatives
    force[:, 0, 2] += mass_kg * GRAVITY_M_S2
    z, z1, z2 = _direction(force[:, 0], force[:, 1], force[:, 2])

    yaw, rate, acceleration = motion.yaw.T[:, :, None]
    ahead = np.concatenate([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    left = np.concatenate([-np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)], axis=1)
    left1 = -ahead * rate
    left2 = -ahead * acceleration - left * rate**2
    # ZYX: body x has no component along the horizontal direction to the left of the yaw.
    x, x1, x2 = _direction(
        np.cross(left, z),
        np.cross(left1, z) + np.cross(left, z1),
        np.cross(left2, z) + 2.0 * np.cross(left1, z1) + np.cross(left, z2),
    )
    y = np.cross(z, x)
    y1 = np.cross(z1, x) + np.cross(z, x1)
    y2 = np.cross(z2, x) + 2.0 * np.cross(z1, x1) + np.cross(z, x2)

    # Rᵀ R' = [ω]ₓ and (Rᵀ R')' = [ω']ₓ: ω = (z·y', x·z', y·x'), differentiated once more.
    body_rate = np.stack([_dot(z, y1), _dot(x, z1), _dot(y, x1)], axis=1)
    angular = np.stack(
        [_dot(z1, y1) + _dot(z, y2), _dot(x1, z1) + _dot(x, z2), _dot(y1, x1) + _dot(y, x2)], axis=1
    )
    tilt = np.arctan2(np.hypot(z[:, 0], z[:, 1]), z[:, 2])
    return Demand(np.linalg.norm(force[:, 0], axis=1), tilt, body_rate, angular)


def _dot(a: Vector, b: Vector) -> Vector:
    product: Vector = np.einsum("ij,ij->i", a, b)
    return product


def _direction(v: Vector, v1: Vector, v2: Vector) -> tuple[Vector, Vector, Vector]:
    """Unit vector along v (n, 3), with its first and second derivative."""
    length = np.maximum(np.linalg.norm(v, axis=1), _TINY)[:, None]
    length1 = _dot(v, v1)[:, None] / length
    length2 = (_dot(v1, v1) + _dot(v, v2))[:, None] / length - length1**2 / length
    u = v / length
    u1 = (v1 - u * length1) / length
    u2 = (v2 - 2.0 * u1 * length1 - u * length2) / length
    return u, u1, u2
