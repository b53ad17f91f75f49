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

KIND_POSITION = at.KIND_POSITION
KIND_TRAJECTORY = at.KIND_TRAJECTORY
KIND_VELOCITY = at.KIND_VELOCITY
SET_NE_KIND = at.NE_KIND
SET_UP_KIND = at.UP_KIND
SET_POSITION = at.POSITION
SET_VELOCITY = at.VELOCITY
SET_ACCELERATION = at.ACCELERATION
SPEED_NE = at.SPEED_NE
ACCEL_NE = at.ACCEL_NE
SPEED_UP = at.SPEED_UP
SPEED_DOWN = at.SPEED_DOWN
ACCEL_UP = at.ACCEL_UP
IGNORE_DESCENT_LIMIT = at.IGNORE_DESCENT_LIMIT
DESIRED_POSITION = at.DESIRED_POSITION
DESIRED_VELOCITY = at.DESIRED_VELOCITY
DESIRED_ACCELERATION = at.DESIRED_ACCELERATION
TARGET_VELOCITY = at.TARGET_VELOCITY
TARGET_ACCELERATION = at.TARGET_ACCELERATION
LIMIT_VECTOR = at.LIMIT_VECTOR
LIMIT_LOWER = at.LIMIT_LOWER
LIMIT_UPPER = at.LIMIT_UPPER
VELOCITY_ERROR = at.VELOCITY_ERROR
VELOCITY_SLOPE = at.VELOCITY_SLOPE
VELOCITY_INTEGRAL = at.VELOCITY_INTEGRAL
POSITION_ERROR = at.POSITION_ERROR
LIFT_ERROR = at.LIFT_ERROR
LIFT_INTEGRAL = at.LIFT_INTEGRAL
LIFT_STARTED = at.LIFT_STARTED
MEASURED_LIFT = at.MEASURED_LIFT
NE_ACTIVE = at.NE_ACTIVE
UP_ACTIVE = at.UP_ACTIVE
CLIMB_RATIO = at.CLIMB_RATIO
THROTTLE_IN = at.THROTTLE_IN
POSITION_P = at.POSITION_P
VELOCITY_P = at.VELOCITY_P
VELOCITY_I = at.VELOCITY_I
VELOCITY_D = at.VELOCITY_D
VELOCITY_IMAX = at.VELOCITY_IMAX
VELOCITY_FLTE = at.VELOCITY_FLTE
VELOCITY_FLTD = at.VELOCITY_FLTD
HEIGHT_P = at.HEIGHT_P
CLIMB_P = at.CLIMB_P
CLIMB_I = at.CLIMB_I
CLIMB_IMAX = at.CLIMB_IMAX
CLIMB_FLTE = at.CLIMB_FLTE
LIFT_P = at.LIFT_P
LIFT_I = at.LIFT_I
LIFT_IMAX = at.LIFT_IMAX
LIFT_FLTE = at.LIFT_FLTE
JERK_NE = at.JERK_NE
JERK_UP = at.JERK_UP
TILT_MAX = at.TILT_MAX
HOVER_THRUST = at.HOVER_THRUST
ACCEL_MAX = at.ACCEL_MAX

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
        memory[DESIRED_POSITION + i] = position[i]
        memory[DESIRED_VELOCITY + i] = velocity[i]
        memory[DESIRED_ACCELERATION + i] = 0.0
        memory[VELOCITY_ERROR + i] = 0.0
        memory[VELOCITY_SLOPE + i] = 0.0
        memory[POSITION_ERROR + i] = 0.0
        memory[LIMIT_VECTOR + i] = 0.0
    most = ONE_G * math.tan(gains[TILT_MAX])
    memory[VELOCITY_INTEGRAL], memory[VELOCITY_INTEGRAL + 1] = shortened(lean[0], lean[1], most)
    memory[NE_ACTIVE] = 1.0


