"""Compiled building blocks of ArduCopter's controllers: square-root controller, shaping, filters, rotations.

The square-root controller is proportional near the target and follows v = √(2 a (e − e₀)) beyond, so that the way to the
target never needs more than its acceleration. Quaternions are scalar first, body FRD to NED.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl_stub.physics.compiled import compiled

FloatArray = NDArray[np.float64]
Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]


@compiled
def limited(value: float, least: float, most: float) -> float:
    """`value` within [least, most]."""
    return min(max(value, least), most)


@compiled
def sqrt_controller(error: float, p: float, second_limit: float, dt_s: float) -> float:
    """Rate of change for `error` to vanish: `p`·error near zero, slower than that further out.

    `second_limit` bounds the derivative of the result (0: no bound). Never more than one step of `dt_s` can use up.
    """
    if second_limit <= 0.0:
        rate = error * p
    elif p == 0.0:
        rate = math.copysign(math.sqrt(2.0 * second_limit * abs(error)), error)
    else:
        linear = second_limit / (p * p)
        if abs(error) > linear:
            rate = math.copysign(math.sqrt(2.0 * second_limit * (abs(error) - 0.5 * linear)), error)
        else:
            rate = error * p
    most = abs(error) / dt_s
    return limited(rate, -most, most)


@compiled
def inverse_sqrt_controller(rate: float, p: float, second_limit: float) -> float:
    """The error for which `sqrt_controller` gives `rate`."""
    if second_limit <= 0.0:
        return rate / p if p != 0.0 else 0.0
    if p == 0.0:
        return rate * rate / (2.0 * second_limit)
    if abs(rate) < second_limit / p:
        return rate / p
    distance = 0.5 * second_limit / (p * p) + rate * rate / (2.0 * second_limit)
    return math.copysign(distance, rate)


@compiled
def low_pass_share(cutoff_hz: float, dt_s: float) -> float:
    """What part of the way to its input a first-order filter goes in `dt_s`; all of it when the filter is off."""
    if cutoff_hz <= 0.0:
        return 1.0
    return dt_s / (dt_s + 1.0 / (2.0 * math.pi * cutoff_hz))


@compiled
def shape_rate(rate: float, wanted: float, accel_max: float, dt_s: float) -> float:
    """`rate` moved towards `wanted` by at most `accel_max`·dt (0: at once)."""
    if accel_max <= 0.0:
        return wanted
    step = accel_max * dt_s
    return limited(wanted, rate - step, rate + step)


@compiled
def shape_angle(
    error: float,
    time_constant_s: float,
    accel_max: float,
    rate: float,
    feed: float,
    rate_max: float,
    dt_s: float,
) -> float:
    """Next target rate for an angle `error`: square-root controller of ATC_INPUT_TC, plus the rate fed forward."""
    wanted = feed + sqrt_controller(error, 1.0 / max(time_constant_s, 0.01), accel_max, dt_s)
    if rate_max > 0.0:
        wanted = limited(wanted, -rate_max, rate_max)
    return shape_rate(rate, wanted, accel_max, dt_s)


@compiled
def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Product a ⊗ b: b first, then a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


@compiled
def inverse(q: Quaternion) -> Quaternion:
    """Conjugate of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


@compiled
def rotate(q: Quaternion, v: Vector) -> Vector:
    """`v` turned by `q`."""
    w, x, y, z = q
    a, b, c = v
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (
        a + w * tx + y * tz - z * ty,
        b + w * ty + z * tx - x * tz,
        c + w * tz + x * ty - y * tx,
    )


@compiled
def from_rotation_vector(v: Vector) -> Quaternion:
    """Quaternion of the rotation by |v| about v."""
    angle = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if angle < 1e-12:
        return 1.0, 0.5 * v[0], 0.5 * v[1], 0.5 * v[2]
    s = math.sin(0.5 * angle) / angle
    return math.cos(0.5 * angle), s * v[0], s * v[1], s * v[2]


@compiled
def to_rotation_vector(q: Quaternion) -> Vector:
    """The shorter way round as axis times angle."""
    w, x, y, z = q
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-12:
        return 2.0 * x, 2.0 * y, 2.0 * z
    scale = 2.0 * math.atan2(length, w) / length
    return scale * x, scale * y, scale * z


@compiled
def normalised(q: Quaternion) -> Quaternion:
    """`q` at unit length; the identity where there is none."""
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if norm < 1e-12:
        return 1.0, 0.0, 0.0, 0.0
    return q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm


@compiled
def euler(q: Quaternion) -> Vector:
    """Roll, pitch, yaw, rad."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(limited(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


@compiled
def from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Attitude with these angles, rad."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@compiled
def wrapped(angle: float) -> float:
    """`angle` within ±π."""
    return math.atan2(math.sin(angle), math.cos(angle))
