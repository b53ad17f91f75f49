"""Puts an ArduCopter together: vehicle, parameters that fit it, estimator, seed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sitl_stub.firmware.ardupilot import ArduPilot
from sitl_stub.firmware.ardupilot_core import ArduPilotCore
from sitl_stub.firmware.ardupilot_mixing import motor_factors
from sitl_stub.firmware.ardupilot_parameters import ArduPilotParameters, stock_parameters
from sitl_stub.physics.vehicle import VehicleParameters, load_vehicle

CAPTURE_VEHICLE = "arducopter"
FRAME_CLASS_QUAD = 1
FRAME_CLASS_OF_ROTORS = {4: FRAME_CLASS_QUAD, 6: 2, 8: 3}
"""FRAME_CLASS hexa and octa."""
READY_AFTER_S = 42.0
"""When the capture's estimator first had a position."""


def angular_acceleration_per_torque(vehicle: VehicleParameters) -> np.ndarray:
    """Angular acceleration (3,) in rad/s² for an output of one about each FRD axis, thrust linear."""
    wrench = vehicle.allocation_frd()[1:] @ (motor_factors(vehicle) * vehicle.max_thrust_newton[:, None])
    acceleration: np.ndarray = np.diag(wrench) / vehicle.inertia_kg_m2
    return acceleration


def ardupilot_parameters(vehicle: VehicleParameters) -> ArduPilotParameters:
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


def build_ardupilot(
    vehicle: VehicleParameters | str = CAPTURE_VEHICLE,
    estimator: str = "mocap",
    seed: int = 0,
    wind_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gust_speed_m_s: float = 0.0,
    parameters: Mapping[str, float] | None = None,
    ready_after_s: float | None = None,
) -> ArduPilot:
    """An ArduCopter ready to be stepped. `parameters` override single ones; `ready_after_s` shortens its start.

    Raises VehicleError and ParameterError.
    """
    body = load_vehicle(vehicle) if isinstance(vehicle, str) else vehicle
    table = ardupilot_parameters(body)
    for name, value in (parameters or {}).items():
        table.set(name, value)
    core = ArduPilotCore(body, table, estimator, seed, wind_ned_m_s, gust_speed_m_s)
    return ArduPilot(core, table, READY_AFTER_S if ready_after_s is None else ready_after_s)
