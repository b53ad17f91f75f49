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


def motor_factors(vehicle: VehicleParameters) -> FloatArray:
    """Factors (N, 3) of each motor for roll, pitch and yaw (FRD), the greatest of each axis ±0.5."""
    place = vehicle.rotor_position_frd
    factors = np.stack([-place[:, 1], place[:, 0], vehicle.rotor_spin], axis=1).astype(np.float64)
    most = np.abs(factors).max(axis=0)
    return np.ascontiguousarray(0.5 * factors / np.where(most > 1e-9, most, 1.0))


@compiled
def give_throttle(throttle: float, gains: FloatArray, memory: FloatArray, cutoff_hz: float) -> None:
    """Thrust (0..1) for the motors; ATC_ANGLE_BOOST multiplies it by 1/cos(tilt)."""
    memory[at.THROTTLE_IN] = throttle
    memory[at.CUTOFF_HZ] = cutoff_hz
    if gains[at.ANGLE_BOOST] > 0.0:
        tilt = math.cos(memory[at.THRUST_ANGLE])
        throttle *= limited(10.0 * tilt, 0.0, 1.0) / limited(tilt, 0.1, 1.0)
    memory[at.THROTTLE] = throttle
    most = limited(max(throttle, memory[at.THROTTLE_IN]), 0.0, 1.0)
    mix = memory[at.RPY_MIX]
    memory[at.THROTTLE_AVERAGE_MAX] = max(most, most * max(0.0, 1.0 - mix) + gains[at.HOVER_THRUST] * mix)


