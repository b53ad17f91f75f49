"""A vehicle known only by how its autopilot responds: the profile's second-order attitude, rate lags and rotor lag.

For autopilots whose inner loops are not at hand in compiled form (ArduCopter). It moves the same packed state (NED/FRD)
as the stub's physics, so that the stub's estimator looks at either. No motors, no ground, no torque level.
"""

from __future__ import annotations

import math

import numpy as np

from companion.config.profile import VehicleProfile
from companion.control.compiled import compiled
from companion.control.rotation import quaternion_from_rotation_vector, quaternion_product
from companion.control.structs import Vector
from sitl_stub.firmware.px4.layout import KIND, KIND_ATTITUDE, QUATERNION, RATES, THRUST
from sitl_stub.physics import vehicle as body

GRAVITY, MASS, FULL_THRUST, ROTOR_LAG, DRAG, FREQUENCY, DAMPING, RATE_LAG = 0, 1, 2, 3, 4, 7, 10, 13
THRUST_NOW = 16
"""Where the lagged thrust (N) is kept: in the plant's own array, which is its memory too."""
SIZE = 17
STATE_POSITION, STATE_VELOCITY, STATE_QUATERNION, STATE_RATE = (
    body.POSITION,
    body.VELOCITY,
    body.QUATERNION,
    body.BODY_RATE,
)
FORCE = body.EXTERNAL_FORCE


def pack_lagged(profile: VehicleProfile, autopilot: str, lag_factor: float, thrust_factor: float) -> Vector:
    """The plant array (17,): every lag of the profile's response times `lag_factor`, thrust times `thrust_factor`."""
    response = profile.response(autopilot)
    axes = (response.tilt, response.tilt, response.yaw)
    plant = np.zeros(SIZE)
    plant[GRAVITY], plant[MASS] = profile.gravity_m_s2, profile.mass_kg
    weight = profile.mass_kg * profile.gravity_m_s2
    plant[FULL_THRUST] = thrust_factor * weight / profile.hover_thrust
    plant[ROTOR_LAG] = profile.rotors.lag_rad_s / lag_factor
    plant[DRAG : DRAG + 3] = profile.drag_kg_s
    plant[FREQUENCY : FREQUENCY + 3] = [axis.natural_frequency_rad_s / lag_factor for axis in axes]
    plant[DAMPING : DAMPING + 3] = [axis.damping for axis in axes]
    plant[RATE_LAG : RATE_LAG + 3] = [max(1e-3, lag * lag_factor) for lag in response.rate_lag_s]
    plant[THRUST_NOW] = weight
    return plant


@compiled
def advance_lagged(plant: Vector, state: Vector, setpoint: Vector, environment: Vector, dt: float) -> None:
    """Move `state` (the stub's layout, NED/FRD) and the thrust in `plant` by `dt` s under a stub setpoint array."""
    q = state[STATE_QUATERNION : STATE_QUATERNION + 4]
    rate = state[STATE_RATE : STATE_RATE + 3]
    settle = -math.expm1(-plant[ROTOR_LAG] * dt)
    plant[THRUST_NOW] += settle * (setpoint[THRUST] * plant[FULL_THRUST] - plant[THRUST_NOW])
    conjugate = np.array((q[0], -q[1], -q[2], -q[3]))
    gap = quaternion_product(conjugate, setpoint[QUATERNION : QUATERNION + 4])
    side = 2.0 if gap[0] >= 0.0 else -2.0
    turn = np.empty(3)
    for i in range(3):
        if setpoint[KIND] == KIND_ATTITUDE:
            frequency = plant[FREQUENCY + i]
            angular = frequency * frequency * side * gap[i + 1]
            angular -= 2.0 * plant[DAMPING + i] * frequency * rate[i]
        else:
            angular = (setpoint[RATES + i] - rate[i]) / plant[RATE_LAG + i]
        rate[i] += dt * angular
        turn[i] = dt * rate[i]
    q[:] = quaternion_product(q, quaternion_from_rotation_vector(turn))
    down = np.array(
        (
            2.0 * (q[1] * q[3] + q[0] * q[2]),
            2.0 * (q[2] * q[3] - q[0] * q[1]),
            q[0] * q[0] - q[1] * q[1] - q[2] * q[2] + q[3] * q[3],
        )
    )
    for i in range(3):
        velocity = state[STATE_VELOCITY + i]
        force = environment[FORCE + i] - plant[DRAG + i] * velocity - plant[THRUST_NOW] * down[i]
        acceleration = force / plant[MASS] + (plant[GRAVITY] if i == 2 else 0.0)
        state[STATE_POSITION + i] += dt * (velocity + 0.5 * dt * acceleration)
        state[STATE_VELOCITY + i] = velocity + dt * acceleration
