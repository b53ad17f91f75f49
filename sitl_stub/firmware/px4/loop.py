"""The compiled inner loop: estimate → controllers → mixer → physics, one call for many control periods.

This is the function for gain searches: it allocates nothing, releases the GIL and is callable from other compiled
code. `core.py` wraps it for everybody else. Layout of the arrays: `layout.py` and `physics/vehicle.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.attitude_control import attitude_to_rates, filter_gyro, rates_to_torque
from sitl_stub.firmware.px4.mixing import mix
from sitl_stub.firmware.px4.position_control import trajectory_to_attitude
from sitl_stub.physics.compiled import compiled
from sitl_stub.physics.estimator import (
    EST_BODY_RATE,
    EST_POSITION,
    EST_QUATERNION,
    EST_VELOCITY,
    advance_estimate,
)
from sitl_stub.physics.noise import RandomState
from sitl_stub.physics.rigid_body import advance
from sitl_stub.physics.wind import advance_wind

FloatArray = NDArray[np.float64]

KIND = at.KIND
KIND_IDLE = at.KIND_IDLE
KIND_ATTITUDE = at.KIND_ATTITUDE
KIND_RATES = at.KIND_RATES
KIND_ACTUATORS = at.KIND_ACTUATORS
KIND_TRAJECTORY = at.KIND_TRAJECTORY
SET_QUATERNION = at.QUATERNION
SET_YAW_RATE = at.YAW_RATE
SET_RATES = at.RATES
SET_THRUST = at.THRUST
SET_ACTUATORS = at.ACTUATORS
OVERRIDE_PERIODS = at.OVERRIDE_PERIODS
OVERRIDE_RATES = at.OVERRIDE_RATES
OVERRIDE_THRUST = at.OVERRIDE_THRUST
THRUST_MODEL_FACTOR = at.THRUST_MODEL_FACTOR
OUT_QUATERNION = at.OUT_QUATERNION
OUT_RATES = at.OUT_RATES
OUT_THRUST = at.OUT_THRUST
OUT_TORQUE = at.OUT_TORQUE
OUT_MOTORS = at.OUT_MOTORS
STEPS_TO_POSITION = at.STEPS_TO_POSITION
TRAJECTORY_RUNNING = at.TRAJECTORY_RUNNING
RATE_INTEGRAL = at.RATE_INTEGRAL
YAW_TORQUE_FILTERED = at.YAW_TORQUE_FILTERED
SATURATED_HIGH = at.SATURATED_HIGH
SATURATED_LOW = at.SATURATED_LOW


@compiled
def quaternion_yaw(q: FloatArray) -> float:
    """Heading of `q` (4,), rad, clockwise from north."""
    return math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))


@compiled
def control(
    estimate: FloatArray,
    setpoint: FloatArray,
    gains: FloatArray,
    memory: FloatArray,
    mixer: FloatArray,
    columns: FloatArray,
    scratch: FloatArray,
    dt_s: float,
    position_every: int,
    integrate: bool,
) -> None:
    """One control period: memory[OUT_MOTORS] from estimate and setpoint. `scratch` (8,) is overwritten."""
    filter_gyro(estimate[EST_BODY_RATE : EST_BODY_RATE + 3], gains, memory, dt_s)
    kind = setpoint[KIND]
    motors = memory[OUT_MOTORS : OUT_MOTORS + 8]
    if kind == KIND_IDLE:
        for i in range(8):
            motors[i] = 0.0
        for i in range(3):
            memory[RATE_INTEGRAL + i] = 0.0
            memory[OUT_TORQUE + i] = 0.0
            memory[OUT_RATES + i] = 0.0
        memory[YAW_TORQUE_FILTERED] = 0.0
        memory[OUT_THRUST] = 0.0
        memory[TRAJECTORY_RUNNING] = 0.0
        return
    q = estimate[EST_QUATERNION : EST_QUATERNION + 4]
    if kind == KIND_TRAJECTORY:
        if memory[STEPS_TO_POSITION] <= 0.0 or memory[TRAJECTORY_RUNNING] == 0.0:
            trajectory_to_attitude(
                estimate[EST_POSITION : EST_POSITION + 3],
                estimate[EST_VELOCITY : EST_VELOCITY + 3],
                quaternion_yaw(q),
                setpoint,
                gains,
                memory,
                dt_s * position_every,
            )
            memory[STEPS_TO_POSITION] = position_every
        memory[STEPS_TO_POSITION] -= 1.0
        target = memory[OUT_QUATERNION : OUT_QUATERNION + 4]
        attitude_to_rates(q, target, setpoint[SET_YAW_RATE], gains, memory)
    else:
        memory[TRAJECTORY_RUNNING] = 0.0
        memory[OUT_THRUST] = setpoint[SET_THRUST]
        if kind == KIND_ATTITUDE:
            for i in range(4):
                memory[OUT_QUATERNION + i] = setpoint[SET_QUATERNION + i]
            target = memory[OUT_QUATERNION : OUT_QUATERNION + 4]
            attitude_to_rates(q, target, setpoint[SET_YAW_RATE], gains, memory)
        if kind == KIND_RATES:
            for i in range(3):
                memory[OUT_RATES + i] = setpoint[SET_RATES + i]
        elif kind == KIND_ATTITUDE and setpoint[OVERRIDE_PERIODS] > 0.0:
            setpoint[OVERRIDE_PERIODS] -= 1.0
            memory[OUT_THRUST] = setpoint[OVERRIDE_THRUST]
            for i in range(3):
                memory[OUT_RATES + i] = setpoint[OVERRIDE_RATES + i]
    if kind == KIND_ACTUATORS:
        for i in range(3):
            memory[OUT_TORQUE + i] = min(max(setpoint[SET_ACTUATORS + i], -1.0), 1.0)
            memory[RATE_INTEGRAL + i] = 0.0
        memory[OUT_THRUST] = setpoint[SET_ACTUATORS + 3]
    else:
        rates_to_torque(gains, memory, dt_s, integrate)
    mix(
        memory[OUT_TORQUE],
        memory[OUT_TORQUE + 1],
        memory[OUT_TORQUE + 2],
        min(max(memory[OUT_THRUST], 0.0), 1.0),
        mixer,
        columns,
        motors,
        scratch,
        memory[SATURATED_HIGH : SATURATED_HIGH + 3],
        memory[SATURATED_LOW : SATURATED_LOW + 3],
    )
    factor = gains[THRUST_MODEL_FACTOR]
    if factor > 0.0:
        for i in range(mixer.shape[0]):
            linear = 1.0 - factor
            motors[i] = (math.sqrt(linear * linear + 4.0 * factor * motors[i]) - linear) / (2.0 * factor)


@compiled
def fly(
    state: FloatArray,
    estimate: FloatArray,
    estimator_memory: FloatArray,
    delay_line: FloatArray,
    estimator_settings: FloatArray,
    estimator_random: RandomState,
    wind: FloatArray,
    wind_random: RandomState,
    setpoint: FloatArray,
    gains: FloatArray,
    memory: FloatArray,
    mixer: FloatArray,
    columns: FloatArray,
    scratch: FloatArray,
    vehicle: FloatArray,
    environment: FloatArray,
    control_period_s: float,
    physics_steps: int,
    position_every: int,
    integrate: bool,
    periods: int,
) -> None:
    """Advance everything in place by `periods` control periods of `control_period_s`, of `physics_steps` steps each.

    In each period: controllers on the last estimate, gusts, physics, then the estimate of the period's end. The estimator's
    grid must be `control_period_s`.
    """
    physics_dt = control_period_s / physics_steps
    for _ in range(periods):
        control(
            estimate,
            setpoint,
            gains,
            memory,
            mixer,
            columns,
            scratch,
            control_period_s,
            position_every,
            integrate,
        )
        advance_wind(wind, wind_random, state, environment, control_period_s)
        advance(state, memory[OUT_MOTORS : OUT_MOTORS + 8], vehicle, environment, physics_dt, physics_steps)
        advance_estimate(estimate, estimator_memory, delay_line, estimator_settings, estimator_random, state)