@compiled
def move_mix(wanted_kind: float, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """How far torque goes before thrust: up quickly, down slowly (ATC_THR_MIX_...)."""
    wanted = gains[at.MIX_MIN + int(wanted_kind)]
    if wanted_kind == 2.0:
        ratio = limited(memory[at.CLIMB_RATIO], 0.0, 1.0)
        wanted = (1.0 - ratio) * gains[at.MIX_MIN] + ratio * wanted
    mix = memory[at.RPY_MIX]
    if mix < wanted:
        mix += min(2.0 * dt_s, wanted - mix)
    elif mix > wanted:
        mix -= min(0.5 * dt_s, mix - wanted)
        hover, given = gains[at.HOVER_THRUST], memory[at.THROTTLE_FILTERED]
        out = max(memory[at.THROTTLE_OUT], given)
        used = (out - given) / (hover - given) if out < hover else out / hover
        mix = min(mix, max(used, wanted))
    memory[at.RPY_MIX] = limited(mix, 0.1, 5.0)


@compiled
def _set_limits(memory: FloatArray, value: float) -> None:
    for i in range(3):
        memory[at.LIMIT_TORQUE + i] = value
    memory[at.LIMIT_LOWER] = value
    memory[at.LIMIT_UPPER] = value


@compiled
def spool(wanted: float, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """Motors from rest to idle to full range and back, MOT_SPOOL_TIME a stage."""
    if wanted == at.SPOOL_SHUT_DOWN:
        memory[at.SPOOL_STATE] = at.STATE_SHUT_DOWN
    state = memory[at.SPOOL_STATE]
    step = dt_s / gains[at.SPOOL_TIME]
    if state == at.STATE_SHUT_DOWN:
        _set_limits(memory, 1.0)
        if wanted != at.SPOOL_SHUT_DOWN:
            memory[at.SPOOL_STATE] = at.STATE_GROUND_IDLE
            return
        memory[at.SPIN_RATIO] = 0.0
        memory[at.THRUST_MAX] = 0.0
    elif state == at.STATE_GROUND_IDLE:
        _set_limits(memory, 1.0)
        if wanted == at.SPOOL_UNLIMITED:
            memory[at.SPIN_RATIO] += step
            if memory[at.SPIN_RATIO] >= 1.0:
                memory[at.SPIN_RATIO] = 1.0
                memory[at.SPOOL_STATE] = at.STATE_SPOOLING_UP
        else:
            idle = gains[at.SPIN_ARM] / gains[at.SPIN_MIN] if gains[at.SPIN_MIN] > 0.0 else 0.0
            memory[at.SPIN_RATIO] += limited(idle - memory[at.SPIN_RATIO], -step, step)
        memory[at.THRUST_MAX] = 0.0
    elif state == at.STATE_SPOOLING_UP:
        _set_limits(memory, 0.0)
        if wanted != at.SPOOL_UNLIMITED:
            memory[at.SPOOL_STATE] = at.STATE_SPOOLING_DOWN
            return
        memory[at.THRUST_MAX] += step
        if memory[at.THRUST_MAX] >= min(memory[at.THROTTLE_FILTERED], 1.0):
            memory[at.THRUST_MAX] = 1.0
            memory[at.SPOOL_STATE] = at.STATE_UNLIMITED
    elif state == at.STATE_UNLIMITED:
        _set_limits(memory, 0.0)
        if wanted != at.SPOOL_UNLIMITED:
            memory[at.SPOOL_STATE] = at.STATE_SPOOLING_DOWN
            return
        memory[at.THRUST_MAX] = 1.0
    else:
        _set_limits(memory, 0.0)
        if wanted == at.SPOOL_UNLIMITED:
            memory[at.SPOOL_STATE] = at.STATE_SPOOLING_UP
            return
        memory[at.THRUST_MAX] = max(memory[at.THRUST_MAX] - step, 0.0)
        if memory[at.THRUST_MAX] == 0.0:
            memory[at.SPOOL_STATE] = at.STATE_GROUND_IDLE


@compiled
def mix(factors: FloatArray, gains: FloatArray, memory: FloatArray, dt_s: float) -> None:
    """memory[at.OUT_MOTORS] and memory[at.ACTUATORS] from torque, throttle and the spool state."""
    count = factors.shape[0]
    state = memory[at.SPOOL_STATE]
    if state == at.STATE_SHUT_DOWN:
        memory[at.THROTTLE_FILTERED] = 0.0
    else:
        share = low_pass_share(memory[at.CUTOFF_HZ], dt_s)
        filtered = memory[at.THROTTLE_FILTERED]
        memory[at.THROTTLE_FILTERED] = limited(filtered + share * (memory[at.THROTTLE] - filtered), 0.0, 1.0)
    if state <= at.STATE_GROUND_IDLE:
        for i in range(count):
            memory[at.OUT_MOTORS + i] = 0.0
            memory[at.ACTUATORS + i] = (
                memory[at.SPIN_RATIO] * gains[at.SPIN_MIN] if state == at.STATE_GROUND_IDLE else 0.0
            )
        memory[at.THROTTLE_OUT] = 0.0
        return
    roll, pitch, yaw = memory[at.OUT_TORQUE], memory[at.OUT_TORQUE + 1], memory[at.OUT_TORQUE + 2]
    throttle = memory[at.THROTTLE_FILTERED]
    ceiling = memory[at.THRUST_MAX]
    if throttle <= 0.0:
        throttle = 0.0
        memory[at.LIMIT_LOWER] = 1.0
    if throttle >= ceiling:
        throttle = ceiling
        memory[at.LIMIT_UPPER] = 1.0
    average_max = limited(memory[at.THROTTLE_AVERAGE_MAX], throttle, ceiling)
    best = min(0.5, average_max)

    allowed = 1.0
    for i in range(count):
        tilt = roll * factors[i, 0] + pitch * factors[i, 1]
        memory[at.OUT_MOTORS + i] = tilt
        share = abs(factors[i, 2])
        if share > 0.0:
            room = 1.0 - (best + tilt) if yaw * factors[i, 2] > 0.0 else best + tilt
            allowed = min(allowed, max(room, 0.0) / share)
    allowed = max(allowed, gains[at.YAW_HEADROOM])
    if abs(yaw) > allowed:
        yaw = limited(yaw, -allowed, allowed)
        memory[at.LIMIT_TORQUE + 2] = 1.0

    low, high = 1.0, -1.0
    for i in range(count):
        memory[at.OUT_MOTORS + i] += yaw * factors[i, 2]
        low = min(low, memory[at.OUT_MOTORS + i])
        high = max(high, memory[at.OUT_MOTORS + i])
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
            memory[at.LIMIT_TORQUE + i] = 1.0
        if extra > 0.0:
            memory[at.LIMIT_UPPER] = 1.0
        extra = 0.0
    elif extra < 0.0:
        extra = 0.0
    elif extra > 1.0 - (base + high):
        extra = 1.0 - (base + high)
        memory[at.LIMIT_UPPER] = 1.0
    base += extra
    memory[at.THROTTLE_OUT] = base
    expo = gains[at.THRUST_EXPO]
    for i in range(count):
        thrust = limited(base + scale * memory[at.OUT_MOTORS + i], 0.0, 1.0)
        signal = thrust
        if expo > 0.0:
            signal = (math.sqrt((1.0 - expo) ** 2 + 4.0 * expo * thrust) - (1.0 - expo)) / (2.0 * expo)
        memory[at.OUT_MOTORS + i] = signal
        memory[at.ACTUATORS + i] = gains[at.SPIN_MIN] + (gains[at.SPIN_MAX] - gains[at.SPIN_MIN]) * signal
