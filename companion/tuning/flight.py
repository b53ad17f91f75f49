"""A flight to try gains on: profile, law, level and circumstances fixed, gains given anew each time.

flight = TrialFlight(profile, "px4", "dtlannc", "attitude", Scenario(seed=1), table)
outcome = flight.fly(gains)
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np

from companion.autopilot.thrust import LEAST_THRUST, mixer_of
from companion.config.errors import UserError
from companion.config.gains import ControllerGains
from companion.config.profile import LevelName, VehicleProfile
from companion.control.packing import INPUT, TERMS, memory_dtype
from companion.control.prediction import RING, ROW, pack_model
from companion.control.registry import build_law
from companion.control.structs import ControlLevel, Vector, VehicleState
from companion.tuning import closed_loop as loop
from companion.tuning.estimators import ESTIMATORS
from companion.tuning.lagged_plant import SIZE as LAGGED_SIZE
from companion.tuning.lagged_plant import THRUST_NOW, pack_lagged
from companion.tuning.reference_table import HEADING_RAD, PERIOD_S, ReferenceTable
from sitl_stub.physics.estimator import pack_settings
from sitl_stub.physics.noise import random_state
from sitl_stub.physics.vehicle import VehicleError, VehicleParameters, load_vehicle
from sitl_stub.simulation import Simulation

_fly_law: Any = numba.njit(error_model="numpy", nogil=True)(loop.fly_law)
"""Not through `compiled`: its argument is a law, itself compiled, for which numba's cache on disk has no lasting name.
It would never find what it wrote, and fails over entries of other processes. Seconds, once a process and law."""
STUB_VEHICLES = {"qball2": "qball2", "px4_sih": "px4_sih", "arducopter_sitl": "arducopter"}
"""Shipped profiles whose vehicle the stub has; what a profile does not tell of any other (feet, battery) is px4_sih's."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """The circumstances of one flight: what the gains have to bear."""

    name: str = "nominal"
    seed: int = 1  # of the network and of the noise
    mass_ratio: float | None = None  # m̂/m; None takes the profile's
    thrust_factor: float = 1.0  # real thrust over the one that the hover thrust parameter promises
    lag_factor: float = 1.0  # rotors (and inertia, or the lagged response) slower by this
    delay_s: float = 0.0  # more dead time than the nominal one; negative takes off what there is
    jitter_s: float = 0.0  # setpoints late by |normal| times this
    gust_newton: float = 0.0  # standard deviation of a coloured push on every axis
    gust_corner_rad_s: float = 1.0


