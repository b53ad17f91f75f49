"""Which adapter for which MAV_AUTOPILOT of HEARTBEAT. A new autopilot is one file and one line here."""

from __future__ import annotations

from companion.autopilot.adapter import Adapter
from companion.autopilot.ardupilot import ArduPilot
from companion.autopilot.px4 import Px4
from companion.config.errors import UserError
from companion.mavlink.link import mav

ADAPTERS: dict[int, type[Adapter]] = {
    mav.MAV_AUTOPILOT_PX4: Px4,
    mav.MAV_AUTOPILOT_ARDUPILOTMEGA: ArduPilot,
}
_MULTIROTORS = {
    mav.MAV_TYPE_QUADROTOR,
    mav.MAV_TYPE_HEXAROTOR,
    mav.MAV_TYPE_OCTOROTOR,
    mav.MAV_TYPE_TRICOPTER,
    mav.MAV_TYPE_COAXIAL,
    mav.MAV_TYPE_DODECAROTOR,
    mav.MAV_TYPE_DECAROTOR,
    mav.MAV_TYPE_GENERIC_MULTIROTOR,
}


def adapter_for(autopilot: int, vehicle_type: int) -> Adapter:
    """The adapter for HEARTBEAT's `autopilot` and `type`.

    Raises:
        UserError: for an autopilot or a vehicle that this program cannot fly.
    """
    if autopilot not in ADAPTERS:
        raise UserError(
            f"HEARTBEAT says MAV_AUTOPILOT {autopilot}; this program flies PX4 (12) and ArduPilot (3)"
        )
    if vehicle_type not in _MULTIROTORS:
        raise UserError(f"HEARTBEAT says MAV_TYPE {vehicle_type}; this program flies multirotors only")
    return ADAPTERS[autopilot]()
