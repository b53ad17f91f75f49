"""From a force to an attitude: Eqs. (17), (18), and with the reference's jerk and snap their derivatives.

A multirotor is differentially flat: position and yaw with their derivatives fix attitude, its rate and
its acceleration. The reference's share of η_d is differentiated here exactly, without noise; only the small
rest, which feedback adds, goes through the command filter.
"""

from __future__ import annotations

import math

import numpy as np

from companion.control.compiled import compiled
from companion.control.structs import Vector


@compiled
def euler_from_force(force: Vector, yaw: float) -> Vector:
    """η_d (3,) whose thrust direction is that of f (3,), f_z > 0, at heading `yaw`. Eqs. (17), (18).

    From `f = F r₃(η_d)`; the report's own (17), (18) lost f_x and f_y (control_laws.md, section 3).
    """
    cy, sy = math.cos(yaw), math.sin(yaw)
    euler = np.empty(3)
    euler[1] = math.atan((force[0] * cy + force[1] * sy) / force[2])
    euler[0] = math.atan(math.cos(euler[1]) * (force[0] * sy - force[1] * cy) / force[2])
    euler[2] = yaw
    return euler


@compiled
def force_from_euler(euler: Vector, force_z: float) -> Vector:
    """The force (3,) along r₃(η) whose vertical part is `force_z`: the inverse of `euler_from_force`."""
    cy, sy = math.cos(euler[2]), math.sin(euler[2])
    along, across = math.tan(euler[1]), math.tan(euler[0]) / math.cos(euler[1])
    force = np.empty(3)
    force[0] = force_z * (along * cy + across * sy)
    force[1] = force_z * (along * sy - across * cy)
    force[2] = force_z
    return force


@compiled
def arctangent(
    y: float, dy: float, ddy: float, x: float, dx: float, ddx: float
) -> tuple[float, float, float]:
    """atan(y / x), x > 0, and its first two derivatives, from those of y and x."""
    square = x * x + y * y
    turning = dy * x - y * dx
    rate = turning / square
    acceleration = (ddy * x - y * ddx - rate * 2.0 * (x * dx + y * dy)) / square
    return math.atan(y / x), rate, acceleration


@compiled
def flat_attitude(
    acceleration: Vector,
    jerk: Vector,
    snap: Vector,
    yaw: float,
    yaw_rate: float,
    yaw_acceleration: float,
    gravity: float,
) -> Vector:
    """η, η̇, η̈ as rows of (3, 3) of a vehicle that follows the reference without drag.

    acceleration, jerk, snap (3,) in m/s², m/s³, m/s⁴. Where the reference falls so fast that the thrust
    would point down, p̈_z + g is kept above a tenth of g.
    """
    cy, sy = math.cos(yaw), math.sin(yaw)
    # w up; u along the heading, v to its right: tan θ = u / w, tan φ = v cos θ / w = v / √(u² + w²)
    w, dw, ddw = acceleration[2] + gravity, jerk[2], snap[2]
    if w < 0.1 * gravity:
        w, dw, ddw = 0.1 * gravity, 0.0, 0.0
    u = acceleration[0] * cy + acceleration[1] * sy
    v = acceleration[0] * sy - acceleration[1] * cy
    jerk_u, jerk_v = jerk[0] * cy + jerk[1] * sy, jerk[0] * sy - jerk[1] * cy
    du, dv = jerk_u - yaw_rate * v, jerk_v + yaw_rate * u
    ddu = snap[0] * cy + snap[1] * sy - yaw_rate * (jerk_v + dv) - yaw_acceleration * v
    ddv = snap[0] * sy - snap[1] * cy + yaw_rate * (jerk_u + du) + yaw_acceleration * u
    q = math.sqrt(u * u + w * w)
    dq = (u * du + w * dw) / q
    ddq = (du * du + u * ddu + dw * dw + w * ddw - dq * dq) / q
    rows = np.empty((3, 3))
    rows[0, 0], rows[1, 0], rows[2, 0] = arctangent(v, dv, ddv, q, dq, ddq)
    rows[0, 1], rows[1, 1], rows[2, 1] = arctangent(u, du, ddu, w, dw, ddw)
    rows[0, 2], rows[1, 2], rows[2, 2] = yaw, yaw_rate, yaw_acceleration
    return rows
