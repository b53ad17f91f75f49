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

from sitl_stub.firmware.common.vehicle_core import VehicleCore
from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4 import loop
from sitl_stub.firmware.px4.mixing import full_torque_newton_metre, mixer_matrix, transposed
from sitl_stub.physics.vehicle import VehicleParameters

FloatArray = NDArray[np.float64]

CONTROL_PERIOD_US = 2000
PHYSICS_STEPS = 2
POSITION_LOOP_US = 10_000


class FlightCore(VehicleCore):
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
        super().__init__(vehicle, CONTROL_PERIOD_US, estimator, seed, wind_ned_m_s, gust_speed_m_s)
        self.setpoint = np.zeros(at.SETPOINT_SIZE)
        self.memory = np.zeros(at.MEMORY_SIZE)
        self.reset_controllers()
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

    def reset_controllers(self) -> None:
        """Setpoints and memory of the controllers as at boot: rotors at rest."""
        self.setpoint[:] = 0.0
        self.setpoint[at.QUATERNION] = 1.0
        self.memory[:] = 0.0
        self.memory[at.OUT_QUATERNION] = 1.0

    def use_parameters(self, parameters: Mapping[str, float]) -> None:
        """Take changed controller parameters into the running loops."""
        self.gains[:] = at.gains_from_parameters(parameters, self.torque_scale)

    def fly(self, periods: int) -> None:
        """Run the loops for so many control periods."""
        loop.fly(*(*self.fly_arguments(), periods))

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
