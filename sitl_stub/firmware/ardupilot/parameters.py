"""ArduCopter's parameter table: every value travels as a float, whatever its type, and is cast as C does.

Names, order, types and stock values are those of the capture (`parameters.json`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sitl_stub.firmware.ardupilot.mixing import motor_factors
from sitl_stub.firmware.common.parameters import REAL32, ParameterError, ParameterTable
from sitl_stub.physics.vehicle import VehicleParameters, load_vehicle

INT8, INT16, INT32 = 2, 4, 6
KINDS = {"b": INT8, "h": INT16, "i": INT32, "f": REAL32}
"""Letter in the data file to MAV_PARAM_TYPE."""
BITS = {INT8: 8, INT16: 16, INT32: 32}
CAPTURE_VEHICLE = "arducopter"
FRAME_CLASS_QUAD = 1
FRAME_CLASS_OF_ROTORS = {4: FRAME_CLASS_QUAD, 6: 2, 8: 3}
"""FRAME_CLASS hexa and octa."""
ROUNDING = 0.01
"""What ArduPilot adds before it cuts the fraction off."""


class ArduPilotParameters(ParameterTable):
    """Parameters in the order of their indices, each with its own width."""

    def __init__(self, values: Mapping[str, float], kinds: Mapping[str, int]) -> None:
        super().__init__(values)
        self._kinds = dict(kinds)

    def kind(self, name: str) -> int:
        """MAV_PARAM_TYPE of a parameter."""
        return self._kinds[name]

    def set(self, name: str, value: float) -> None:
        """Change one: integers are cut after a nudge of 0.01 and held within their width.

        Raises ParameterError for an unknown name or a number that is none.
        """
        if name in self and self._kinds[name] in BITS and math.isfinite(value):
            half = 1 << (BITS[self._kinds[name]] - 1)
            cut = math.trunc(min(max(value + math.copysign(ROUNDING, value), -half), half - 1))
            self._values[name] = cut
            self.changes += 1
            return
        if name in self and not math.isfinite(value):
            raise ParameterError(f"parameter {name} cannot be {value}: give a finite number")
        super().set(name, value)


def stock_parameters() -> ArduPilotParameters:
    """The list of the capture with stock values."""
    content = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
    values: dict[str, float] = content["values"]
    kinds = {name: KINDS[letter] for name, letter in zip(values, content["kinds"], strict=True)}
    return ArduPilotParameters(values, kinds)


def angular_acceleration_per_torque(vehicle: VehicleParameters) -> np.ndarray:
    """Angular acceleration (3,) in rad/s² for an output of one about each FRD axis, thrust linear."""
    wrench = vehicle.allocation_frd()[1:] @ (motor_factors(vehicle) * vehicle.max_thrust_newton[:, None])
    acceleration: np.ndarray = np.diag(wrench) / vehicle.inertia_kg_m2
    return acceleration


def fitted_parameters(vehicle: VehicleParameters) -> ArduPilotParameters:
    """Stock parameters; for another vehicle than the capture's, hover thrust, thrust curve and rate gains that fit it.

    The rate PIDs are scaled so that angular acceleration per rate error is that of the capture's vehicle. The capture's own
    vehicle keeps stock values, MOT_THST_HOVER 0.39 included, which is not where it hovers (0.369).
    """
    table = stock_parameters()
    if vehicle.name == CAPTURE_VEHICLE:
        return table
    known = angular_acceleration_per_torque(load_vehicle(CAPTURE_VEHICLE))
    scales = known / angular_acceleration_per_torque(vehicle)
    if vehicle.owner.rate_crossover_rad_s is not None:
        agility = vehicle.owner.rate_crossover_rad_s / (table["ATC_RAT_RLL_P"] * float(known[0]))
        scales = scales * agility
        _tune(table, agility)
    for axis, scale in zip(("RLL", "PIT", "YAW"), scales, strict=True):
        for term in ("P", "I", "D"):
            name = f"ATC_RAT_{axis}_{term}"
            table.set(name, table[name] * float(scale))
        # room for the integral to hold the same angular acceleration
        table.set(f"ATC_RAT_{axis}_IMAX", min(table[f"ATC_RAT_{axis}_IMAX"] * max(float(scale), 1.0), 1.0))
    told = vehicle.owner.thrust_curve_told
    table.set("MOT_THST_EXPO", vehicle.thrust_curve if told is None else told)
    table.set("FRAME_CLASS", FRAME_CLASS_OF_ROTORS.get(vehicle.rotor_count, FRAME_CLASS_QUAD))
    ratio = (
        vehicle.owner.hover_told
        * vehicle.mass_kg
        * vehicle.gravity_m_s2
        / float(vehicle.max_thrust_newton.sum())
    )
    table.set("MOT_THST_HOVER", min(max(round(ratio, 4), 0.125), 0.6875))
    return table


def _tune(table: ArduPilotParameters, agility: float) -> None:
    """What an owner changes with the rate loops' crossover, `agility` times that of the capture's vehicle.

    Input shaping, attitude and position loops go along, since each has to stay slower than the one below it.
    """
    factors = {
        "ATC_ANG_RLL_P": max(agility, 0.5),
        "ATC_ANG_PIT_P": max(agility, 0.5),
        "ATC_ANG_YAW_P": max(agility, 0.5),
        "ATC_INPUT_TC": 1.0 / max(agility, 0.6),
        "ATC_ACCEL_R_MAX": max(agility, 0.3) ** 2,
        "ATC_ACCEL_P_MAX": max(agility, 0.3) ** 2,
        "ATC_ACCEL_Y_MAX": max(agility, 0.4) ** 2,
        "PSC_VELXY_P": max(agility, 0.7),
    }
    for name, factor in factors.items():
        table.set(name, table[name] * (min(factor, 1.0) if name != "ATC_INPUT_TC" else max(factor, 1.0)))
