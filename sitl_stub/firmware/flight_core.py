"""One vehicle with its controllers, as an object: the packed arrays, the compiled loop and simulated time.

No MAVLink and no modes here: whoever holds a `FlightCore` writes `setpoint` and calls `advance_to`. Time is whole
microseconds since boot; the loops run at `CONTROL_PERIOD_US`, the physics at 1 kHz.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware import control_layout as at
from sitl_stub.firmware import flight_loop as loop
from sitl_stub.firmware.mixing import full_torque_newton_metre, mixer_matrix, transposed
from sitl_stub.physics import estimator as belief
from sitl_stub.physics import vehicle as body
from sitl_stub.physics.estimator import Estimator
from sitl_stub.physics.vehicle import VehicleParameters
from sitl_stub.physics.wind import Wind

FloatArray = NDArray[np.float64]

CONTROL_PERIOD_US = 2000
PHYSICS_STEPS = 2
POSITION_LOOP_US = 10_000


class FlightCore:
    """Vehicle, estimator and compiled controllers. All arrays are public and may be changed between calls."""

    def __init__(
        self,
        vehicle: VehicleParameters,
        parameters: Mapping[str, float],
        estimator: str = "mocap",
        seed: int = 0,
        wind_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
        gust_speed_m_s: float = 0.0,
        count_all_rotors: bool = False,
    ) -> None:
        self.vehicle = vehicle
        self.parameters_packed = vehicle.packed()
        self.state = body.initial_state(vehicle)
        self.environment = body.calm_environment(vehicle)
        self.estimator = Estimator(estimator, seed, CONTROL_PERIOD_US * 1e-6)
        self.estimate = self.estimator.arrays.estimate
        self.wind = Wind(wind_ned_m_s, gust_speed_m_s, seed)
        self.setpoint = np.zeros(at.SETPOINT_SIZE)
        self.setpoint[at.QUATERNION] = 1.0
        self.memory = np.zeros(at.MEMORY_SIZE)
        self.memory[at.OUT_QUATERNION] = 1.0
        self.mixer = mixer_matrix(vehicle, count_all_rotors)
        self.columns = transposed(self.mixer)
        self.full_torque = full_torque_newton_metre(vehicle, self.mixer)
        """Torque (3,) in N·m for normalised torque one."""
        self.torque_scale = np.ones(3)
        if count_all_rotors:
            present = full_torque_newton_metre(vehicle, mixer_matrix(vehicle))
            self.torque_scale = present / self.full_torque
        self.gains = at.gains_from_parameters(parameters, self.torque_scale)
        self.scratch = np.zeros(8)
        self.integrate = False
        self.time_us = 0
        belief.advance_estimate(*self.estimator.arguments, self.state)

    def use_parameters(self, parameters: Mapping[str, float]) -> None:
        """Take changed controller parameters into the running loops."""
        self.gains[:] = at.gains_from_parameters(parameters, self.torque_scale)

    def advance_to(self, time_us: int) -> None:
        """Run the loops up to `time_us` (rounded down to whole control periods; never back)."""
        periods = (time_us - self.time_us) // CONTROL_PERIOD_US
        if periods <= 0:
            return
        loop.fly(*(*self.fly_arguments(), periods))
        self.time_us += periods * CONTROL_PERIOD_US

    def fly_arguments(self) -> tuple[Any, ...]:
        """All arguments of the compiled `fly` but the last (`periods`): arrays shared with this object, and constants."""
        return (
            self.state,
            *self.estimator.arguments,
            self.wind.wind,
            self.wind.random,
            self.setpoint,
            self.gains,
            self.memory,
            self.mixer,
            self.columns,
            self.scratch,
            self.parameters_packed,
            self.environment,
            CONTROL_PERIOD_US * 1e-6,
            PHYSICS_STEPS,
            POSITION_LOOP_US // CONTROL_PERIOD_US,
            self.integrate,
        )

    # --- what the autopilot believes ---------------------------------------------------------------------------
    @property
    def position_ned(self) -> FloatArray:
        """Estimated position (3,), m."""
        return self.estimate[belief.EST_POSITION : belief.EST_POSITION + 3]

    @property
    def velocity_ned(self) -> FloatArray:
        """Estimated velocity (3,), m/s."""
        return self.estimate[belief.EST_VELOCITY : belief.EST_VELOCITY + 3]

    @property
    def quaternion(self) -> FloatArray:
        """Estimated attitude (4,), body FRD to NED."""
        return self.estimate[belief.EST_QUATERNION : belief.EST_QUATERNION + 4]

    @property
    def body_rate_frd(self) -> FloatArray:
        """Measured body rate (3,), rad/s."""
        return self.estimate[belief.EST_BODY_RATE : belief.EST_BODY_RATE + 3]

    @property
    def specific_force_frd(self) -> FloatArray:
        """Measured specific force (3,), m/s²."""
        return self.estimate[belief.EST_SPECIFIC_FORCE : belief.EST_SPECIFIC_FORCE + 3]

    @property
    def yaw(self) -> float:
        """Estimated heading, rad, clockwise from north."""
        w, x, y, z = (float(value) for value in self.quaternion)
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def position_valid(self) -> bool:
        """Whether the filter vouches for position and velocity."""
        return bool(self.estimate[belief.EST_POSITION_VALID] > 0.0)

    @property
    def motors(self) -> FloatArray:
        """Motor commands (8,), 0..1."""
        return self.memory[at.OUT_MOTORS : at.OUT_MOTORS + at.MOTORS_MOST]

    # --- setpoints ---------------------------------------------------------------------------------------------
    def idle(self) -> None:
        """Rotors at rest."""
        self.setpoint[at.KIND] = at.KIND_IDLE

    def follow_attitude(self, quaternion: FloatArray, thrust: float, yaw_rate_rad_s: float = 0.0) -> None:
        """Hold attitude (4,) body FRD to NED with normalised thrust 0..1."""
        s = self.setpoint
        s[at.QUATERNION : at.QUATERNION + 4] = quaternion
        s[at.THRUST] = thrust
        s[at.YAW_RATE] = yaw_rate_rad_s
        s[at.OVERRIDE_PERIODS] = 0.0
        s[at.KIND] = at.KIND_ATTITUDE

    def follow_rates(self, rates_frd_rad_s: FloatArray, thrust: float) -> None:
        """Hold body rates (3,) with normalised thrust 0..1."""
        s = self.setpoint
        s[at.RATES : at.RATES + 3] = rates_frd_rad_s
        s[at.THRUST] = thrust
        s[at.OVERRIDE_PERIODS] = 0.0
        s[at.KIND] = at.KIND_RATES

    def follow_actuators(self, controls: FloatArray) -> None:
        """Normalised roll, pitch, yaw torque and thrust (4,) straight to the mixer."""
        self.setpoint[at.ACTUATORS : at.ACTUATORS + 4] = controls
        self.setpoint[at.KIND] = at.KIND_ACTUATORS

    def follow_trajectory(
        self,
        position: tuple[float, float, float],
        velocity: tuple[float, float, float],
        acceleration: tuple[float, float, float],
        yaw: float,
        yaw_rate: float = 0.0,
    ) -> None:
        """Position, velocity, acceleration (NED) and heading; NaN where not controlled."""
        s = self.setpoint
        s[at.POSITION : at.POSITION + 3] = position
        s[at.VELOCITY : at.VELOCITY + 3] = velocity
        s[at.ACCELERATION : at.ACCELERATION + 3] = acceleration
        s[at.YAW] = yaw
        s[at.YAW_RATE] = 0.0 if math.isnan(yaw_rate) else yaw_rate
        s[at.OVERRIDE_PERIODS] = 0.0
        s[at.KIND] = at.KIND_TRAJECTORY
