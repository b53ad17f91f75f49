"""Compiled attitude and rate loops with ArduCopter's structure: a shaped attitude target, angle P, rate PID.

A target attitude is moved towards what was asked for under limits of angular acceleration (AC_AttitudeControl); its rate
is fed forward, the error to it corrected by square-root controllers, and the sum followed by three PIDs (AC_PID) on the
low-passed gyro. Written from the equations; layout of the arrays: `layout.py`. FRD body, NED world.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.shaping import (
    Quaternion,
    Vector,
    euler,
    from_euler,
    from_rotation_vector,
    inverse,
    inverse_sqrt_controller,
    limited,
    low_pass_share,
    multiply,
    normalised,
    rotate,
    shape_angle,
    shape_rate,
    sqrt_controller,
    to_rotation_vector,
    wrapped,
)
from sitl_stub.physics.compiled import compiled

FloatArray = NDArray[np.float64]


UP: Vector = (0.0, 0.0, -1.0)
LARGE_ERROR = math.radians(30.0)
"""Error of the thrust direction from which yaw and feed-forward give way (whole way at twice this)."""
YAW_ERROR_MOST = math.radians(45.0)
TILT_ACCEL = (math.radians(40.0), math.radians(720.0))
"""Least and most acceleration of the roll and pitch angle controllers."""
YAW_ACCEL = (math.radians(10.0), math.radians(120.0))


@compiled
def filter_gyro(gyro: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """Second-order Butterworth at INS_GYRO_FILTER on the measured rates (3,), into memory[at.GYRO]."""
    cutoff = gains[at.GYRO_CUTOFF_HZ]
    if cutoff <= 0.0:
        for i in range(3):
            memory[at.GYRO + i] = gyro[i]
        return
    ohm = math.tan(math.pi * cutoff * dt_s)
    c = 1.0 + math.sqrt(2.0) * ohm + ohm * ohm
    b0 = ohm * ohm / c
    a1 = 2.0 * (ohm * ohm - 1.0) / c
    a2 = (1.0 - math.sqrt(2.0) * ohm + ohm * ohm) / c
    for i in range(3):
        inner = gyro[i] - memory[at.GYRO_DELAY_1 + i] * a1 - memory[at.GYRO_DELAY_2 + i] * a2
        memory[at.GYRO + i] = (
            inner * b0 + memory[at.GYRO_DELAY_1 + i] * 2.0 * b0 + memory[at.GYRO_DELAY_2 + i] * b0
        )
        memory[at.GYRO_DELAY_2 + i] = memory[at.GYRO_DELAY_1 + i]
        memory[at.GYRO_DELAY_1 + i] = inner


@compiled
def rates_to_torque(gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """Rate PIDs: memory[at.OUT_TORQUE] (−1..1) from memory[at.OUT_RATES] and the filtered gyro."""
    started = memory[at.PID_STARTED] > 0.0
    memory[at.PID_STARTED] = 1.0
    for i in range(3):
        wanted, measured = memory[at.OUT_RATES + i], memory[at.GYRO + i]
        if started:
            share = low_pass_share(gains[at.RATE_FLTT + i], dt_s)
            memory[at.PID_TARGET + i] += share * (wanted - memory[at.PID_TARGET + i])
            before = memory[at.PID_ERROR + i]
            error = memory[at.PID_TARGET + i] - measured
            memory[at.PID_ERROR + i] += low_pass_share(gains[at.RATE_FLTE + i], dt_s) * (error - before)
            slope = (memory[at.PID_ERROR + i] - before) / dt_s
            memory[at.PID_SLOPE + i] += low_pass_share(gains[at.RATE_FLTD + i], dt_s) * (
                slope - memory[at.PID_SLOPE + i]
            )
        else:
            memory[at.PID_TARGET + i] = wanted
            memory[at.PID_ERROR + i] = wanted - measured
            memory[at.PID_SLOPE + i] = 0.0
        error = memory[at.PID_ERROR + i]
        if memory[at.LIMIT_TORQUE + i] == 0.0 or memory[at.PID_INTEGRAL + i] * error < 0.0:
            grown = memory[at.PID_INTEGRAL + i] + error * gains[at.RATE_I + i] * dt_s
            memory[at.PID_INTEGRAL + i] = limited(grown, -gains[at.RATE_IMAX + i], gains[at.RATE_IMAX + i])
        memory[at.OUT_TORQUE + i] = limited(
            gains[at.RATE_P + i] * error
            + gains[at.RATE_D + i] * memory[at.PID_SLOPE + i]
            + memory[at.PID_INTEGRAL + i]
            + gains[at.RATE_FF + i] * memory[at.PID_TARGET + i],
            -1.0,
            1.0,
        )


@compiled
def target_of(memory: FloatArray) -> Quaternion:
    """The attitude target."""
    return memory[at.TARGET], memory[at.TARGET + 1], memory[at.TARGET + 2], memory[at.TARGET + 3]


@compiled
def put_target(memory: FloatArray, q: Quaternion) -> None:
    """Replace the attitude target."""
    memory[at.TARGET] = q[0]
    memory[at.TARGET + 1] = q[1]
    memory[at.TARGET + 2] = q[2]
    memory[at.TARGET + 3] = q[3]


@compiled
def move_target(memory: FloatArray, dt_s: float) -> None:
    """Let the target turn with its own rate."""
    turn = from_rotation_vector(
        (
            memory[at.TARGET_RATES] * dt_s,
            memory[at.TARGET_RATES + 1] * dt_s,
            memory[at.TARGET_RATES + 2] * dt_s,
        )
    )
    put_target(memory, normalised(multiply(target_of(memory), turn)))


@compiled
def thrust_and_heading_error(target: Quaternion, body: Quaternion) -> tuple[Vector, Quaternion, float]:
    """Error of `body` to `target`: tilt first (x, y), then heading (z), rad, in the body's frame.

    Also the turn that corrects the tilt, and the angle between both thrust directions.
    """
    wanted = rotate(target, UP)
    now = rotate(body, UP)
    cx = now[1] * wanted[2] - now[2] * wanted[1]
    cy = now[2] * wanted[0] - now[0] * wanted[2]
    cz = now[0] * wanted[1] - now[1] * wanted[0]
    length = math.sqrt(cx * cx + cy * cy + cz * cz)
    angle = math.atan2(length, now[0] * wanted[0] + now[1] * wanted[1] + now[2] * wanted[2])
    if length > 1e-12:
        scale = angle / length
        turn = rotate(inverse(body), (cx * scale, cy * scale, cz * scale))
    else:
        turn = (0.0, 0.0, 0.0)
        angle = 0.0
    correction = from_rotation_vector(turn)
    rest = multiply(inverse(correction), multiply(inverse(body), target))
    heading = to_rotation_vector(rest)[2]
    return (turn[0], turn[1], heading), correction, angle


@compiled
def follow_target(body: Quaternion, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """memory[at.OUT_RATES] for attitude `body` to reach and follow the target."""
    target = target_of(memory)
    error, correction, thrust_error = thrust_and_heading_error(target, body)
    ex, ey, ez = error
    up = rotate(body, UP)
    memory[at.THRUST_ANGLE] = math.acos(limited(-up[2], -1.0, 1.0))
    memory[at.THRUST_ERROR_ANGLE] = thrust_error
    yaw_accel = limited(0.5 * gains[at.ACCEL_MAX + 2], YAW_ACCEL[0], YAW_ACCEL[1])
    if gains[at.RATE_P + 2] > 0.0 and gains[at.ANGLE_P + 2] > 0.0:
        # no more heading error than the yaw output can use
        most = inverse_sqrt_controller(1.0 / gains[at.RATE_P + 2], gains[at.ANGLE_P + 2], yaw_accel)
        most = min(most, YAW_ERROR_MOST)
        if abs(ez) > most:
            ez = limited(ez, -most, most)
            target = normalised(multiply(multiply(body, correction), from_rotation_vector((0.0, 0.0, ez))))
            put_target(memory, target)
    wx = sqrt_controller(
        ex, gains[at.ANGLE_P], limited(0.5 * gains[at.ACCEL_MAX], TILT_ACCEL[0], TILT_ACCEL[1]), dt_s
    )
    wy = sqrt_controller(
        ey, gains[at.ANGLE_P + 1], limited(0.5 * gains[at.ACCEL_MAX + 1], TILT_ACCEL[0], TILT_ACCEL[1]), dt_s
    )
    wz = sqrt_controller(ez, gains[at.ANGLE_P + 2], yaw_accel, dt_s)
    wx, wy, wz = limit_rates(wx, wy, wz, gains)
    feed = rotate(
        multiply(inverse(body), target),
        (memory[at.TARGET_RATES], memory[at.TARGET_RATES + 1], memory[at.TARGET_RATES + 2]),
    )
    if thrust_error > 2.0 * LARGE_ERROR:
        wz = memory[at.GYRO + 2]
    elif thrust_error > LARGE_ERROR:
        share = 1.0 - (thrust_error - LARGE_ERROR) / LARGE_ERROR
        wx += share * feed[0]
        wy += share * feed[1]
        wz = memory[at.GYRO + 2] * (1.0 - share) + (wz + feed[2]) * share
    else:
        wx, wy, wz = wx + feed[0], wy + feed[1], wz + feed[2]
    memory[at.OUT_RATES] = wx
    memory[at.OUT_RATES + 1] = wy
    memory[at.OUT_RATES + 2] = wz


@compiled
def limit_rates(x: float, y: float, z: float, gains: FloatArray) -> Vector:
    """Rates within ATC_RATE_R_MAX and its like (0: no limit), roll and pitch shortened together."""
    most_x, most_y, most_z = gains[at.RATE_MAX], gains[at.RATE_MAX + 1], gains[at.RATE_MAX + 2]
    if most_x > 0.0 and most_y > 0.0:
        length = math.sqrt((x / most_x) ** 2 + (y / most_y) ** 2)
        if length > 1.0:
            x, y = x / length, y / length
    elif most_x > 0.0:
        x = limited(x, -most_x, most_x)
    elif most_y > 0.0:
        y = limited(y, -most_y, most_y)
    if most_z > 0.0:
        z = limited(z, -most_z, most_z)
    return x, y, z


@compiled
def take_quaternion(
    body: Quaternion, setpoint: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float
) -> None:
    """Attitude with body rates: the wanted attitude goes on turning with the rates, rotated by itself.

    That rotation (rates taken as if they were in the earth's frame) is what makes attitude and rates together a trap.
    """
    move_target(memory, dt_s)
    wanted = (
        setpoint[at.QUATERNION],
        setpoint[at.QUATERNION + 1],
        setpoint[at.QUATERNION + 2],
        setpoint[at.QUATERNION + 3],
    )
    rx, ry, rz = limit_rates(setpoint[at.RATES], setpoint[at.RATES + 1], setpoint[at.RATES + 2], gains)
    feed = rotate(wanted, (rx, ry, rz))
    if gains[at.FEED_FORWARD] > 0.0:
        error = to_rotation_vector(multiply(inverse(target_of(memory)), wanted))
        for i in range(3):
            memory[at.TARGET_RATES + i] = shape_angle(
                error[i],
                gains[at.INPUT_TC],
                gains[at.ACCEL_MAX + i],
                memory[at.TARGET_RATES + i],
                feed[i],
                gains[at.RATE_MAX + i],
                dt_s,
            )
    else:
        put_target(memory, wanted)
        for i in range(3):
            memory[at.TARGET_RATES + i] = feed[i]
    turned = normalised(
        multiply(wanted, from_rotation_vector((feed[0] * dt_s, feed[1] * dt_s, feed[2] * dt_s)))
    )
    for i in range(4):
        setpoint[at.QUATERNION + i] = turned[i]
    follow_target(body, gains, memory, dt_s)


@compiled
def take_rates(
    body: Quaternion, setpoint: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float
) -> None:
    """Body rates: the target turns with them, so that what was not turned in time is caught up with."""
    move_target(memory, dt_s)
    for i in range(3):
        memory[at.TARGET_RATES + i] = shape_rate(
            memory[at.TARGET_RATES + i], setpoint[at.RATES + i], gains[at.ACCEL_MAX + i], dt_s
        )
    follow_target(body, gains, memory, dt_s)


@compiled
def take_lean(
    body: Quaternion,
    roll: float,
    pitch: float,
    yaw_rate: float,
    gains: FloatArray,
    memory: FloatArray,
    dt_s: float,
) -> None:
    """Roll and pitch angles and a rate of heading, as sticks and the ground ask for them. Shaped in Euler angles."""
    move_target(memory, dt_s)
    r, p, _ = euler(target_of(memory))
    sin_r, cos_r = math.sin(r), math.cos(r)
    sin_p, cos_p = math.sin(p), max(math.cos(p), 0.1)
    x, y, z = memory[at.TARGET_RATES], memory[at.TARGET_RATES + 1], memory[at.TARGET_RATES + 2]
    turn = (sin_r * y + cos_r * z) / cos_p
    dp = cos_r * y - sin_r * z
    dr = x + sin_p * turn
    tc = gains[at.INPUT_TC]
    dr = shape_angle(wrapped(roll - r), tc, gains[at.ACCEL_MAX], dr, 0.0, 0.0, dt_s)
    dp = shape_angle(wrapped(pitch - p), tc, gains[at.ACCEL_MAX + 1], dp, 0.0, 0.0, dt_s)
    turn = shape_rate(turn, yaw_rate, gains[at.ACCEL_MAX + 2], dt_s)
    x, y, z = limit_rates(
        dr - sin_p * turn, cos_r * dp + sin_r * cos_p * turn, -sin_r * dp + cos_p * cos_r * turn, gains
    )
    memory[at.TARGET_RATES] = x
    memory[at.TARGET_RATES + 1] = y
    memory[at.TARGET_RATES + 2] = z
    follow_target(body, gains, memory, dt_s)


@compiled
def attitude_of_thrust(north: float, east: float, down: float, heading: float) -> Quaternion:
    """Attitude whose thrust points along (north, east, down), tilted the shortest way, then turned to `heading`."""
    length = math.sqrt(north * north + east * east + down * down)
    n, e, d = north / length, east / length, down / length
    # shortest turn from straight up (0, 0, −1) to the thrust direction
    cx, cy = e, -n
    size = math.sqrt(cx * cx + cy * cy)
    angle = math.atan2(size, -d)
    if size > 1e-12:
        tilt = from_rotation_vector((cx / size * angle, cy / size * angle, 0.0))
    else:
        tilt = (1.0, 0.0, 0.0, 0.0)
    return multiply(tilt, (math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading)))


@compiled
def take_thrust_direction(
    body: Quaternion,
    north: float,
    east: float,
    setpoint: FloatArray,
    gains: FloatArray,
    memory: FloatArray,
    dt_s: float,
) -> None:
    """What the position controller asks for: acceleration (m/s²) as tilt, and heading or a rate of heading."""
    move_target(memory, dt_s)
    slew = gains[at.SLEW_YAW]
    rate = limited(setpoint[at.HEADING_RATE], -slew, slew) if slew > 0.0 else setpoint[at.HEADING_RATE]
    wanted = attitude_of_thrust(north, east, -9.80665, setpoint[at.HEADING])
    target = target_of(memory)
    error, _, _ = thrust_and_heading_error(wanted, target)
    tc = gains[at.INPUT_TC]
    x = shape_angle(error[0], tc, gains[at.ACCEL_MAX], memory[at.TARGET_RATES], 0.0, 0.0, dt_s)
    y = shape_angle(error[1], tc, gains[at.ACCEL_MAX + 1], memory[at.TARGET_RATES + 1], 0.0, 0.0, dt_s)
    if setpoint[at.HEADING_KIND] == at.HEADING_ANGLE:
        z = shape_angle(error[2], tc, gains[at.ACCEL_MAX + 2], memory[at.TARGET_RATES + 2], rate, slew, dt_s)
    else:
        z = shape_rate(memory[at.TARGET_RATES + 2], rate, gains[at.ACCEL_MAX + 2], dt_s)
    x, y, z = limit_rates(x, y, z, gains)
    memory[at.TARGET_RATES] = x
    memory[at.TARGET_RATES + 1] = y
    memory[at.TARGET_RATES + 2] = z
    follow_target(body, gains, memory, dt_s)


@compiled
def relax(body: Quaternion, turning: bool, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """On the ground: stay level; integrals run out; heading follows the vehicle unless the motors are `turning`."""
    for i in range(3):
        memory[at.PID_INTEGRAL + i] -= memory[at.PID_INTEGRAL + i] * dt_s / (dt_s + 0.16)
    if not turning:
        roll, pitch, _ = euler(target_of(memory))
        put_target(memory, from_euler(roll, pitch, euler(body)[2]))
        memory[at.TARGET_RATES + 2] = 0.0
    take_lean(body, 0.0, 0.0, 0.0, gains, memory, dt_s)
