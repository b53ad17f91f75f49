"""What every firmware's core shares: a vehicle with its physics, estimator, gusts and simulated time.

No controllers here: a firmware's core adds them and advances everything in one compiled loop. Time is whole
microseconds since boot; control runs every `control_period_us`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sitl_stub.physics import estimator as belief
from sitl_stub.physics import vehicle as body
from sitl_stub.physics.estimator import Estimator
from sitl_stub.physics.vehicle import VehicleParameters
from sitl_stub.physics.wind import Wind

FloatArray = NDArray[np.float64]


def euler_of(quaternion_wxyz: FloatArray) -> tuple[float, float, float]:
    """Roll, pitch and yaw (ZYX), rad, of an attitude (4,) body FRD to NED, as ATTITUDE has them."""
    w, x, y, z = quaternion_wxyz.tolist()
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


class VehicleCore:
    """Vehicle and estimator; subclasses bring controllers. All arrays are public and may be changed between calls."""

    def __init__(
        self,
        vehicle: VehicleParameters,
        control_period_us: int,
        estimator: str = "mocap",
        seed: int = 0,
        wind_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
        gust_speed_m_s: float = 0.0,
    ) -> None:
        self.vehicle = vehicle
        self.control_period_us = control_period_us
        self.parameters_packed = vehicle.packed()
        self.state = body.initial_state(vehicle)
        self.environment = body.calm_environment(vehicle)
        self.estimator = Estimator(estimator, seed, control_period_us * 1e-6)
        self.estimate = self.estimator.arrays.estimate
        self.wind = Wind(wind_ned_m_s, gust_speed_m_s, seed)
        self.time_us = 0
        belief.advance_estimate(*self.estimator.arguments, self.state)

    def use_parameters(self, parameters: Mapping[str, float]) -> None:
        """Take changed controller parameters into the running loops."""
        raise NotImplementedError

    def reset_controllers(self) -> None:
        """Setpoints and memory of the controllers as at boot: rotors at rest."""
        raise NotImplementedError

    def advance_to(self, time_us: int) -> None:
        """Run the loops up to `time_us` (rounded down to whole control periods; never back)."""
        periods = (time_us - self.time_us) // self.control_period_us
        if periods > 0:
            self.fly(periods)
            self.time_us += periods * self.control_period_us

    def fly(self, periods: int) -> None:
        """Run the loops for so many control periods."""
        raise NotImplementedError

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
        return euler_of(self.quaternion)[2]

    @property
    def euler_rad(self) -> tuple[float, float, float]:
        """Estimated roll, pitch and yaw, body FRD to NED, as ATTITUDE has them."""
        return euler_of(self.quaternion)

    @property
    def attitude_valid(self) -> bool:
        """Whether the filter vouches for its attitude."""
        return bool(self.estimate[belief.EST_ATTITUDE_VALID] > 0.0)

    @property
    def resets(self) -> int:
        """How often position or heading have jumped (ODOMETRY.reset_counter)."""
        return (
            int(self.estimate[belief.EST_POSITION_RESETS] + self.estimate[belief.EST_HEADING_RESETS]) & 0xFF
        )

    @property
    def clearance_m(self) -> float:
        """How far the feet are from the ground, in truth."""
        down = float(self.environment[body.GROUND_DOWN] - self.state[body.POSITION + 2])
        return down - self.vehicle.foot_height_m

    @property
    def position_aided(self) -> bool:
        """Whether the filter gets measurements of position (GPS, motion capture)."""
        return bool(self.estimator.arrays.memory[belief.AIDED] > 0.0)

    @property
    def position_valid(self) -> bool:
        """Whether the filter vouches for position and velocity."""
        return bool(self.estimate[belief.EST_POSITION_VALID] > 0.0)
