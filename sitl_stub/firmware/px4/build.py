"""Puts a PX4 together: vehicle, parameters that fit it, estimator, seed."""

from __future__ import annotations

from collections.abc import Mapping

from sitl_stub.firmware.px4.autopilot import Px4
from sitl_stub.firmware.px4.core import FlightCore
from sitl_stub.firmware.px4.parameters import fitted_parameters
from sitl_stub.firmware.px4.state import VERSION_1_13, VERSION_1_17
from sitl_stub.physics.vehicle import VehicleParameters, load_vehicle

VERSIONS = {version.name: version for version in (VERSION_1_17, VERSION_1_13)}
READY_AFTER_S = {"gps": 4.2}
"""The capture is ready 4.2 s after boot; without GPS to wait for, one second."""
READY_AFTER_OTHERS_S = 1.0


def build_px4(
    firmware: str = "px4",
    vehicle: VehicleParameters | str = "qball2",
    estimator: str = "mocap",
    seed: int = 0,
    wind_ned_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gust_speed_m_s: float = 0.0,
    parameters: Mapping[str, float] | None = None,
    ready_after_s: float | None = None,
) -> Px4:
    """A PX4 ready to be stepped. `parameters` override single ones, `ready_after_s` its start.

    Raises VehicleError, ParameterError, and KeyError for an unknown firmware.
    """
    version = VERSIONS[firmware]
    body = load_vehicle(vehicle) if isinstance(vehicle, str) else vehicle
    table = fitted_parameters(body)
    for name, value in (parameters or {}).items():
        table.set(name, value)
    core = FlightCore(
        body, table, estimator, seed, wind_ned_m_s, gust_speed_m_s, count_all_rotors=version.old_mixers
    )
    if ready_after_s is None:
        ready_after_s = READY_AFTER_S.get(estimator, READY_AFTER_OTHERS_S)
    return Px4(core, table, version, ready_after_s)