@dataclass(frozen=True, slots=True)
class PlantChoice:
    """Which vehicle and autopilot stand behind the wire."""

    kind: str = "stub"  # stub (PX4's loops on the stub's physics) or lagged (the profile's response)
    estimator: str = "mocap"  # one of `estimators.ESTIMATORS`
    delay_s: float = 0.0  # nominal dead time from state to effect, beyond the plant's own
    parameters: dict[str, float] = field(default_factory=dict)  # PX4 parameters that differ


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a flight came to, RMS over the tracking unless said."""

    position_rms_m: Vector  # (3,) true, along the trajectory's own axes
    attitude_rms_rad: Vector  # (3,) η_d − η, η_d of the time it is for
    shake_rms_rad_s: Vector  # (3,) body rate beyond the reference's own
    command_rms: Vector  # (3,) change of the command per second: rad/s, rad/s² or N·m/s
    hold_rms_m: Vector  # (3,) true position error in the second half of the hold
    flown: float  # share of the flight; below 1 it was lost
    worst_error_m: float
    history: Vector  # (n, 20), see closed_loop.py; empty unless asked for


def stub_vehicle(profile: VehicleProfile) -> VehicleParameters:
    """The stub's vehicle with the profile's own numbers. Raises VehicleError where they make none."""
    rotors = profile.rotors
    count = len(rotors.layout)
    return dataclasses.replace(
        load_vehicle(STUB_VEHICLES.get(profile.name, "px4_sih")),
        name=profile.name,
        mass_kg=profile.mass_kg,
        inertia_kg_m2=np.array(profile.inertia_kg_m2),
        rotor_position_frd=np.column_stack((rotors.arms_m * (1.0, -1.0), np.zeros(count))),
        rotor_spin=-rotors.spins,  # the stub counts the propeller's turn, the profile its reaction
        max_thrust_newton=np.full(count, rotors.thrust_max_newton),
        torque_per_thrust_m=rotors.torque_per_newton_m,
        rotor_lag_rad_s=rotors.lag_rad_s,
        linear_drag_kg_s=np.array(profile.drag_kg_s),
    )


class TrialFlight:
    """See the module. Raises UserError for a vehicle the stub does not know or a level the plant cannot take."""

    def __init__(
        self,
        profile: VehicleProfile,
        autopilot: str,
        controller: str,
        level: LevelName,
        scenario: Scenario,
        table: ReferenceTable,
        plant: PlantChoice,
    ) -> None:
        if plant.kind == "lagged" and level == "actuator":
            raise UserError("the lagged plant has no torque level: tune actuator gains on the stub's vehicle")
        ratio = profile.mass_ratio if scenario.mass_ratio is None else scenario.mass_ratio
        self._profile = profile.model_copy(update={"mass_ratio": ratio})
        self._autopilot, self._controller, self._level = autopilot, controller, ControlLevel(level)
        self._scenario, self._table = scenario, table
        self._simulation = self._simulated(plant)
        core = self._simulation.core
        self._kept = [array.copy() for array in self._arrays()]
        self._setup = self._set_up(level, plant)
        self._model = pack_model(self._profile, self._level, autopilot)
        arms = np.column_stack((profile.rotors.arms_m, np.zeros(len(profile.rotors.layout))))
        self._unmix = np.linalg.pinv(mixer_of(arms, profile.rotors.spins))
        self._lagged = np.zeros(LAGGED_SIZE)
        self._lagged[THRUST_NOW] = profile.mass_kg * profile.gravity_m_s2
        if plant.kind == "lagged":
            self._lagged = pack_lagged(profile, autopilot, scenario.lag_factor, scenario.thrust_factor)
        self._core = core

    def _simulated(self, plant: PlantChoice) -> Simulation:
        profile, scenario = self._profile, self._scenario
        try:
            vehicle = stub_vehicle(profile)
        except VehicleError as error:
            raise UserError(
                f"profile {profile.name!r} is no vehicle that the stub can fly: {error}"
            ) from None
        if plant.kind == "stub":
            vehicle = dataclasses.replace(
                vehicle,
                rotor_lag_rad_s=vehicle.rotor_lag_rad_s / scenario.lag_factor,
                inertia_kg_m2=vehicle.inertia_kg_m2 * scenario.lag_factor,
                max_thrust_newton=vehicle.max_thrust_newton * scenario.thrust_factor,
                ground_effect=0.0,
            )
        firmware = "px4-1.13" if self._level is ControlLevel.ACTUATOR else "px4"
        preset = ESTIMATORS[plant.estimator]
        simulation = Simulation(firmware, vehicle, "mocap", scenario.seed, parameters=plant.parameters)
        simulation.core.estimator.arrays.settings[:] = pack_settings(preset, PERIOD_S)
        east, north, up = self._table.start.position_enu
        simulation.hover_at((float(north), float(east), -float(up)))
        return simulation

    def _arrays(self) -> tuple[Any, ...]:
        core = self._simulation.core
        return (
            core.state,
            *core.estimator.arguments,
            core.wind.wind,
            core.wind.random,
            core.setpoint,
            core.gains,
            core.memory,
            core.mixer,
            core.columns,
            core.scratch,
            core.parameters_packed,
            core.environment,
        )

    def _set_up(self, level: LevelName, plant: PlantChoice) -> Vector:
        profile, scenario = self._profile, self._scenario
        response = profile.response(self._autopilot)
        setup = np.zeros(loop.SETUP_SIZE)
        setup[loop.AHEAD_S] = response.dead_time(self._level)
        setup[loop.ESTIMATOR_S] = profile.estimator_delay_s
        setup[loop.FULL_NEWTON] = profile.mass_kg * profile.gravity_m_s2 / profile.hover_thrust
        if self._level is ControlLevel.ACTUATOR:
            full = profile.thrust_available_newton
        else:
            full = float(setup[loop.FULL_NEWTON])
        limits = profile.limits
        setup[loop.THRUST_MIN] = max(limits.thrust_min_ratio, LEAST_THRUST) * full
        setup[loop.THRUST_MAX] = limits.thrust_max_ratio * full
        setup[loop.ROTOR_MAX] = profile.rotors.thrust_max_newton
        nominal = plant.delay_s + (response.dead_time(self._level) if plant.kind == "lagged" else 0.0)
        setup[loop.DELAY_S] = max(0.0, nominal + scenario.delay_s)
        setup[loop.JITTER_S] = scenario.jitter_s
        setup[loop.GUST_NEWTON] = scenario.gust_newton
        setup[loop.GUST_CORNER] = scenario.gust_corner_rad_s
        setup[loop.PLANT] = loop.LAGGED if plant.kind == "lagged" else loop.STUB
        setup[loop.HOLD_TICKS], setup[loop.TRACK_FROM] = self._table.hold_ticks, self._table.track_from
        setup[loop.LEVEL] = ("attitude", "body_rate", "actuator").index(level)
        return setup

    def fly(self, gains: ControllerGains, with_history: bool = False) -> Outcome:
        """Fly with `gains`, always from the same start with the same noise."""
        law = build_law(
            self._controller,
            gains,
            self._profile,
            self._level,
            self._scenario.seed,
            autopilot=self._autopilot,
        )
        for array, kept in zip(self._arrays(), self._kept, strict=True):
            array[...] = kept
        memories = np.zeros(2, memory_dtype(law.hidden))
        start = self._table.start
        level = np.array([np.cos(HEADING_RAD / 2), 0.0, 0.0, np.sin(HEADING_RAD / 2)])
        still = VehicleState(0.0, start.position_enu, np.zeros(3), level, np.zeros(3))
        weight = self._profile.mass_kg * self._profile.gravity_m_s2
        memories[0] = law.take_over(law.initial_memory(), still, start, weight, level).packed[0]
        n = len(self._table.now)
        result = np.zeros(loop.RESULT_SIZE)
        history = np.zeros((n if with_history else 0, loop.HISTORY_SIZE))
        _fly_law(
            law.kernel,
            law.packed_parameters,
            memories,
            np.zeros(1, INPUT),
            np.zeros(1, TERMS),
            self._table.periods,
            self._table.now,
            self._table.ahead,
            self._setup,
            self._model,
            np.zeros((RING, ROW)),
            np.array([self._profile.mass_estimate_kg]),
            self._unmix,
            np.zeros((loop.QUEUE, loop.QUEUE_ROW)),
            self._lagged.copy(),
            random_state(self._scenario.seed, 7),
            *self._arrays(),
            self._simulation.fly_arguments()[-2],
            self._simulation.fly_arguments()[-3],
            result,
            history,
        )
        return self._outcome(result, history)

    @staticmethod
    def _outcome(result: Vector, history: Vector) -> Outcome:
        def rms(at: int) -> Vector:
            # trajectory x is north: ENU (x, y) = (−trajectory y, trajectory x)
            return np.sqrt(result[at : at + 3])

        return Outcome(
            position_rms_m=rms(loop.POSITION_SQUARES)[[1, 0, 2]],
            attitude_rms_rad=rms(loop.ATTITUDE_SQUARES),
            shake_rms_rad_s=rms(loop.SHAKE_SQUARES),
            command_rms=rms(loop.COMMAND_SQUARES),
            hold_rms_m=rms(loop.HOLD_SQUARES)[[1, 0, 2]],
            flown=float(result[loop.ENDED_AT]),
            worst_error_m=float(result[loop.WORST_ERROR]),
            history=history,
        )
