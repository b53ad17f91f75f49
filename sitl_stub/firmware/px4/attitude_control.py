"""Compiled attitude and rate loops after PX4: quaternion attitude P with reduced yaw, rate PID, gyro filters.

Sources: Brescianini et al., "Nonlinear quadrocopter attitude control" (ETH 2013), which PX4 follows (mc_att_control,
mc_rate_control, VehicleAngularVelocity). Layout of the arrays: `layout.py`. FRD body, NED world.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.px4 import layout as at
from sitl_stub.physics.compiled import compiled

FloatArray = NDArray[np.float64]


INTEGRATOR_FADE_RATE = math.radians(400.0)
"""Rate error at which the rate integrator stops, rad/s (PX4: against bounce-back after flips)."""


@compiled
def attitude_to_rates(
    q: FloatArray, target: FloatArray, yaw_rate: float, gains: FloatArray, memory: FloatArray
) -> None:
    """Rate setpoint (rad/s, FRD) for attitude `q` (4,) to reach `target` (4,), into memory[at.OUT_RATES].

    Tilt is corrected along the shortest way, yaw with its own weight; `yaw_rate` (about the world's down axis) is fed
    forward. Degenerate targets (half a turn away) follow `target` as a whole.
    """
    w0, x0, y0, z0 = q[0], q[1], q[2], q[3]
    wd, xd, yd, zd = target[0], target[1], target[2], target[3]
    # body z axes in the world, now and wanted
    ax, ay, az = 2.0 * (x0 * z0 + w0 * y0), 2.0 * (y0 * z0 - w0 * x0), w0 * w0 - x0 * x0 - y0 * y0 + z0 * z0
    bx, by, bz = 2.0 * (xd * zd + wd * yd), 2.0 * (yd * zd - wd * xd), wd * wd - xd * xd - yd * yd + zd * zd
    # shortest rotation taking a to b: [1 + a·b, a × b] normalised
    rw = 1.0 + ax * bx + ay * by + az * bz
    rx, ry, rz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    norm = math.sqrt(rw * rw + rx * rx + ry * ry + rz * rz)
    if norm < 1e-5:
        mw, mx, my, mz = wd, xd, yd, zd
    else:
        rw, rx, ry, rz = rw / norm, rx / norm, ry / norm, rz / norm
        # reduced attitude r ⊗ q: wanted tilt, present yaw
        ew = rw * w0 - rx * x0 - ry * y0 - rz * z0
        ex = rw * x0 + rx * w0 + ry * z0 - rz * y0
        ey = rw * y0 - rx * z0 + ry * w0 + rz * x0
        ez = rw * z0 + rx * y0 - ry * x0 + rz * w0
        # what is left, a rotation about body z: conj(reduced) ⊗ target
        tw = ew * wd + ex * xd + ey * yd + ez * zd
        tz = ew * zd - ex * yd + ey * xd - ez * wd
        if tw < 0.0:
            tw, tz = -tw, -tz
        tw = min(max(tw, -1.0), 1.0)
        tz = min(max(tz, -1.0), 1.0)
        weight = gains[at.YAW_WEIGHT]
        cw, cz = math.cos(weight * math.acos(tw)), math.sin(weight * math.asin(tz))
        mw = ew * cw - ez * cz
        mx = ex * cw + ey * cz
        my = ey * cw - ex * cz
        mz = ez * cw + ew * cz
    # error conj(q) ⊗ wanted, as twice its vector part
    sign = 2.0 if w0 * mw + x0 * mx + y0 * my + z0 * mz >= 0.0 else -2.0
    error_x = sign * (w0 * mx - x0 * mw - y0 * mz + z0 * my)
    error_y = sign * (w0 * my + x0 * mz - y0 * mw - z0 * mx)
    error_z = sign * (w0 * mz - x0 * my + y0 * mx - z0 * mw)
    rates = (
        gains[at.ATTITUDE_P] * error_x + yaw_rate * 2.0 * (x0 * z0 - w0 * y0),
        gains[at.ATTITUDE_P + 1] * error_y + yaw_rate * 2.0 * (y0 * z0 + w0 * x0),
        gains[at.ATTITUDE_P + 2] * error_z + yaw_rate * az,
    )
    for i in range(3):
        limit = gains[at.RATE_LIMIT + i]
        memory[at.OUT_RATES + i] = min(max(rates[i], -limit), limit)


@compiled
def filter_gyro(gyro: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """Second-order low pass of `gyro` (3,) at IMU_GYRO_CUTOFF, its slope through a first-order one at IMU_DGYRO_CUTOFF."""
    cutoff = gains[at.GYRO_CUTOFF_HZ]
    filtering = 0.0 < cutoff < 0.45 / dt_s
    b0 = a1 = a2 = 0.0
    if filtering:
        ohm = math.tan(math.pi * cutoff * dt_s)
        c = 1.0 + 2.0 * math.cos(math.pi / 4.0) * ohm + ohm * ohm
        b0 = ohm * ohm / c
        a1 = 2.0 * (ohm * ohm - 1.0) / c
        a2 = (1.0 - 2.0 * math.cos(math.pi / 4.0) * ohm + ohm * ohm) / c
    slope_cutoff = gains[at.GYRO_D_CUTOFF_HZ]
    blend = dt_s / (dt_s + 1.0 / (2.0 * math.pi * slope_cutoff)) if slope_cutoff > 0.0 else 1.0
    starting = memory[at.STARTED] == 0.0
    for i in range(3):
        if filtering:
            if starting:
                settled = gyro[i] / (1.0 + a1 + a2)
                memory[at.GYRO_DELAY_1 + i] = settled
                memory[at.GYRO_DELAY_2 + i] = settled
            d1, d2 = memory[at.GYRO_DELAY_1 + i], memory[at.GYRO_DELAY_2 + i]
            d0 = gyro[i] - d1 * a1 - d2 * a2
            filtered = (d0 + 2.0 * d1 + d2) * b0
            memory[at.GYRO_DELAY_2 + i] = d1
            memory[at.GYRO_DELAY_1 + i] = d0
        else:
            filtered = gyro[i]
        if starting:
            memory[at.RATE_FILTERED + i] = filtered
        slope = (filtered - memory[at.RATE_FILTERED + i]) / dt_s
        memory[at.RATE_ACCELERATION + i] += blend * (slope - memory[at.RATE_ACCELERATION + i])
        memory[at.RATE_FILTERED + i] = filtered
    memory[at.STARTED] = 1.0


@compiled
def rates_to_torque(gains: FloatArray, memory: FloatArray, dt_s: float, integrate: bool) -> None:
    """Normalised torque into memory[at.OUT_TORQUE] from memory[at.OUT_RATES] and the filtered gyro; may integrate."""
    for i in range(3):
        error = memory[at.OUT_RATES + i] - memory[at.RATE_FILTERED + i]
        torque = (
            gains[at.RATE_P + i] * error
            + memory[at.RATE_INTEGRAL + i]
            - gains[at.RATE_D + i] * memory[at.RATE_ACCELERATION + i]
            + gains[at.RATE_FF + i] * memory[at.OUT_RATES + i]
        )
        if integrate:
            if memory[at.SATURATED_HIGH + i] > 0.0:
                error = min(error, 0.0)
            if memory[at.SATURATED_LOW + i] > 0.0:
                error = max(error, 0.0)
            fade = error / INTEGRATOR_FADE_RATE
            fade = max(0.0, 1.0 - fade * fade)
            limit = gains[at.RATE_INTEGRAL_LIMIT + i]
            integral = memory[at.RATE_INTEGRAL + i] + fade * gains[at.RATE_I + i] * error * dt_s
            memory[at.RATE_INTEGRAL + i] = min(max(integral, -limit), limit)
        memory[at.OUT_TORQUE + i] = torque
    cutoff = gains[at.YAW_TORQUE_CUTOFF_HZ]
    if cutoff > 0.0:
        blend = dt_s / (dt_s + 1.0 / (2.0 * math.pi * cutoff))
        memory[at.YAW_TORQUE_FILTERED] += blend * (memory[at.OUT_TORQUE + 2] - memory[at.YAW_TORQUE_FILTERED])
        memory[at.OUT_TORQUE + 2] = memory[at.YAW_TORQUE_FILTERED]
    for i in range(3):
        torque = memory[at.OUT_TORQUE + i] * gains[at.TORQUE_SCALE + i]
        memory[at.OUT_TORQUE + i] = min(max(torque, -1.0), 1.0)