@compiled
def start_up(height: float, climb: float, gains: FloatArray, memory: FloatArray) -> None:
    """Begin at the present height and climb rate with the thrust that there is."""
    lift = memory[MEASURED_LIFT]
    memory[DESIRED_POSITION + 2] = height
    memory[DESIRED_VELOCITY + 2] = climb
    memory[DESIRED_ACCELERATION + 2] = limited(lift, -2.5, 2.5)
    memory[VELOCITY_ERROR + 2] = 0.0
    memory[VELOCITY_INTEGRAL + 2] = 0.0
    memory[POSITION_ERROR + 2] = 0.0
    memory[LIMIT_VECTOR + 2] = 0.0
    memory[LIFT_STARTED] = 0.0
    target = memory[DESIRED_ACCELERATION + 2]
    memory[LIFT_INTEGRAL] = memory[THROTTLE_IN] - gains[HOVER_THRUST] - gains[LIFT_P] * (target - lift)
    memory[UP_ACTIVE] = 1.0


@compiled
def soften_ne(position: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """The ground holds the vehicle: let the place it should hold go there, and the integral not grow."""
    share = dt_s / (dt_s + SOFT_LANDING_S)
    for i in range(2):
        memory[DESIRED_POSITION + i] += share * (position[i] - memory[DESIRED_POSITION + i])
        memory[LIMIT_VECTOR + i] = memory[TARGET_ACCELERATION + i]


@compiled
def advance_desired_ne(memory: FloatArray, dt_s: float) -> None:
    """Desired position and velocity move on, except further into a limit of tilt."""
    lx, ly = memory[LIMIT_VECTOR], memory[LIMIT_VECTOR + 1]
    ax, ay = memory[DESIRED_ACCELERATION], memory[DESIRED_ACCELERATION + 1]
    dx = memory[DESIRED_VELOCITY] * dt_s + 0.5 * ax * dt_s * dt_s
    dy = memory[DESIRED_VELOCITY + 1] * dt_s + 0.5 * ay * dt_s * dt_s
    error = memory[POSITION_ERROR] * lx + memory[POSITION_ERROR + 1] * ly
    if not (dx * lx + dy * ly > 0.0 and error > 0.0):
        memory[DESIRED_POSITION] += dx
        memory[DESIRED_POSITION + 1] += dy
    dx, dy = ax * dt_s, ay * dt_s
    error = memory[VELOCITY_ERROR] * lx + memory[VELOCITY_ERROR + 1] * ly
    along = memory[DESIRED_VELOCITY] * lx + memory[DESIRED_VELOCITY + 1] * ly
    if not (dx * lx + dy * ly > 0.0 and error > 0.0 and along >= 0.0):
        memory[DESIRED_VELOCITY] += dx
        memory[DESIRED_VELOCITY + 1] += dy


@compiled
def shape_ne(setpoint: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """Desired horizontal acceleration for the setpoint, within acceleration and jerk."""
    kind = setpoint[SET_NE_KIND]
    accel_max = max(setpoint[ACCEL_NE], 0.1)
    snap = min(gains[ACCEL_MAX], gains[ACCEL_MAX + 1]) * ONE_G
    jerk = gains[JERK_NE]
    if snap > 0.0:
        jerk = min(jerk, 0.5 * math.sqrt(accel_max * snap))
    px, py = setpoint[SET_POSITION], setpoint[SET_POSITION + 1]
    vx, vy = setpoint[SET_VELOCITY], setpoint[SET_VELOCITY + 1]
    ax, ay = setpoint[SET_ACCELERATION], setpoint[SET_ACCELERATION + 1]
    if kind == KIND_POSITION:
        vx = vy = ax = ay = 0.0
    wx, wy = vx, vy
    if kind <= KIND_TRAJECTORY:
        ex, ey = px - memory[DESIRED_POSITION], py - memory[DESIRED_POSITION + 1]
        cx, cy = pair_controller(ex, ey, 0.5 * jerk / accel_max, 0.5 * accel_max, dt_s)
        cx, cy = shortened(cx, cy, setpoint[SPEED_NE])
        wx, wy = vx + cx, vy + cy
    bx, by = ax, ay
    if kind <= KIND_VELOCITY:
        ex, ey = wx - memory[DESIRED_VELOCITY], wy - memory[DESIRED_VELOCITY + 1]
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
    dx, dy = bx - memory[DESIRED_ACCELERATION], by - memory[DESIRED_ACCELERATION + 1]
    dx, dy = shortened(dx, dy, jerk * dt_s)
    memory[DESIRED_ACCELERATION] += dx
    memory[DESIRED_ACCELERATION + 1] += dy
    # what was asked for goes on by itself until the next message
    if kind == KIND_TRAJECTORY:
        setpoint[SET_POSITION] += vx * dt_s + 0.5 * ax * dt_s * dt_s
        setpoint[SET_POSITION + 1] += vy * dt_s + 0.5 * ay * dt_s * dt_s
    if KIND_TRAJECTORY <= kind <= KIND_VELOCITY:
        setpoint[SET_VELOCITY] += ax * dt_s
        setpoint[SET_VELOCITY + 1] += ay * dt_s


@compiled
def correct_ne(
    position: FloatArray,
    velocity: FloatArray,
    setpoint: FloatArray,
    gains: FloatArray,
    memory: FloatArray,
    dt_s: float,
) -> None:
    """Position P and velocity PID about the desired trajectory: memory[TARGET_ACCELERATION] north and east."""
    accel_max = max(setpoint[ACCEL_NE], 0.1)
    ex = memory[DESIRED_POSITION] - position[0]
    ey = memory[DESIRED_POSITION + 1] - position[1]
    most = inverse_sqrt_controller(max(setpoint[SPEED_NE], 0.1), gains[POSITION_P], accel_max)
    if math.hypot(ex, ey) > most:
        ex, ey = shortened(ex, ey, most)
        memory[DESIRED_POSITION] = position[0] + ex
        memory[DESIRED_POSITION + 1] = position[1] + ey
    memory[POSITION_ERROR] = ex
    memory[POSITION_ERROR + 1] = ey
    cx, cy = pair_controller(ex, ey, gains[POSITION_P], accel_max, dt_s)
    lx, ly = memory[LIMIT_VECTOR], memory[LIMIT_VECTOR + 1]
    size = math.hypot(memory[VELOCITY_INTEGRAL], memory[VELOCITY_INTEGRAL + 1])
    growth_x = growth_y = 0.0
    for i in range(2):
        memory[TARGET_VELOCITY + i] = memory[DESIRED_VELOCITY + i] + (cx if i == 0 else cy)
        before = memory[VELOCITY_ERROR + i]
        error = memory[TARGET_VELOCITY + i] - velocity[i]
        memory[VELOCITY_ERROR + i] += low_pass_share(gains[VELOCITY_FLTE], dt_s) * (error - before)
        slope = (memory[VELOCITY_ERROR + i] - before) / dt_s
        memory[VELOCITY_SLOPE + i] += low_pass_share(gains[VELOCITY_FLTD], dt_s) * (
            slope - memory[VELOCITY_SLOPE + i]
        )
    growth_x = memory[VELOCITY_ERROR] * gains[VELOCITY_I] * dt_s
    growth_y = memory[VELOCITY_ERROR + 1] * gains[VELOCITY_I] * dt_s
    ix, iy = memory[VELOCITY_INTEGRAL] + growth_x, memory[VELOCITY_INTEGRAL + 1] + growth_y
    if growth_x * lx + growth_y * ly > 0.0:
        ix, iy = shortened(ix, iy, size)
    ix, iy = shortened(ix, iy, gains[VELOCITY_IMAX])
    memory[VELOCITY_INTEGRAL] = ix
    memory[VELOCITY_INTEGRAL + 1] = iy
    for i in range(2):
        memory[TARGET_ACCELERATION + i] = (
            memory[DESIRED_ACCELERATION + i]
            + gains[VELOCITY_P] * memory[VELOCITY_ERROR + i]
            + memory[VELOCITY_INTEGRAL + i]
            + gains[VELOCITY_D] * memory[VELOCITY_SLOPE + i]
        )
    ax, ay = memory[TARGET_ACCELERATION], memory[TARGET_ACCELERATION + 1]
    most = ONE_G * math.tan(gains[TILT_MAX])
    if math.hypot(ax, ay) > most:
        memory[LIMIT_VECTOR] = ax
        memory[LIMIT_VECTOR + 1] = ay
        memory[TARGET_ACCELERATION], memory[TARGET_ACCELERATION + 1] = shortened(ax, ay, most)
    else:
        memory[LIMIT_VECTOR] = 0.0
        memory[LIMIT_VECTOR + 1] = 0.0


@compiled
def shape_up(setpoint: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """Desired height, climb rate and acceleration move on towards the setpoint."""
    if setpoint[IGNORE_DESCENT_LIMIT] > 0.0:
        memory[LIMIT_VECTOR + 2] = max(memory[LIMIT_VECTOR + 2], 0.0)
    fastest_up, fastest_down = max(setpoint[SPEED_UP], 0.05), max(setpoint[SPEED_DOWN], 0.05)
    climb = memory[DESIRED_VELOCITY + 2]
    gain = 1.0
    if climb < -fastest_down:
        gain = OVERSPEED_GAIN * -climb / fastest_down
    elif climb > fastest_up:
        gain = OVERSPEED_GAIN * climb / fastest_up
    accel_max = max(setpoint[ACCEL_UP], 0.1) * gain
    accel_down = min(accel_max, MOST_DESCENT_ACCEL)
    jerk = gains[JERK_UP]
    if gains[LIFT_FLTE] > 0.0:
        jerk = min(jerk, min(ONE_G, max(setpoint[ACCEL_UP], 0.1)) * 2.0 * math.pi * gains[LIFT_FLTE] / 5.0)
    jerk *= gain

    limit = memory[LIMIT_VECTOR + 2]
    acceleration = memory[DESIRED_ACCELERATION + 2]
    step = climb * dt_s + 0.5 * acceleration * dt_s * dt_s
    if not (step * limit > 0.0 and memory[POSITION_ERROR + 2] * limit > 0.0):
        memory[DESIRED_POSITION + 2] += step
    step = acceleration * dt_s
    if not (step * limit > 0.0 and memory[VELOCITY_ERROR + 2] * limit > 0.0 and climb * limit >= 0.0):
        memory[DESIRED_VELOCITY + 2] += step
    climb = memory[DESIRED_VELOCITY + 2]

    kind = setpoint[SET_UP_KIND]
    feed_v, feed_a = setpoint[SET_VELOCITY + 2], setpoint[SET_ACCELERATION + 2]
    if kind == KIND_POSITION:
        feed_v = feed_a = 0.0
    wanted = feed_v
    if kind <= KIND_TRAJECTORY:
        error = setpoint[SET_POSITION + 2] - memory[DESIRED_POSITION + 2]
        room = accel_down if error > 0.0 else accel_max
        correction = sqrt_controller(error, 0.5 * jerk / room, 0.5 * room, dt_s)
        wanted += limited(correction, -fastest_down, fastest_up)
    push = feed_a
    if kind <= KIND_VELOCITY:
        error = wanted - climb
        room = accel_max if error > 0.0 else accel_down
        push += limited(sqrt_controller(error, jerk / room, jerk, dt_s), -accel_down, accel_max)
    change = limited(push - acceleration, -jerk * dt_s, jerk * dt_s)
    memory[DESIRED_ACCELERATION + 2] = acceleration + change
    if kind == KIND_TRAJECTORY:
        setpoint[SET_POSITION + 2] += feed_v * dt_s + 0.5 * feed_a * dt_s * dt_s
    if KIND_TRAJECTORY <= kind <= KIND_VELOCITY:
        setpoint[SET_VELOCITY + 2] += feed_a * dt_s


@compiled
def correct_up(
    height: float, climb: float, setpoint: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float
) -> None:
    """Height P, climb-rate PI, lift PI about the desired climb: thrust for the motors."""
    accel_max = max(setpoint[ACCEL_UP], 0.1)
    error = memory[DESIRED_POSITION + 2] - height
    most_up = inverse_sqrt_controller(max(setpoint[SPEED_UP], 0.05), gains[HEIGHT_P], accel_max)
    most_down = inverse_sqrt_controller(max(setpoint[SPEED_DOWN], 0.05), gains[HEIGHT_P], accel_max)
    bounded = limited(error, -most_down, most_up)
    if bounded != error:
        memory[DESIRED_POSITION + 2] = height + bounded
        error = bounded
    memory[POSITION_ERROR + 2] = error
    wanted = memory[DESIRED_VELOCITY + 2] + sqrt_controller(error, gains[HEIGHT_P], accel_max, dt_s)
    memory[TARGET_VELOCITY + 2] = wanted
    share = low_pass_share(gains[CLIMB_FLTE], dt_s)
    memory[VELOCITY_ERROR + 2] += share * (wanted - climb - memory[VELOCITY_ERROR + 2])
    off = memory[VELOCITY_ERROR + 2]
    stuck = (memory[LIMIT_LOWER] > 0.0 and off < 0.0) or (memory[LIMIT_UPPER] > 0.0 and off > 0.0)
    if not stuck:
        grown = memory[VELOCITY_INTEGRAL + 2] + off * gains[CLIMB_I] * dt_s
        memory[VELOCITY_INTEGRAL + 2] = limited(grown, -gains[CLIMB_IMAX], gains[CLIMB_IMAX])
    lift = memory[DESIRED_ACCELERATION + 2] + gains[CLIMB_P] * off + memory[VELOCITY_INTEGRAL + 2]
    memory[TARGET_ACCELERATION + 2] = lift
    off_lift = lift - memory[MEASURED_LIFT]
    if memory[LIFT_STARTED] > 0.0:
        off_lift = memory[LIFT_ERROR] + low_pass_share(gains[LIFT_FLTE], dt_s) * (
            off_lift - memory[LIFT_ERROR]
        )
    memory[LIFT_STARTED] = 1.0
    memory[LIFT_ERROR] = off_lift
    limits = memory[LIMIT_LOWER] > 0.0 or memory[LIMIT_UPPER] > 0.0
    if not limits or memory[LIFT_INTEGRAL] * off_lift < 0.0:
        grown = memory[LIFT_INTEGRAL] + off_lift * gains[LIFT_I] * dt_s
        memory[LIFT_INTEGRAL] = limited(grown, -gains[LIFT_IMAX], gains[LIFT_IMAX])
    thrust = gains[HOVER_THRUST] + gains[LIFT_P] * off_lift + memory[LIFT_INTEGRAL]
    give_throttle(thrust, gains, memory, THROTTLE_CUTOFF_HZ)
    ratio = memory[CLIMB_RATIO] + dt_s * 0.1 * (0.5 + off / max(setpoint[SPEED_DOWN], 0.05))
    memory[CLIMB_RATIO] = limited(ratio, 0.0, 2.0)
    if memory[LIMIT_UPPER] > 0.0:
        memory[LIMIT_VECTOR + 2] = 1.0
    elif memory[LIMIT_LOWER] > 0.0:
        memory[LIMIT_VECTOR + 2] = -1.0
    else:
        memory[LIMIT_VECTOR + 2] = 0.0
