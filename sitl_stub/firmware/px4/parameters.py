"""PX4's parameter table: names, order, types and stock values are those of the capture (`parameters.json`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sitl_stub.firmware.common.mavlink_ids import VehicleType
from sitl_stub.firmware.common.parameters import ParameterTable
from sitl_stub.firmware.px4.mixing import full_torque_newton_metre, mixer_matrix
from sitl_stub.physics.vehicle import VehicleParameters, load_vehicle

CAPTURE_VEHICLE = "px4_sih"
TYPE_OF_ROTORS = {4: VehicleType.QUADROTOR, 6: VehicleType.HEXAROTOR, 8: VehicleType.OCTOROTOR}


def stock_parameters() -> ParameterTable:
    """The list of the capture with stock values."""
    return ParameterTable(json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8")))


def fitted_parameters(vehicle: VehicleParameters) -> ParameterTable:
    """Parameters for `vehicle`: those of the capture, with hover thrust, SIH's numbers and rate gains fitted to it.

    The rate loops' K (MC_ROLLRATE_K ...) is scaled so that angular acceleration per rate error is that of the capture's
    vehicle: step responses are then alike whatever the vehicle. The capture's own vehicle is left as it is.
    """
    table = stock_parameters()
    if vehicle.name == CAPTURE_VEHICLE:
        return table
    values = dict(table)
    reference = load_vehicle(CAPTURE_VEHICLE)
    own = full_torque_newton_metre(vehicle, mixer_matrix(vehicle)) / vehicle.inertia_kg_m2
    known = full_torque_newton_metre(reference, mixer_matrix(reference)) / reference.inertia_kg_m2
    agility = 1.0
    if vehicle.owner.rate_crossover_rad_s is not None:
        agility = vehicle.owner.rate_crossover_rad_s / float(values["MC_ROLLRATE_P"] * known[0])
        values.update(_tuned(values, agility))
    for name, scale in zip(("ROLL", "PITCH", "YAW"), agility * known / own, strict=True):
        values[f"MC_{name}RATE_K"] = round(float(scale), 4)
    arms = np.abs(vehicle.rotor_position_frd)
    lag = vehicle.rotor_lag_rad_s
    thrust = float(vehicle.max_thrust_newton.mean())
    values.update(
        {
            "MPC_THR_HOVER": round(min(max(vehicle.owner.hover_told * _hover(vehicle), 0.1), 0.8), 4),
            "THR_MDL_FAC": told_curve(vehicle),
            "MAV_TYPE": int(TYPE_OF_ROTORS.get(vehicle.rotor_count, VehicleType.QUADROTOR)),
            "SIH_MASS": vehicle.mass_kg,
            "SIH_IXX": float(vehicle.inertia_kg_m2[0]),
            "SIH_IYY": float(vehicle.inertia_kg_m2[1]),
            "SIH_IZZ": float(vehicle.inertia_kg_m2[2]),
            "SIH_T_MAX": thrust,
            "SIH_Q_MAX": thrust * vehicle.torque_per_thrust_m,
            "SIH_L_ROLL": float(arms[:, 1].max()),
            "SIH_L_PITCH": float(arms[:, 0].max()),
            "SIH_T_TAU": 1.0 / lag if lag > 0 else 0.0,
            "SIH_KDV": float(vehicle.linear_drag_kg_s.mean()),
            "SIH_KDW": float(vehicle.angular_drag_kg_m2_s.mean()),
            "CA_ROTOR_COUNT": vehicle.rotor_count,
            "BAT1_N_CELLS": vehicle.battery_cells,
        }
    )
    for index in range(vehicle.rotor_count):
        values[f"CA_ROTOR{index}_PX"] = float(vehicle.rotor_position_frd[index, 0])
        values[f"CA_ROTOR{index}_PY"] = float(vehicle.rotor_position_frd[index, 1])
        values[f"CA_ROTOR{index}_KM"] = float(vehicle.rotor_spin[index]) * 0.05
    return ParameterTable(values)


def told_curve(vehicle: VehicleParameters) -> float:
    """The thrust curve k that the owner put into the autopilot's parameters."""
    told = vehicle.owner.thrust_curve_told
    return vehicle.thrust_curve if told is None else told


def _hover(vehicle: VehicleParameters) -> float:
    """Normalised thrust in hover as PX4's parameters count it: the motor signal, and THR_MDL_FAC undoes the curve."""
    if vehicle.owner.thrust_curve_told is None:
        return vehicle.hover_command
    k, signal = vehicle.owner.thrust_curve_told, vehicle.hover_command
    return (1.0 - k) * signal + k * signal**2


def _tuned(values: Mapping[str, float], agility: float) -> dict[str, float]:
    """What an owner changes with the rate loops' crossover, `agility` times that of the capture's vehicle.

    The attitude and position loops go along, since each has to stay slower than the one below it.
    """
    slow = min(agility, 1.0)
    return {
        "MC_ROLL_P": round(values["MC_ROLL_P"] * min(agility, 1.8), 2),
        "MC_PITCH_P": round(values["MC_PITCH_P"] * min(agility, 1.8), 2),
        "MC_YAW_P": round(values["MC_YAW_P"] * min(agility, 1.3), 2),
        "MC_ROLLRATE_MAX": round(values["MC_ROLLRATE_MAX"] * max(slow, 0.5)),
        "MC_PITCHRATE_MAX": round(values["MC_PITCHRATE_MAX"] * max(slow, 0.5)),
        "MC_YAWRATE_MAX": round(values["MC_YAWRATE_MAX"] * max(slow, 0.4)),
        "MPC_XY_VEL_P_ACC": round(values["MPC_XY_VEL_P_ACC"] * max(min(agility, 1.2), 0.6), 2),
        "MPC_XY_P": round(values["MPC_XY_P"] * max(slow, 0.7), 2),
    }
