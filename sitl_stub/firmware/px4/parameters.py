"""PX4's parameter table: names, order, types and stock values are those of the capture (`parameters.json`)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from sitl_stub.firmware.common.parameters import ParameterTable
from sitl_stub.firmware.px4.mixing import full_torque_newton_metre, mixer_matrix
from sitl_stub.physics.vehicle import VehicleParameters, load_vehicle

CAPTURE_VEHICLE = "px4_sih"


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
    for name, scale in zip(("ROLL", "PITCH", "YAW"), known / own, strict=True):
        values[f"MC_{name}RATE_K"] = round(float(scale), 4)
    arms = np.abs(vehicle.rotor_position_frd)
    lag = vehicle.rotor_lag_rad_s
    thrust = float(vehicle.max_thrust_newton.mean())
    values.update(
        {
            "MPC_THR_HOVER": round(vehicle.hover_command, 4),
            "THR_MDL_FAC": vehicle.thrust_curve,
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
