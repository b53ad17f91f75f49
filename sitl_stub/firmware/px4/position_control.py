"""Compiled position and velocity loops after PX4's PositionControl: setpoints in NED to attitude and thrust.

Cascade: position P → velocity PID → acceleration → thrust vector, with vertical thrust before horizontal, tilt and thrust
limits and PX4's anti-windup. NaN in a setpoint means "not controlled at this level". Layout: `layout.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.px4 import layout as at
from sitl_stub.physics.compiled import compiled

FloatArray = NDArray[np.float64]

ONE_G = 9.80665


@compiled
def _limit_xy(
    base_x: float, base_y: float, extra_x: float, extra_y: float, limit: float
) -> tuple[float, float]:
    """`base + extra` with length at most `limit`, `base` (from position) kept before `extra` (fed forward)."""
    x, y = base_x + extra_x, base_y + extra_y
    if x * x + y * y <= limit * limit:
        return x, y
    base = math.hypot(base_x, base_y)
    if base >= limit:
        return base_x / base * limit, base_y / base * limit
    extra = math.hypot(extra_x, extra_y)
    if extra < 1e-9:
        return base_x, base_y
    ux, uy = extra_x / extra, extra_y / extra
    along = ux * base_x + uy * base_y
    room = along * along + limit * limit - base * base
    length = -along + math.sqrt(max(room, 0.0))
    return base_x + ux * length, base_y + uy * length


@compiled
def trajectory_to_attitude(
    position: FloatArray,
    velocity: FloatArray,
    yaw: float,
    setpoint: FloatArray,
    gains: FloatArray,
    memory: FloatArray,
    dt_s: float,
) -> None:
    """One step of both loops. `position`, `velocity` (3,) NED and `yaw` are the estimate; results go to memory[OUT_...].

    Raises nothing; a setpoint with no level at all on an axis is read as zero acceleration there.
    """
    if memory[at.TRAJECTORY_RUNNING] == 0.0:
        for i in range(3):
            memory[at.VELOCITY_PREVIOUS + i] = velocity[i]
            memory[at.VELOCITY_SLOPE + i] = 0.0
            memory[at.VELOCITY_INTEGRAL + i] = 0.0
        memory[at.TRAJECTORY_RUNNING] = 1.0
    cutoff = gains[at.VELOCITY_D_CUTOFF_HZ]
    blend = dt_s / (dt_s + 1.0 / (2.0 * math.pi * cutoff)) if cutoff > 0.0 else 1.0
    for i in range(3):
        slope = (velocity[i] - memory[at.VELOCITY_PREVIOUS + i]) / dt_s
        memory[at.VELOCITY_SLOPE + i] += blend * (slope - memory[at.VELOCITY_SLOPE + i])
        memory[at.VELOCITY_PREVIOUS + i] = velocity[i]

    for i in range(3):
        from_position = 0.0
        if not math.isnan(setpoint[at.POSITION + i]):
            from_position = (setpoint[at.POSITION + i] - position[i]) * gains[at.POSITION_P + i]
        memory[at.OUT_VELOCITY + i] = from_position
    feed_x, feed_y = setpoint[at.VELOCITY], setpoint[at.VELOCITY + 1]
    vx, vy = _limit_xy(
        memory[at.OUT_VELOCITY],
        memory[at.OUT_VELOCITY + 1],
        0.0 if math.isnan(feed_x) else feed_x,
        0.0 if math.isnan(feed_y) else feed_y,
        gains[at.VELOCITY_MAX_XY],
    )
    memory[at.OUT_VELOCITY] = vx
    memory[at.OUT_VELOCITY + 1] = vy
    vz = memory[at.OUT_VELOCITY + 2] + (
        0.0 if math.isnan(setpoint[at.VELOCITY + 2]) else setpoint[at.VELOCITY + 2]
    )
    memory[at.OUT_VELOCITY + 2] = min(max(vz, -gains[at.VELOCITY_MAX_UP]), gains[at.VELOCITY_MAX_DOWN])

    hover = gains[at.HOVER_THRUST]
    error_x = error_y = error_z = 0.0
    memory[at.VELOCITY_INTEGRAL + 2] = min(max(memory[at.VELOCITY_INTEGRAL + 2], -ONE_G), ONE_G)
    for i in range(3):
        feed = setpoint[at.ACCELERATION + i]
        acceleration = 0.0 if math.isnan(feed) else feed
        if not (math.isnan(setpoint[at.POSITION + i]) and math.isnan(setpoint[at.VELOCITY + i])):
            error = memory[at.OUT_VELOCITY + i] - velocity[i]
            acceleration += (
                gains[at.VELOCITY_P + i] * error
                + memory[at.VELOCITY_INTEGRAL + i]
                - gains[at.VELOCITY_D + i] * memory[at.VELOCITY_SLOPE + i]
            )
            if i == 0:
                error_x = error
            elif i == 1:
                error_y = error
            else:
                error_z = error
        memory[at.OUT_ACCELERATION + i] = acceleration

    ax, ay, az = memory[at.OUT_ACCELERATION], memory[at.OUT_ACCELERATION + 1], memory[at.OUT_ACCELERATION + 2]
    up_force = ONE_G if gains[at.ACCELERATION_DECOUPLED] > 0.0 else ONE_G - az
    # body z points down: against the wanted thrust
    bx, by, bz = -ax, -ay, max(up_force, 1e-3)
    norm = math.sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx / norm, by / norm, bz / norm
    tilt_limit = gains[at.TILT_MAX]
    if bz < math.cos(tilt_limit):
        level = math.hypot(bx, by)
        bx, by, bz = (
            bx / level * math.sin(tilt_limit),
            by / level * math.sin(tilt_limit),
            math.cos(tilt_limit),
        )
    collective = min((az * hover / ONE_G - hover) / bz, -gains[at.THRUST_MIN])
    tx, ty, tz = bx * collective, by * collective, bz * collective

    most = gains[at.THRUST_MAX]
    if (tz >= -gains[at.THRUST_MIN] and error_z >= 0.0) or (tz <= -most and error_z <= 0.0):
        error_z = 0.0
    level = math.hypot(tx, ty)
    kept = min(level, gains[at.THRUST_XY_MARGIN])
    tz = max(tz, -math.sqrt(most * most - kept * kept))
    level_most = math.sqrt(max(most * most - tz * tz, 0.0))
    if level > level_most:
        tx, ty = tx / level * level_most, ty / level * level_most
    made_x, made_y = tx * ONE_G / hover, ty * ONE_G / hover
    if ax * ax + ay * ay > made_x * made_x + made_y * made_y:
        back = 2.0 / gains[at.VELOCITY_P] if gains[at.VELOCITY_P] > 0.0 else 0.0
        error_x -= back * (ax - made_x)
        error_y -= back * (ay - made_y)
    memory[at.VELOCITY_INTEGRAL] += error_x * gains[at.VELOCITY_I] * dt_s
    memory[at.VELOCITY_INTEGRAL + 1] += error_y * gains[at.VELOCITY_I + 1] * dt_s
    memory[at.VELOCITY_INTEGRAL + 2] += error_z * gains[at.VELOCITY_I + 2] * dt_s

    memory[at.OUT_THRUST_NED] = tx
    memory[at.OUT_THRUST_NED + 1] = ty
    memory[at.OUT_THRUST_NED + 2] = tz
    memory[at.OUT_THRUST] = math.sqrt(tx * tx + ty * ty + tz * tz)
    heading = yaw if math.isnan(setpoint[at.YAW]) else setpoint[at.YAW]
    _thrust_direction_to_quaternion(tx, ty, tz, heading, memory)


@compiled
def _thrust_direction_to_quaternion(tx: float, ty: float, tz: float, yaw: float, memory: FloatArray) -> None:
    """Attitude with body z against the thrust vector and x looking along `yaw`, into memory[at.OUT_QUATERNION]."""
    norm = math.sqrt(tx * tx + ty * ty + tz * tz)
    zx, zy, zz = (-tx / norm, -ty / norm, -tz / norm) if norm > 1e-9 else (0.0, 0.0, 1.0)
    # x = y_c × z with y_c = (−sin ψ, cos ψ, 0)
    sin_yaw, cos_yaw = math.sin(yaw), math.cos(yaw)
    xx, xy, xz = cos_yaw * zz, sin_yaw * zz, -sin_yaw * zy - cos_yaw * zx
    if zz < 0.0:
        xx, xy, xz = -xx, -xy, -xz
    norm = math.sqrt(xx * xx + xy * xy + xz * xz)
    xx, xy, xz = xx / norm, xy / norm, xz / norm
    yx, yy, yz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
    trace = xx + yy + zz
    if trace > 0.0:
        s = 2.0 * math.sqrt(trace + 1.0)
        w, x, y, z = 0.25 * s, (yz - zy) / s, (zx - xz) / s, (xy - yx) / s
    elif xx > yy and xx > zz:
        s = 2.0 * math.sqrt(1.0 + xx - yy - zz)
        w, x, y, z = (yz - zy) / s, 0.25 * s, (yx + xy) / s, (zx + xz) / s
    elif yy > zz:
        s = 2.0 * math.sqrt(1.0 + yy - xx - zz)
        w, x, y, z = (zx - xz) / s, (yx + xy) / s, 0.25 * s, (zy + yz) / s
    else:
        s = 2.0 * math.sqrt(1.0 + zz - xx - yy)
        w, x, y, z = (xy - yx) / s, (zx + xz) / s, (zy + yz) / s, 0.25 * s
    memory[at.OUT_QUATERNION] = w
    memory[at.OUT_QUATERNION + 1] = x
    memory[at.OUT_QUATERNION + 2] = y
    memory[at.OUT_QUATERNION + 3] = z
