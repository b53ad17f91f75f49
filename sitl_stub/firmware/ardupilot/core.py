"""One vehicle under ArduCopter's controllers, as an object: packed arrays, the compiled loop and simulated time.

No MAVLink and no modes here: whoever holds an `ArduPilotCore` writes `setpoint` (see `layout.py`) and calls
`advance_to`. The loops run at 400 Hz (SCHED_LOOP_RATE), the physics at 1200 Hz.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot import loop
from sitl_stub.firmware.ardupilot.mixing import motor_factors
from sitl_stub.firmware.common.vehicle_core import VehicleCore
from sitl_stub.physics import estimator as belief
from sitl_stub.physics.vehicle import VehicleParameters

FloatArray = NDArray[np.float64]

CONTROL_PERIOD_US = 2500
PHYSICS_STEPS = 3
POSITION_GIVEN_UP_S = 7.0
"""How long EKF3 vouches for a position that nothing measures (posRetryTimeNoVel_ms)."""


class ArduPilotCore(VehicleCore):
    """Vehicle, estimator and compiled controllers. All arrays are public and may be changed between calls."""

    def __init__(
        self,
        vehicle: VehicleParameters,
        parameters: Mapping[str, float],
        estimator: str = "mocap",
        seed: int = 0,
        wind_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
        gust_speed_m_s: float = 0.0,
    ) -> None:
        super().__init__(vehicle, CONTROL_PERIOD_US, estimator, seed, wind_ned_m_s, gust_speed_m_s)
        self.estimator.arrays.settings[belief.SET_TIMEOUT] = POSITION_GIVEN_UP_S
        self.setpoint = np.zeros(at.SETPOINT_SIZE)
        self.memory = np.zeros(at.MEMORY_SIZE)
        self.reset_controllers()
        self.factors = motor_factors(vehicle)
        self.gains = at.gains_from_parameters(parameters)
        self._place = np.zeros(3)
        self._speed = np.zeros(3)

    def reset_controllers(self) -> None:
        """Setpoints and memory of the controllers as at boot: rotors at rest."""
        self.setpoint[:] = 0.0
        self.setpoint[at.QUATERNION] = 1.0
        self.memory[:] = 0.0
        self.memory[at.TARGET] = 1.0
        self.memory[at.RPY_MIX] = 0.1

    def use_parameters(self, parameters: Mapping[str, float]) -> None:
        """Take changed controller parameters into the running loops."""
        self.gains[:] = at.gains_from_parameters(parameters)

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
            self._place,
            self._speed,
            self.setpoint,
            self.gains,
            self.memory,
            self.factors,
            self.parameters_packed,
            self.environment,
            CONTROL_PERIOD_US * 1e-6,
            PHYSICS_STEPS,
        )

    @property
    def spool_state(self) -> float:
        """How far the motors are: at.STATE_SHUT_DOWN ... STATE_SPOOLING_DOWN."""
        return float(self.memory[at.SPOOL_STATE])

    @property
    def target_quaternion(self) -> FloatArray:
        """Attitude target (4,)."""
        return self.memory[at.TARGET : at.TARGET + 4]

    @property
    def target_rates(self) -> FloatArray:
        """Rate of the attitude target (3,), rad/s."""
        return self.memory[at.TARGET_RATES : at.TARGET_RATES + 3]
