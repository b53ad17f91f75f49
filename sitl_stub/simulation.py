"""The vehicle with PX4's inner loops inside this process: no sockets, no modes, thousands of flights a minute.

    simulation = Simulation(vehicle="qball2", seed=3)
    simulation.hover_at((0.0, 0.0, -1.0))
    for _ in range(1000):
        simulation.set_attitude_target(quaternion, thrust)
        simulation.advance(0.01)
        print(simulation.estimate.position_ned, simulation.truth.position_ned)

Same loops, physics, estimator, seeds and bits as behind the sockets. For a search in compiled code take
`sitl_stub.firmware.px4.loop.fly` and `simulation.fly_arguments()`: a function of yours, compiled with numba, writes the
setpoint array (`firmware/px4/layout.py`), calls `fly(*arguments, periods)` and reads estimate and state. NED/FRD, SI.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.build import VERSIONS
from sitl_stub.firmware.px4.core import CONTROL_PERIOD_US, FlightCore
from sitl_stub.firmware.px4.parameters import fitted_parameters
from sitl_stub.physics import estimator as belief
from sitl_stub.physics import vehicle as body
from sitl_stub.physics.estimator import Estimate
from sitl_stub.physics.vehicle import VehicleParameters, load_vehicle

FloatArray = NDArray[np.float64]

CONTROL_PERIOD_S = CONTROL_PERIOD_US * 1e-6
"""Period of the attitude and rate loops, s. `fly` advances whole periods."""


class Truth:
    """Named view of the true state: reading always gives the newest values."""

    def __init__(self, state: FloatArray) -> None:
        self.array = state

    @property
    def position_ned(self) -> FloatArray:
        """(3,) m, of the centre of mass."""
        return self.array[body.POSITION_NED]

    @property
    def velocity_ned(self) -> FloatArray:
        """(3,) m/s."""
        return self.array[body.VELOCITY_NED]

    @property
    def quaternion_wxyz(self) -> FloatArray:
        """(4,) body FRD to NED."""
        return self.array[body.QUATERNION_WXYZ]

    @property
    def body_rate_frd(self) -> FloatArray:
        """(3,) rad/s."""
        return self.array[body.BODY_RATE_FRD]


class Simulation:
    """One vehicle under PX4's attitude and rate loops.

    `vehicle` is a name, a TOML path or `VehicleParameters`; `parameters` override single PX4 parameters. Raises
    VehicleError, ParameterError, KeyError (unknown firmware).
    """

    def __init__(
        self,
        firmware: str = "px4",
        vehicle: VehicleParameters | str = "qball2",
        estimator: str = "mocap",
        seed: int = 0,
        wind_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
        gust_speed_m_s: float = 0.0,
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        self.vehicle = load_vehicle(vehicle) if isinstance(vehicle, str) else vehicle
        table = fitted_parameters(self.vehicle)
        for name, value in (parameters or {}).items():
            table.set(name, value)
        self.parameters = table
        old_mixers = VERSIONS[firmware].old_mixers
        self.core = FlightCore(self.vehicle, table, estimator, seed, wind_ned_m_s, gust_speed_m_s, old_mixers)
        self.core.integrate = True
        self.estimate = Estimate(self.core.estimate)
        self.truth = Truth(self.core.state)

    @property
    def time_s(self) -> float:
        """Simulated time."""
        return self.core.time_us * 1e-6

    @property
    def full_torque_newton_metre(self) -> FloatArray:
        """Torque (3,) FRD for an actuator control of one; thrust is 1 ↔ the sum of `vehicle.max_thrust_newton`."""
        return self.core.full_torque

    def hover_at(
        self,
        position_ned: Sequence[float],
        yaw_rad: float = 0.0,
        velocity_ned: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Put the vehicle there, level, rotors at hover thrust, and let the estimator settle on it."""
        core = self.core
        battery = core.state[body.CHARGE_USED]
        core.state[:] = body.initial_state(self.vehicle, yaw_rad=yaw_rad)
        core.state[body.POSITION_NED] = position_ned
        core.state[body.VELOCITY_NED] = velocity_ned
        core.state[body.CHARGE_USED] = battery
        count = self.vehicle.rotor_count
        hover = self.vehicle.hover_command
        core.state[body.ROTOR_SIGNAL : body.ROTOR_SIGNAL + count] = hover
        core.state[body.ROTOR_THRUST : body.ROTOR_THRUST + count] = (
            self.vehicle.mass_kg * self.vehicle.gravity_m_s2 / count
        )
        arrays = core.estimator.arrays
        arrays.delay_line[:] = core.state[: body.RIGID_SIZE]
        belief.advance_estimate(*core.estimator.arguments, core.state)
        core.memory[:] = 0.0
        core.memory[at.OUT_QUATERNION] = 1.0
        level = np.array([math.cos(yaw_rad / 2), 0.0, 0.0, math.sin(yaw_rad / 2)])
        core.follow_attitude(level, hover)

    def set_attitude_target(
        self, quaternion_wxyz: FloatArray, thrust: float, yaw_rate_rad_s: float = 0.0
    ) -> None:
        """Attitude (4,) body FRD to NED, normalised thrust 0..1: SET_ATTITUDE_TARGET with mask 7."""
        self.core.follow_attitude(quaternion_wxyz, thrust, yaw_rate_rad_s)

    def set_body_rates(self, rates_frd_rad_s: FloatArray, thrust: float) -> None:
        """Body rates (3,) rad/s, normalised thrust 0..1: SET_ATTITUDE_TARGET with mask 128."""
        self.core.follow_rates(rates_frd_rad_s, thrust)

    def set_actuators(self, controls: FloatArray) -> None:
        """Roll, pitch, yaw torque −1..1 and thrust 0..1 (4,): SET_ACTUATOR_CONTROL_TARGET, group 0."""
        self.core.follow_actuators(controls)

    def advance(self, seconds: float) -> None:
        """Go on by `seconds`, a whole number of control periods (2 ms)."""
        self.core.advance_to(self.core.time_us + round(seconds * 1e6))

    def fly_arguments(self) -> tuple[Any, ...]:
        """All arguments of the compiled `fly` but the last (`periods`): arrays shared with this object, and constants.

        After calling `fly` oneself `time_s` is behind; nothing else depends on it.
        """
        return self.core.fly_arguments()
