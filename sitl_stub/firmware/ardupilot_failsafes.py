"""ArduCopter's failsafes of the estimator (FS_EKF_ACTION) and the battery (BATT_LOW_VOLT, BATT_FS_LOW_ACT, ... CRT ...).

Texts as in ArduCopter's `ekf_check.cpp` and `AP_BattMonitor.cpp` (read, not captured).
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

from sitl_stub.firmware.ardupilot_modes import Mode
from sitl_stub.physics import vehicle as body

if TYPE_CHECKING:
    from sitl_stub.firmware.ardupilot import ArduPilot

CRITICAL, WARNING = 2, 4
"""MAV_SEVERITY."""
EKF_BAD_US = 1_000_000
"""Ten checks at 10 Hz."""
EKF_ALT_HOLD, EKF_LAND_ALWAYS = 2, 3
"""FS_EKF_ACTION; 1 lands from modes that need a position."""
BATTERY_MODES = {1: Mode.LAND, 2: Mode.RTL, 3: Mode.RTL, 4: Mode.LAND, 6: Mode.RTL, 7: Mode.BRAKE}
"""BATT_FS_..._ACT; there is no path to go back on and no mission, so the smart ways are the plain ones."""
BATTERY_TERMINATE = 5


class BatteryLevel(IntEnum):
    """How empty it is; the value is BATTERY_STATUS.charge_state."""

    OK = 1
    LOW = 2
    CRITICAL = 3


class Failsafes:
    """Both failsafes of one vehicle."""

    def __init__(self, autopilot: ArduPilot) -> None:
        self.autopilot = autopilot
        self.battery = BatteryLevel.OK
        self._bad_since_us: int | None = None
        self._ekf_failed = False
        self._below_since_us: dict[BatteryLevel, int] = {}

    def update(self) -> None:
        """A hundred times a second."""
        self._check_estimator()
        self._check_battery()

    def _check_estimator(self) -> None:
        a = self.autopilot
        if not a.armed or a.position_known:
            self._bad_since_us = None
            self._ekf_failed = False
            return
        if self._bad_since_us is None:
            self._bad_since_us = a.time_us
        if self._ekf_failed or a.time_us - self._bad_since_us < EKF_BAD_US:
            return
        self._ekf_failed = True
        a.say(CRITICAL, "EKF variance")
        action = int(a.parameters["FS_EKF_ACTION"])
        if action == 0 or not (a.mode.value.needs_position or action == EKF_LAND_ALWAYS):
            return
        mode = Mode.ALT_HOLD if action == EKF_ALT_HOLD else Mode.LAND
        if a.request_mode(mode.number):
            a.say(CRITICAL, f"EKF Failsafe: changed to {mode.name} Mode")

    def _check_battery(self) -> None:
        a = self.autopilot
        p = a.parameters
        volts = float(a.core.state[body.BATTERY_VOLTAGE])
        for level, name in ((BatteryLevel.LOW, "LOW"), (BatteryLevel.CRITICAL, "CRT")):
            if not a.armed or volts >= p[f"BATT_{name}_VOLT"]:
                self._below_since_us.pop(level, None)
                continue
            since = self._below_since_us.setdefault(level, a.time_us)
            if self.battery < level and a.time_us - since >= p["BATT_LOW_TIMER"] * 1e6:
                self.battery = level
                self._act(level, int(p[f"BATT_FS_{name}_ACT"]), volts)
        if not a.armed:
            self.battery = BatteryLevel.OK

    def _act(self, level: BatteryLevel, action: int, volts: float) -> None:
        a = self.autopilot
        used = float(a.core.state[body.CHARGE_USED]) / 3.6
        a.say(WARNING, f"Battery 1 is {level.name.lower()} {volts:.2f}V used {used:.0f} mAh")
        if action == BATTERY_TERMINATE:
            a.disarm()
        elif action in BATTERY_MODES:
            a.say(WARNING, "Battery Failsafe")
            wanted = BATTERY_MODES[action]
            if not a.request_mode(wanted.number):
                a.request_mode(Mode.LAND.number)
