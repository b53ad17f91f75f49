"""Compiled motor output with ArduCopter's structure: spooling up and down, and who gives way when motors saturate.

Thrust and torque become motor commands through factors of ±0.5 (AP_MotorsMatrix): yaw is cut first (MOT_YAW_HEADROOM is its
own), then thrust is moved into the range that roll and pitch leave, then all three torques are scaled.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.shaping import limited, low_pass_share
from sitl_stub.physics.compiled import compiled
from sitl_stub.physics.vehicle import VehicleParameters

FloatArray = NDArray[np.float64]

ANGLE_BOOST = at.ANGLE_BOOST
THRUST_EXPO = at.THRUST_EXPO
YAW_HEADROOM = at.YAW_HEADROOM
SPOOL_TIME = at.SPOOL_TIME
HOVER_THRUST = at.HOVER_THRUST
MIX_MIN = at.MIX_MIN
SPIN_ARM = at.SPIN_ARM
SPIN_MIN = at.SPIN_MIN
SPIN_MAX = at.SPIN_MAX
SPOOL = at.SPOOL
SPOOL_SHUT_DOWN = at.SPOOL_SHUT_DOWN
SPOOL_GROUND_IDLE = at.SPOOL_GROUND_IDLE
SPOOL_UNLIMITED = at.SPOOL_UNLIMITED
THROTTLE_MIX = at.THROTTLE_MIX
THROTTLE_IN = at.THROTTLE_IN
THROTTLE = at.THROTTLE
THROTTLE_FILTERED = at.THROTTLE_FILTERED
THROTTLE_AVERAGE_MAX = at.THROTTLE_AVERAGE_MAX
RPY_MIX = at.RPY_MIX
THROTTLE_OUT = at.THROTTLE_OUT
SPOOL_STATE = at.SPOOL_STATE
SHUT_DOWN = at.STATE_SHUT_DOWN
GROUND_IDLE = at.STATE_GROUND_IDLE
SPOOLING_UP = at.STATE_SPOOLING_UP
UNLIMITED = at.STATE_UNLIMITED
SPOOLING_DOWN = at.STATE_SPOOLING_DOWN
SPIN_RATIO = at.SPIN_RATIO
THRUST_MAX = at.THRUST_MAX
LIMIT_TORQUE = at.LIMIT_TORQUE
LIMIT_LOWER = at.LIMIT_LOWER
LIMIT_UPPER = at.LIMIT_UPPER
OUT_TORQUE = at.OUT_TORQUE
OUT_MOTORS = at.OUT_MOTORS
ACTUATORS = at.ACTUATORS
THRUST_ANGLE = at.THRUST_ANGLE
CUTOFF_HZ = at.CUTOFF_HZ
CLIMB_RATIO = at.CLIMB_RATIO


def motor_factors(vehicle: VehicleParameters) -> FloatArray:
    """Factors (N, 3) of each motor for roll, pitch and yaw (FRD), the greatest of each axis ±0.5."""
    place = vehicle.rotor_position_frd
    factors = np.stack([-place[:, 1], place[:, 0], vehicle.rotor_spin], axis=1).astype(np.float64)
    most = np.abs(factors).max(axis=0)
    return np.ascontiguousarray(0.5 * factors / np.where(most > 1e-9, most, 1.0))


@compiled
def give_throttle(throttle: float, gains: FloatArray, memory: FloatArray, cutoff_hz: float) -> None:
    """Thrust (0..1) for the motors; ATC_ANGLE_BOOST multiplies it by 1/cos(tilt)."""
    memory[THROTTLE_IN] = throttle
    memory[CUTOFF_HZ] = cutoff_hz
    if gains[ANGLE_BOOST] > 0.0:
        tilt = math.cos(memory[THRUST_ANGLE])
        throttle *= limited(10.0 * tilt, 0.0, 1.0) / limited(tilt, 0.1, 1.0)
    memory[THROTTLE] = throttle
    most = limited(max(throttle, memory[THROTTLE_IN]), 0.0, 1.0)
    mix = memory[RPY_MIX]
    memory[THROTTLE_AVERAGE_MAX] = max(most, most * max(0.0, 1.0 - mix) + gains[HOVER_THRUST] * mix)


@compiled
def move_mix(wanted_kind: float, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """How far torque goes before thrust: up quickly, down slowly (ATC_THR_MIX_...)."""
    wanted = gains[MIX_MIN + int(wanted_kind)]
    if wanted_kind == 2.0:
        ratio = limited(memory[CLIMB_RATIO], 0.0, 1.0)
        wanted = (1.0 - ratio) * gains[MIX_MIN] + ratio * wanted
    mix = memory[RPY_MIX]
    if mix < wanted:
        mix += min(2.0 * dt_s, wanted - mix)
    elif mix > wanted:
        mix -= min(0.5 * dt_s, mix - wanted)
        hover, given = gains[HOVER_THRUST], memory[THROTTLE_FILTERED]
        out = max(memory[THROTTLE_OUT], given)
        used = (out - given) / (hover - given) if out < hover else out / hover
        mix = min(mix, max(used, wanted))
    memory[RPY_MIX] = limited(mix, 0.1, 5.0)


@compiled
def _set_limits(memory: FloatArray, value: float) -> None:
    for i in range(3):
        memory[LIMIT_TORQUE + i] = value
    memory[LIMIT_LOWER] = value
    memory[LIMIT_UPPER] = value


@compiled
def spool(wanted: float, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """Motors from rest to idle to full range and back, MOT_SPOOL_TIME a stage."""
    if wanted == SPOOL_SHUT_DOWN:
        memory[SPOOL_STATE] = SHUT_DOWN
    state = memory[SPOOL_STATE]
    step = dt_s / gains[SPOOL_TIME]
    if state == SHUT_DOWN:
        _set_limits(memory, 1.0)
        if wanted != SPOOL_SHUT_DOWN:
            memory[SPOOL_STATE] = GROUND_IDLE
            return
        memory[SPIN_RATIO] = 0.0
        memory[THRUST_MAX] = 0.0
    elif state == GROUND_IDLE:
        _set_limits(memory, 1.0)
        if wanted == SPOOL_UNLIMITED:
            memory[SPIN_RATIO] += step
            if memory[SPIN_RATIO] >= 1.0:
                memory[SPIN_RATIO] = 1.0
                memory[SPOOL_STATE] = SPOOLING_UP
        else:
            idle = gains[SPIN_ARM] / gains[SPIN_MIN] if gains[SPIN_MIN] > 0.0 else 0.0
            memory[SPIN_RATIO] += limited(idle - memory[SPIN_RATIO], -step, step)
        memory[THRUST_MAX] = 0.0
    elif state == SPOOLING_UP:
        _set_limits(memory, 0.0)
        if wanted != SPOOL_UNLIMITED:
            memory[SPOOL_STATE] = SPOOLING_DOWN
            return
        memory[THRUST_MAX] += step
        if memory[THRUST_MAX] >= min(memory[THROTTLE_FILTERED], 1.0):
            memory[THRUST_MAX] = 1.0
            memory[SPOOL_STATE] = UNLIMITED
    elif state == UNLIMITED:
        _set_limits(memory, 0.0)
        if wanted != SPOOL_UNLIMITED:
            memory[SPOOL_STATE] = SPOOLING_DOWN
            return
        memory[THRUST_MAX] = 1.0
    else:
        _set_limits(memory, 0.0)
        if wanted == SPOOL_UNLIMITED:
            memory[SPOOL_STATE] = SPOOLING_UP
            return
        memory[THRUST_MAX] = max(memory[THRUST_MAX] - step, 0.0)
        if memory[THRUST_MAX] == 0.0:
            memory[SPOOL_STATE] = GROUND_IDLE


@compiled
def mix(factors: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """memory[OUT_MOTORS] and memory[ACTUATORS] from torque, throttle and the spool state."""
    count = factors.shape[0]
    state = memory[SPOOL_STATE]
    if state == SHUT_DOWN:
        memory[THROTTLE_FILTERED] = 0.0
    else:
        share = low_pass_share(memory[CUTOFF_HZ], dt_s)
        filtered = memory[THROTTLE_FILTERED]
        memory[THROTTLE_FILTERED] = limited(filtered + share * (memory[THROTTLE] - filtered), 0.0, 1.0)
    if state <= GROUND_IDLE:
        for i in range(count):
            memory[OUT_MOTORS + i] = 0.0
            memory[ACTUATORS + i] = memory[SPIN_RATIO] * gains[SPIN_MIN] if state == GROUND_IDLE else 0.0
        memory[THROTTLE_OUT] = 0.0
        return
    roll, pitch, yaw = memory[OUT_TORQUE], memory[OUT_TORQUE + 1], memory[OUT_TORQUE + 2]
    throttle = memory[THROTTLE_FILTERED]
    ceiling = memory[THRUST_MAX]
    if throttle <= 0.0:
        throttle = 0.0
        memory[LIMIT_LOWER] = 1.0
    if throttle >= ceiling:
        throttle = ceiling
        memory[LIMIT_UPPER] = 1.0
    average_max = limited(memory[THROTTLE_AVERAGE_MAX], throttle, ceiling)
    best = min(0.5, average_max)

    allowed = 1.0
    for i in range(count):
        tilt = roll * factors[i, 0] + pitch * factors[i, 1]
        memory[OUT_MOTORS + i] = tilt
        share = abs(factors[i, 2])
        if share > 0.0:
            room = 1.0 - (best + tilt) if yaw * factors[i, 2] > 0.0 else best + tilt
            allowed = min(allowed, max(room, 0.0) / share)
    allowed = max(allowed, gains[YAW_HEADROOM])
    if abs(yaw) > allowed:
        yaw = limited(yaw, -allowed, allowed)
        memory[LIMIT_TORQUE + 2] = 1.0

    low, high = 1.0, -1.0
    for i in range(count):
        memory[OUT_MOTORS + i] += yaw * factors[i, 2]
        low = min(low, memory[OUT_MOTORS + i])
        high = max(high, memory[OUT_MOTORS + i])
    scale = 1.0
    if high - low > 1.0:
        scale = 1.0 / (high - low)
    if average_max + low < 0.0:
        scale = min(scale, -average_max / low)
    low, high = low * scale, high * scale
    base = -low
    extra = throttle - base
    if scale < 1.0:
        for i in range(3):
            memory[LIMIT_TORQUE + i] = 1.0
        if extra > 0.0:
            memory[LIMIT_UPPER] = 1.0
        extra = 0.0
    elif extra < 0.0:
        extra = 0.0
    elif extra > 1.0 - (base + high):
        extra = 1.0 - (base + high)
        memory[LIMIT_UPPER] = 1.0
    base += extra
    memory[THROTTLE_OUT] = base
    expo = gains[THRUST_EXPO]
    for i in range(count):
        thrust = limited(base + scale * memory[OUT_MOTORS + i], 0.0, 1.0)
        signal = thrust
        if expo > 0.0:
            signal = (math.sqrt((1.0 - expo) ** 2 + 4.0 * expo * thrust) - (1.0 - expo)) / (2.0 * expo)
        memory[OUT_MOTORS + i] = signal
        memory[ACTUATORS + i] = gains[SPIN_MIN] + (gains[SPIN_MAX] - gains[SPIN_MIN]) * signal
