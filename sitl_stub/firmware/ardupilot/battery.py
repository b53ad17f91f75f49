"""ArduCopter's battery: how empty it is, and what stands against arming (BATT_LOW_VOLT, BATT_CRT_VOLT)."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum


class BatteryLevel(IntEnum):
    """How empty it is; the value is BATTERY_STATUS.charge_state."""

    OK = 1
    LOW = 2
    CRITICAL = 3


def voltage_refusals(volts: float, parameters: Mapping[str, float]) -> list[str]:
    """What a voltage that is too low now has against arming."""
    for name, words in (("LOW", "low"), ("CRT", "critical")):
        if 0.0 < volts < parameters[f"BATT_{name}_VOLT"]:
            return [f"Battery 1 {words} voltage failsafe"]
    return []
