"""Compiled position control with ArduCopter's structure: jerk-limited targets, position P, velocity PID, lift PID.

What is asked for is turned into a desired position, velocity and acceleration that move under limits of acceleration and
jerk (the shaping of AC_PosControl); position and velocity errors are corrected on top. North, east and up throughout: up is
−z. Layout of the arrays: `layout.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.mixing import give_throttle
from sitl_stub.firmware.ardupilot.shaping import (
    inverse_sqrt_controller,
    limited,
    low_pass_share,
    sqrt_controller,
)
from sitl_stub.physics.compiled import compiled

FloatArray = NDArray[np.float64]
Pair = tuple[float, float]


ONE_G = 9.80665
CORNER_SHARE = math.sqrt(0.5)
"""How much of the acceleration may go across the direction of travel while the rest brakes."""
MOST_DESCENT_ACCEL = 7.5
THROTTLE_CUTOFF_HZ = 2.0
OVERSPEED_GAIN = 2.0
SOFT_LANDING_S = 0.16
"""POSCONTROL_RELAX_TC."""


@compiled
def shortened(x: float, y: float, most: float) -> Pair:
    """(x, y), no longer than `most`."""
    length = math.hypot(x, y)
    if length <= most or length == 0.0:
        return x, y
    return x / length * most, y / length * most


@compiled
def pair_controller(x: float, y: float, p: float, second_limit: float, dt_s: float) -> Pair:
    """`sqrt_controller` on the length of (x, y)."""
    length = math.hypot(x, y)
    if length == 0.0:
        return 0.0, 0.0
    rate = sqrt_controller(length, p, second_limit, dt_s)
    return x / length * rate, y / length * rate


@compiled
def start_ne(
    position: FloatArray, velocity: FloatArray, lean: Pair, gains: FloatArray, memory: FloatArray
) -> None:
    """Begin at the present place and speed with the tilt that there is (`lean`: its acceleration, m/s²)."""
    for i in range(2):
        memory[at.DESIRED_POSITION + i] = position[i]
        memory[at.DESIRED_VELOCITY + i] = velocity[i]
        memory[at.DESIRED_ACCELERATION + i] = 0.0
        memory[at.VELOCITY_ERROR + i] = 0.0
        memory[at.VELOCITY_SLOPE + i] = 0.0
        memory[at.POSITION_ERROR + i] = 0.0
        memory[at.LIMIT_VECTOR + i] = 0.0
    most = ONE_G * math.tan(gains[at.TILT_MAX])
    memory[at.VELOCITY_INTEGRAL], memory[at.VELOCITY_INTEGRAL + 1] = shortened(lean[0], lean[1], most)
    memory[at.NE_ACTIVE] = 1.0


@compiled
def start_up(height: float, climb: float, gains: FloatArray, memory: FloatArray) -> None:
    """Begin at the present height and climb rate with the thrust that there is."""
    lift = memory[at.MEASURED_LIFT]
    memory[at.DESIRED_POSITION + 2] = height
    memory[at.DESIRED_VELOCITY + 2] = climb
    memory[at.DESIRED_ACCELERATION + 2] = limited(lift, -2.5, 2.5)
    memory[at.VELOCITY_ERROR + 2] = 0.0
    memory[at.VELOCITY_INTEGRAL + 2] = 0.0
    memory[at.POSITION_ERROR + 2] = 0.0
    memory[at.LIMIT_VECTOR + 2] = 0.0
    memory[at.LIFT_STARTED] = 0.0
    target = memory[at.DESIRED_ACCELERATION + 2]
    memory[at.LIFT_INTEGRAL] = (
        memory[at.THROTTLE_IN] - gains[at.HOVER_THRUST] - gains[at.LIFT_P] * (target - lift)
    )
    memory[at.UP_ACTIVE] = 1.0


@compiled
def soften_ne(position: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """The ground holds the vehicle: let the place it should hold go there, and the integral not grow."""
    share = dt_s / (dt_s + SOFT_LANDING_S)
    for i in range(2):
        memory[at.DESIRED_POSITION + i] += share * (position[i] - memory[at.DESIRED_POSITION + i])
        memory[at.LIMIT_VECTOR + i] = memory[at.TARGET_ACCELERATION + i]


@compiled
def advance_desired_ne(memory: FloatArray, dt_s: float) -> None:
    """Desired position and velocity move on, except further into a limit of tilt."""
    lx, ly = memory[at.LIMIT_VECTOR], memory[at.LIMIT_VECTOR + 1]
    ax, ay = memory[at.DESIRED_ACCELERATION], memory[at.DESIRED_ACCELERATION + 1]
    dx = memory[at.DESIRED_VELOCITY] * dt_s + 0.5 * ax * dt_s * dt_s
    dy = memory[at.DESIRED_VELOCITY + 1] * dt_s + 0.5 * ay * dt_s * dt_s
    error = memory[at.POSITION_ERROR] * lx + memory[at.POSITION_ERROR + 1] * ly
    if not (dx * lx + dy * ly > 0.0 and error > 0.0):
        memory[at.DESIRED_POSITION] += dx
        memory[at.DESIRED_POSITION + 1] += dy
    dx, dy = ax * dt_s, ay * dt_s
    error = memory[at.VELOCITY_ERROR] * lx + memory[at.VELOCITY_ERROR + 1] * ly
    along = memory[at.DESIRED_VELOCITY] * lx + memory[at.DESIRED_VELOCITY + 1] * ly
    if not (dx * lx + dy * ly > 0.0 and error > 0.0 and along >= 0.0):
        memory[at.DESIRED_VELOCITY] += dx
        memory[at.DESIRED_VELOCITY + 1] += dy


@compiled
def shape_ne(setpoint: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """Desired horizontal acceleration for the setpoint, within acceleration and jerk."""
    kind = setpoint[at.NE_KIND]
    accel_max = max(setpoint[at.ACCEL_NE], 0.1)
    snap = min(gains[at.ACCEL_MAX], gains[at.ACCEL_MAX + 1]) * ONE_G
    jerk = gains[at.JERK_NE]
    if snap > 0.0:
        jerk = min(jerk, 0.5 * math.sqrt(accel_max * snap))
    px, py = setpoint[at.POSITION], setpoint[at.POSITION + 1]
    vx, vy = setpoint[at.VELOCITY], setpoint[at.VELOCITY + 1]
    ax, ay = setpoint[at.ACCELERATION], setpoint[at.ACCELERATION + 1]
    if kind == at.KIND_POSITION:
        vx = vy = ax = ay = 0.0
    wx, wy = vx, vy
    if kind <= at.KIND_TRAJECTORY:
        ex, ey = px - memory[at.DESIRED_POSITION], py - memory[at.DESIRED_POSITION + 1]
        cx, cy = pair_controller(ex, ey, 0.5 * jerk / accel_max, 0.5 * accel_max, dt_s)
        cx, cy = shortened(cx, cy, setpoint[at.SPEED_NE])
        wx, wy = vx + cx, vy + cy
    bx, by = ax, ay
    if kind <= at.KIND_VELOCITY:
        ex, ey = wx - memory[at.DESIRED_VELOCITY], wy - memory[at.DESIRED_VELOCITY + 1]
        cx, cy = pair_controller(ex, ey, jerk / accel_max, jerk, dt_s)
        speed = math.hypot(wx, wy)
        if speed == 0.0:
            cx, cy = shortened(cx, cy, accel_max)
        else:
            ux, uy = wx / speed, wy / speed
            along = ux * cx + uy * cy
            sx, sy = cx - ux * along, cy - uy * along
            across = math.hypot(sx, sy)
            if abs(along) <= across:
                cx, cy = shortened(cx, cy, accel_max)
            else:
                sx, sy = shortened(sx, sy, CORNER_SHARE * accel_max)
                room = math.sqrt(max(accel_max * accel_max - sx * sx - sy * sy, 0.0))
                along = limited(along, -room, room)
                cx, cy = sx + ux * along, sy + uy * along
        bx, by = ax + cx, ay + cy
    dx, dy = bx - memory[at.DESIRED_ACCELERATION], by - memory[at.DESIRED_ACCELERATION + 1]
    dx, dy = shortened(dx, dy, jerk * dt_s)
    memory[at.DESIRED_ACCELERATION] += dx
    memory[at.DESIRED_ACCELERATION + 1] += dy
    # what was asked for goes on by itself until the next message
    if kind == at.KIND_TRAJECTORY:
        setpoint[at.POSITION] += vx * dt_s + 0.5 * ax * dt_s * dt_s
        setpoint[at.POSITION + 1] += vy * dt_s + 0.5 * ay * dt_s * dt_s
    if at.KIND_TRAJECTORY <= kind <= at.KIND_VELOCITY:
        setpoint[at.VELOCITY] += ax * dt_s
        setpoint[at.VELOCITY + 1] += ay * dt_s


@compiled
def correct_ne(
    position: FloatArray,
    velocity: FloatArray,
    setpoint: FloatArray,
    gains: FloatArray,
    memory: FloatArray,
    dt_s: float,
) -> None:
    """Position P and velocity PID about the desired trajectory: memory[at.TARGET_ACCELERATION] north and east."""
    accel_max = max(setpoint[at.ACCEL_NE], 0.1)
    ex = memory[at.DESIRED_POSITION] - position[0]
    ey = memory[at.DESIRED_POSITION + 1] - position[1]
    most = inverse_sqrt_controller(max(setpoint[at.SPEED_NE], 0.1), gains[at.POSITION_P], accel_max)
    if math.hypot(ex, ey) > most:
        ex, ey = shortened(ex, ey, most)
        memory[at.DESIRED_POSITION] = position[0] + ex
        memory[at.DESIRED_POSITION + 1] = position[1] + ey
    memory[at.POSITION_ERROR] = ex
    memory[at.POSITION_ERROR + 1] = ey
    cx, cy = pair_controller(ex, ey, gains[at.POSITION_P], accel_max, dt_s)
    lx, ly = memory[at.LIMIT_VECTOR], memory[at.LIMIT_VECTOR + 1]
    size = math.hypot(memory[at.VELOCITY_INTEGRAL], memory[at.VELOCITY_INTEGRAL + 1])
    growth_x = growth_y = 0.0
    for i in range(2):
        memory[at.TARGET_VELOCITY + i] = memory[at.DESIRED_VELOCITY + i] + (cx if i == 0 else cy)
        before = memory[at.VELOCITY_ERROR + i]
        error = memory[at.TARGET_VELOCITY + i] - velocity[i]
        memory[at.VELOCITY_ERROR + i] += low_pass_share(gains[at.VELOCITY_FLTE], dt_s) * (error - before)
        slope = (memory[at.VELOCITY_ERROR + i] - before) / dt_s
        memory[at.VELOCITY_SLOPE + i] += low_pass_share(gains[at.VELOCITY_FLTD], dt_s) * (
            slope - memory[at.VELOCITY_SLOPE + i]
        )
    growth_x = memory[at.VELOCITY_ERROR] * gains[at.VELOCITY_I] * dt_s
    growth_y = memory[at.VELOCITY_ERROR + 1] * gains[at.VELOCITY_I] * dt_s
    ix, iy = memory[at.VELOCITY_INTEGRAL] + growth_x, memory[at.VELOCITY_INTEGRAL + 1] + growth_y
    if growth_x * lx + growth_y * ly > 0.0:
        ix, iy = shortened(ix, iy, size)
    ix, iy = shortened(ix, iy, gains[at.VELOCITY_IMAX])
    memory[at.VELOCITY_INTEGRAL] = ix
    memory[at.VELOCITY_INTEGRAL + 1] = iy
    for i in range(2):
        memory[at.TARGET_ACCELERATION + i] = (
            memory[at.DESIRED_ACCELERATION + i]
            + gains[at.VELOCITY_P] * memory[at.VELOCITY_ERROR + i]
            + memory[at.VELOCITY_INTEGRAL + i]
            + gains[at.VELOCITY_D] * memory[at.VELOCITY_SLOPE + i]
        )
    ax, ay = memory[at.TARGET_ACCELERATION], memory[at.TARGET_ACCELERATION + 1]
    most = ONE_G * math.tan(gains[at.TILT_MAX])
    if math.hypot(ax, ay) > most:
        memory[at.LIMIT_VECTOR] = ax
        memory[at.LIMIT_VECTOR + 1] = ay
        memory[at.TARGET_ACCELERATION], memory[at.TARGET_ACCELERATION + 1] = shortened(ax, ay, most)
    else:
        memory[at.LIMIT_VECTOR] = 0.0
        memory[at.LIMIT_VECTOR + 1] = 0.0


@compiled
def shape_up(setpoint: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """Desired height, climb rate and acceleration move on towards the setpoint."""
    if setpoint[at.IGNORE_DESCENT_LIMIT] > 0.0:
        memory[at.LIMIT_VECTOR + 2] = max(memory[at.LIMIT_VECTOR + 2], 0.0)
    fastest_up, fastest_down = max(setpoint[at.SPEED_UP], 0.05), max(setpoint[at.SPEED_DOWN], 0.05)
    climb = memory[at.DESIRED_VELOCITY + 2]
    gain = 1.0
    if climb < -fastest_down:
        gain = OVERSPEED_GAIN * -climb / fastest_down
    elif climb > fastest_up:
        gain = OVERSPEED_GAIN * climb / fastest_up
    accel_max = max(setpoint[at.ACCEL_UP], 0.1) * gain
    accel_down = min(accel_max, MOST_DESCENT_ACCEL)
    jerk = gains[at.JERK_UP]
    if gains[at.LIFT_FLTE] > 0.0:
        jerk = min(
            jerk, min(ONE_G, max(setpoint[at.ACCEL_UP], 0.1)) * 2.0 * math.pi * gains[at.LIFT_FLTE] / 5.0
        )
    jerk *= gain

    limit = memory[at.LIMIT_VECTOR + 2]
    acceleration = memory[at.DESIRED_ACCELERATION + 2]
    step = climb * dt_s + 0.5 * acceleration * dt_s * dt_s
    if not (step * limit > 0.0 and memory[at.POSITION_ERROR + 2] * limit > 0.0):
        memory[at.DESIRED_POSITION + 2] += step
    step = acceleration * dt_s
    if not (step * limit > 0.0 and memory[at.VELOCITY_ERROR + 2] * limit > 0.0 and climb * limit >= 0.0):
        memory[at.DESIRED_VELOCITY + 2] += step
    climb = memory[at.DESIRED_VELOCITY + 2]

    kind = setpoint[at.UP_KIND]
    feed_v, feed_a = setpoint[at.VELOCITY + 2], setpoint[at.ACCELERATION + 2]
    if kind == at.KIND_POSITION:
        feed_v = feed_a = 0.0
    wanted = feed_v
    if kind <= at.KIND_TRAJECTORY:
        error = setpoint[at.POSITION + 2] - memory[at.DESIRED_POSITION + 2]
        room = accel_down if error > 0.0 else accel_max
        correction = sqrt_controller(error, 0.5 * jerk / room, 0.5 * room, dt_s)
        wanted += limited(correction, -fastest_down, fastest_up)
    push = feed_a
    if kind <= at.KIND_VELOCITY:
        error = wanted - climb
        room = accel_max if error > 0.0 else accel_down
        push += limited(sqrt_controller(error, jerk / room, jerk, dt_s), -accel_down, accel_max)
    change = limited(push - acceleration, -jerk * dt_s, jerk * dt_s)
    memory[at.DESIRED_ACCELERATION + 2] = acceleration + change
    if kind == at.KIND_TRAJECTORY:
        setpoint[at.POSITION + 2] += feed_v * dt_s + 0.5 * feed_a * dt_s * dt_s
    if at.KIND_TRAJECTORY <= kind <= at.KIND_VELOCITY:
        setpoint[at.VELOCITY + 2] += feed_a * dt_s


@compiled
def correct_up(
    height: float, climb: float, setpoint: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float
) -> None:
    """Height P, climb-rate PI, lift PI about the desired climb: thrust for the motors."""
    accel_max = max(setpoint[at.ACCEL_UP], 0.1)
    error = memory[at.DESIRED_POSITION + 2] - height
    most_up = inverse_sqrt_controller(max(setpoint[at.SPEED_UP], 0.05), gains[at.HEIGHT_P], accel_max)
    most_down = inverse_sqrt_controller(max(setpoint[at.SPEED_DOWN], 0.05), gains[at.HEIGHT_P], accel_max)
    bounded = limited(error, -most_down, most_up)
    if bounded != error:
        memory[at.DESIRED_POSITION + 2] = height + bounded
        error = bounded
    memory[at.POSITION_ERROR + 2] = error
    wanted = memory[at.DESIRED_VELOCITY + 2] + sqrt_controller(error, gains[at.HEIGHT_P], accel_max, dt_s)
    memory[at.TARGET_VELOCITY + 2] = wanted
    share = low_pass_share(gains[at.CLIMB_FLTE], dt_s)
    memory[at.VELOCITY_ERROR + 2] += share * (wanted - climb - memory[at.VELOCITY_ERROR + 2])
    off = memory[at.VELOCITY_ERROR + 2]
    stuck = (memory[at.LIMIT_LOWER] > 0.0 and off < 0.0) or (memory[at.LIMIT_UPPER] > 0.0 and off > 0.0)
    if not stuck:
        grown = memory[at.VELOCITY_INTEGRAL + 2] + off * gains[at.CLIMB_I] * dt_s
        memory[at.VELOCITY_INTEGRAL + 2] = limited(grown, -gains[at.CLIMB_IMAX], gains[at.CLIMB_IMAX])
    lift = memory[at.DESIRED_ACCELERATION + 2] + gains[at.CLIMB_P] * off + memory[at.VELOCITY_INTEGRAL + 2]
    memory[at.TARGET_ACCELERATION + 2] = lift
    off_lift = lift - memory[at.MEASURED_LIFT]
    if memory[at.LIFT_STARTED] > 0.0:
        off_lift = memory[at.LIFT_ERROR] + low_pass_share(gains[at.LIFT_FLTE], dt_s) * (
            off_lift - memory[at.LIFT_ERROR]
        )
    memory[at.LIFT_STARTED] = 1.0
    memory[at.LIFT_ERROR] = off_lift
    limits = memory[at.LIMIT_LOWER] > 0.0 or memory[at.LIMIT_UPPER] > 0.0
    if not limits or memory[at.LIFT_INTEGRAL] * off_lift < 0.0:
        grown = memory[at.LIFT_INTEGRAL] + off_lift * gains[at.LIFT_I] * dt_s
        memory[at.LIFT_INTEGRAL] = limited(grown, -gains[at.LIFT_IMAX], gains[at.LIFT_IMAX])
    thrust = gains[at.HOVER_THRUST] + gains[at.LIFT_P] * off_lift + memory[at.LIFT_INTEGRAL]
    give_throttle(thrust, gains, memory, THROTTLE_CUTOFF_HZ)
    ratio = memory[at.CLIMB_RATIO] + dt_s * 0.1 * (0.5 + off / max(setpoint[at.SPEED_DOWN], 0.05))
    memory[at.CLIMB_RATIO] = limited(ratio, 0.0, 2.0)
    if memory[at.LIMIT_UPPER] > 0.0:
        memory[at.LIMIT_VECTOR + 2] = 1.0
    elif memory[at.LIMIT_LOWER] > 0.0:
        memory[at.LIMIT_VECTOR + 2] = -1.0
    else:
        memory[at.LIMIT_VECTOR + 2] = 0.0
