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
    """One control period: memory[at.OUT_MOTORS] from estimate and setpoint. `scratch` (8,) is overwritten."""
    filter_gyro(estimate[EST_BODY_RATE : EST_BODY_RATE + 3], gains, memory, dt_s)
    kind = setpoint[at.KIND]
    motors = memory[at.OUT_MOTORS : at.OUT_MOTORS + 8]
    if kind == at.KIND_IDLE:
        for i in range(8):
            motors[i] = 0.0
        for i in range(3):
            memory[at.RATE_INTEGRAL + i] = 0.0
            memory[at.OUT_TORQUE + i] = 0.0
            memory[at.OUT_RATES + i] = 0.0
        memory[at.YAW_TORQUE_FILTERED] = 0.0
        memory[at.OUT_THRUST] = 0.0
        memory[at.TRAJECTORY_RUNNING] = 0.0
        return
    q = estimate[EST_QUATERNION : EST_QUATERNION + 4]
    if kind == at.KIND_TRAJECTORY:
        if memory[at.STEPS_TO_POSITION] <= 0.0 or memory[at.TRAJECTORY_RUNNING] == 0.0:
            trajectory_to_attitude(
                estimate[EST_POSITION : EST_POSITION + 3],
                estimate[EST_VELOCITY : EST_VELOCITY + 3],
                quaternion_yaw(q),
                setpoint,
                gains,
                memory,
                dt_s * position_every,
            )
            memory[at.STEPS_TO_POSITION] = position_every
        memory[at.STEPS_TO_POSITION] -= 1.0
        target = memory[at.OUT_QUATERNION : at.OUT_QUATERNION + 4]
        attitude_to_rates(q, target, setpoint[at.YAW_RATE], gains, memory)
    else:
        memory[at.TRAJECTORY_RUNNING] = 0.0
        memory[at.OUT_THRUST] = setpoint[at.THRUST]
        if kind == at.KIND_ATTITUDE:
            for i in range(4):
                memory[at.OUT_QUATERNION + i] = setpoint[at.QUATERNION + i]
            target = memory[at.OUT_QUATERNION : at.OUT_QUATERNION + 4]
            attitude_to_rates(q, target, setpoint[at.YAW_RATE], gains, memory)
        if kind == at.KIND_RATES:
            for i in range(3):
                memory[at.OUT_RATES + i] = setpoint[at.RATES + i]
        elif kind == at.KIND_ATTITUDE and setpoint[at.OVERRIDE_PERIODS] > 0.0:
            setpoint[at.OVERRIDE_PERIODS] -= 1.0
            memory[at.OUT_THRUST] = setpoint[at.OVERRIDE_THRUST]
            for i in range(3):
                memory[at.OUT_RATES + i] = setpoint[at.OVERRIDE_RATES + i]
    if kind == at.KIND_ACTUATORS:
        for i in range(3):
            memory[at.OUT_TORQUE + i] = min(max(setpoint[at.ACTUATORS + i], -1.0), 1.0)
            memory[at.RATE_INTEGRAL + i] = 0.0
        memory[at.OUT_THRUST] = setpoint[at.ACTUATORS + 3]
    else:
        rates_to_torque(gains, memory, dt_s, integrate)
    mix(
        memory[at.OUT_TORQUE],
        memory[at.OUT_TORQUE + 1],
        memory[at.OUT_TORQUE + 2],
        min(max(memory[at.OUT_THRUST], 0.0), 1.0),
        mixer,
        columns,
        motors,
        scratch,
        memory[at.SATURATED_HIGH : at.SATURATED_HIGH + 3],
        memory[at.SATURATED_LOW : at.SATURATED_LOW + 3],
    )
    factor = gains[at.THRUST_MODEL_FACTOR]
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
        advance(
            state, memory[at.OUT_MOTORS : at.OUT_MOTORS + 8], vehicle, environment, physics_dt, physics_steps
        )
        advance_estimate(estimate, estimator_memory, delay_line, estimator_settings, estimator_random, state)
