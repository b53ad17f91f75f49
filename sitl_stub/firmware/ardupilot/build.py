"""Puts an ArduCopter together: vehicle, parameters that fit it, estimator, seed."""

from __future__ import annotations

from collections.abc import Mapping

from sitl_stub.firmware.ardupilot.autopilot import ArduPilot
from sitl_stub.firmware.ardupilot.core import ArduPilotCore
from sitl_stub.firmware.ardupilot.parameters import CAPTURE_VEHICLE, fitted_parameters
from sitl_stub.physics.vehicle import VehicleParameters, load_vehicle

READY_AFTER_S = 42.0
"""When the capture's estimator first had a position."""


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
    table = fitted_parameters(body)
    for name, value in (parameters or {}).items():
        table.set(name, value)
    core = ArduPilotCore(body, table, estimator, seed, wind_ned_m_s, gust_speed_m_s)
    return ArduPilot(core, table, READY_AFTER_S if ready_after_s is None else ready_after_s)
