"""PX4's battery warnings (BAT_LOW_THR, BAT_CRIT_THR, BAT_EMERGEN_THR) and what follows them (COM_LOW_BAT_ACT).

As in `batteryCheck.cpp` and `failsafe/failsafe.cpp`: a warning does not ease while armed, and one that was there at arming
forces nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

from sitl_stub.firmware.px4.modes import Mode


class BatteryLevel(IntEnum):
    """How empty it is; the value is BATTERY_STATUS.charge_state."""

    OK = 1
    LOW = 2
    """A warning."""
    CRITICAL = 3
    """Return or land, if asked for; no arming."""
    EMERGENCY = 4
    """Land, if asked for."""

    @property
    def cause(self) -> int:
        """failsafe_cause_t."""
        return int(self) + 1


RETURN, LAND_AT_CRITICAL, RETURN_THEN_LAND = 1, 2, 3
"""COM_LOW_BAT_ACT; 0 warns."""


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
    if level < BatteryLevel.CRITICAL:
        return None
    if action == RETURN_THEN_LAND:
        return Mode.RTL if level is BatteryLevel.CRITICAL else Mode.LAND
    return {RETURN: Mode.RTL, LAND_AT_CRITICAL: Mode.LAND}.get(action)


class BatteryWatch:
    """What is known of one vehicle's battery."""

    def __init__(self) -> None:
        self.level = BatteryLevel.OK
        """As it is now (BATTERY_STATUS)."""
        self.warning = BatteryLevel.OK
        """The worst since arming."""
        self.disregarded = BatteryLevel.OK
        """There at arming, or when somebody chose a mode: only a worse one forces anything."""

    def look(self, remaining: float, parameters: Mapping[str, float], armed: bool) -> bool:
        """Take the charge that is left; whether the warning has become worse in the air."""
        self.level = battery_level(remaining, parameters)
        worse = armed and self.level > self.warning
        self.warning = max(self.warning, self.level) if armed else self.level
        return worse

    def accept(self) -> None:
        """Armed, or a mode chosen, with the battery as it is."""
        self.disregarded = self.warning

    def forced(self, parameters: Mapping[str, float]) -> Mode | None:
        """The mode that the battery forces now, or None."""
        return None if self.warning <= self.disregarded else battery_mode(self.warning, parameters)
