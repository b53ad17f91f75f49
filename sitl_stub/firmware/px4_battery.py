"""PX4's battery warnings (BAT_LOW_THR, BAT_CRIT_THR, BAT_EMERGEN_THR) and what follows them (COM_LOW_BAT_ACT).

PX4 holds for COM_FAIL_ACT_T before it acts when a pilot could step in; here it acts at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

from sitl_stub.firmware.px4_modes import Mode


class BatteryLevel(IntEnum):
    """How empty it is; the value is BATTERY_STATUS.charge_state."""

    OK = 1
    LOW = 2
    """A warning."""
    CRITICAL = 3
    """Return or land, if asked for."""
    EMERGENCY = 4
    """Land, if asked for."""


LAND_AT_CRITICAL, RETURN_THEN_LAND = 2, 3
"""COM_LOW_BAT_ACT."""


def battery_level(remaining: float, parameters: Mapping[str, float]) -> BatteryLevel:
    """Level at a share of charge `remaining`."""
    for level, name in (
        (BatteryLevel.EMERGENCY, "BAT_EMERGEN_THR"),
        (BatteryLevel.CRITICAL, "BAT_CRIT_THR"),
        (BatteryLevel.LOW, "BAT_LOW_THR"),
    ):
        if remaining < parameters[name]:
            return level
    return BatteryLevel.OK


def battery_mode(level: BatteryLevel, parameters: Mapping[str, float]) -> Mode | None:
    """The mode that level forces, or None."""
    action = int(parameters["COM_LOW_BAT_ACT"])
    if level is BatteryLevel.EMERGENCY and action in (LAND_AT_CRITICAL, RETURN_THEN_LAND):
        return Mode.LAND
    if level is BatteryLevel.CRITICAL:
        return {LAND_AT_CRITICAL: Mode.LAND, RETURN_THEN_LAND: Mode.RTL}.get(action)
    return None
