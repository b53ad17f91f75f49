"""The compiled inner loop of ArduCopter: rates and motors first, then attitude and position for the next pass.

That order is ArduCopter's (its rate loop runs on the freshest gyro with the targets of the pass before). One call does many
control periods and allocates nothing. Layout of the arrays: `layout.py` and `physics/vehicle.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.attitude_control import (
    filter_gyro,
    rates_to_torque,
    relax,
    take_lean,
    take_quaternion,
    take_rates,
    take_thrust_direction,
)
from sitl_stub.firmware.ardupilot.mixing import give_throttle, mix, move_mix, spool
from sitl_stub.firmware.ardupilot.position_control import (
    advance_desired_ne,
    correct_ne,
    correct_up,
    shape_ne,
    shape_up,
    soften_ne,
    start_ne,
    start_up,
)
from sitl_stub.firmware.ardupilot.shaping import rotate
from sitl_stub.physics.compiled import compiled
from sitl_stub.physics.estimator import (
    EST_BODY_RATE,
    EST_POSITION,
    EST_QUATERNION,
    EST_SPECIFIC_FORCE,
    EST_VELOCITY,
    advance_estimate,
)
from sitl_stub.physics.noise import RandomState
from sitl_stub.physics.rigid_body import advance
from sitl_stub.physics.wind import advance_wind

FloatArray = NDArray[np.float64]

ONE_G = 9.80665


@compiled
def control(
    estimate: FloatArray,
    place: FloatArray,
    speed: FloatArray,
    setpoint: FloatArray,
    gains: FloatArray,
    memory: FloatArray,
    factors: FloatArray,
    dt_s: float,
) -> None:
    """One pass of ArduCopter's main loop: memory[at.OUT_MOTORS], then the targets for the next pass.

    `place` and `speed` (3,) are scratch: position and velocity north, east, up.
    """
    filter_gyro(estimate[EST_BODY_RATE : EST_BODY_RATE + 3], gains, memory, dt_s)
    move_mix(setpoint[at.THROTTLE_MIX], gains, memory, dt_s)
    rates_to_torque(gains, memory, dt_s)
    spool(setpoint[at.SPOOL], gains, memory, dt_s)
    mix(factors, gains, memory, dt_s)

    body = (
        estimate[EST_QUATERNION],
        estimate[EST_QUATERNION + 1],
        estimate[EST_QUATERNION + 2],
        estimate[EST_QUATERNION + 3],
    )
    force = rotate(
        body,
        (
            estimate[EST_SPECIFIC_FORCE],
            estimate[EST_SPECIFIC_FORCE + 1],
            estimate[EST_SPECIFIC_FORCE + 2],
        ),
    )
    memory[at.MEASURED_LIFT] = -force[2] - ONE_G
    for i in range(2):
        place[i] = estimate[EST_POSITION + i]
        speed[i] = estimate[EST_VELOCITY + i]
    place[2] = -estimate[EST_POSITION + 2]
    speed[2] = -estimate[EST_VELOCITY + 2]

    lateral = setpoint[at.LATERAL]
    if lateral == at.LATERAL_RELAX:
        memory[at.NE_ACTIVE] = 0.0
        relax(body, memory[at.SPOOL_STATE] > at.STATE_GROUND_IDLE, gains, memory, dt_s)
    elif lateral == at.LATERAL_QUATERNION:
        memory[at.NE_ACTIVE] = 0.0
        take_quaternion(body, setpoint, gains, memory, dt_s)
    elif lateral == at.LATERAL_RATES:
        memory[at.NE_ACTIVE] = 0.0
        take_rates(body, setpoint, gains, memory, dt_s)
    elif lateral == at.LATERAL_LEAN:
        memory[at.NE_ACTIVE] = 0.0
        take_lean(
            body, setpoint[at.LEAN], setpoint[at.LEAN + 1], setpoint[at.HEADING_RATE], gains, memory, dt_s
        )
    else:
        if memory[at.NE_ACTIVE] == 0.0:
            up = rotate(body, (0.0, 0.0, -1.0))
            scale = ONE_G / max(-up[2], 0.1)
            start_ne(place, speed, (up[0] * scale, up[1] * scale), gains, memory)
        if setpoint[at.SOFT_LANDING] > 0.0:
            soften_ne(place, memory, dt_s)
        advance_desired_ne(memory, dt_s)
        shape_ne(setpoint, gains, memory, dt_s)
        correct_ne(place, speed, setpoint, gains, memory, dt_s)
        take_thrust_direction(
            body,
            memory[at.TARGET_ACCELERATION],
            memory[at.TARGET_ACCELERATION + 1],
            setpoint,
            gains,
            memory,
            dt_s,
        )

    if setpoint[at.VERTICAL] == at.VERTICAL_THRUST:
        memory[at.UP_ACTIVE] = 0.0
        give_throttle(setpoint[at.THRUST], gains, memory, setpoint[at.THROTTLE_CUTOFF_HZ])
    else:
        if memory[at.UP_ACTIVE] == 0.0:
            start_up(place[2], speed[2], gains, memory)
        shape_up(setpoint, gains, memory, dt_s)
        correct_up(place[2], speed[2], setpoint, gains, memory, dt_s)


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
    place: FloatArray,
    speed: FloatArray,
    setpoint: FloatArray,
    gains: FloatArray,
    memory: FloatArray,
    factors: FloatArray,
    vehicle: FloatArray,
    environment: FloatArray,
    control_period_s: float,
    physics_steps: int,
    periods: int,
) -> None:
    """Advance everything in place by `periods` control periods of `control_period_s`, of `physics_steps` steps each.

    In each period: controllers on the last estimate, gusts, physics, then the estimate of the period's end.
    """
    physics_dt = control_period_s / physics_steps
    for _ in range(periods):
        control(estimate, place, speed, setpoint, gains, memory, factors, control_period_s)
        advance_wind(wind, wind_random, state, environment, control_period_s)
        advance(
            state, memory[at.OUT_MOTORS : at.OUT_MOTORS + 8], vehicle, environment, physics_dt, physics_steps
        )
        advance_estimate(estimate, estimator_memory, delay_line, estimator_settings, estimator_random, state)
