"""ArduCopter's failsafes: of the estimator (FS_EKF_ACTION), the battery (BATT_...), the ground station (FS_GCS_ENABLE).

Texts, order and counting as in ArduCopter's `ekf_check.cpp`, `events.cpp` and `AP_BattMonitor.cpp` (read, not captured).
"""

from __future__ import annotations

from enum import IntEnum

from sitl_stub.firmware.ardupilot.battery import BatteryLevel
from sitl_stub.firmware.ardupilot.commander import Commander
from sitl_stub.firmware.ardupilot.flight_modes import FlightModes
from sitl_stub.firmware.ardupilot.modes import Mode
from sitl_stub.firmware.ardupilot.state import ArduPilotState
from sitl_stub.firmware.ardupilot.voice import ArduPilotVoice
from sitl_stub.firmware.common.mavlink_ids import Severity
from sitl_stub.physics import vehicle as body

CHECK_PERIOD_US = 100_000
"""Estimator and battery are looked at ten times a second."""
GROUND_STATION_PERIOD_US = 330_000
"""ArduCopter's three-hertz loop."""
EKF_BAD_CHECKS = 10
EKF_WARN_AGAIN_US = 30_000_000
EKF_REPORT_ONLY, EKF_ALT_HOLD, EKF_LAND_ALWAYS = 0, 2, 3
"""FS_EKF_ACTION; 1 lands from modes that need a position."""
CONTINUE_IF_LANDING, CONTINUE_IF_PILOT_FLIES = 8, 16
"""Bits of FS_OPTIONS."""
PILOT_MODES = (Mode.STABILIZE, Mode.ACRO, Mode.ALT_HOLD, Mode.LOITER, Mode.POSHOLD)
"""Modes that are no autopilot's."""


class Action(IntEnum):
    """What a failsafe does (BATT_FS_LOW_ACT, BATT_FS_CRT_ACT)."""

    NONE = 0
    LAND = 1
    RTL = 2
    SMART_RTL = 3
    SMART_RTL_OR_LAND = 4
    TERMINATE = 5
    LANDING_SEQUENCE = 6
    BRAKE = 7


ACTIONS = {int(action): action for action in Action}
PRIORITIES = (
    Action.TERMINATE,
    Action.LAND,
    Action.RTL,
    Action.SMART_RTL_OR_LAND,
    Action.SMART_RTL,
    Action.NONE,
)
"""Of the battery's two actions: after one, only one that is as far ahead here."""
GROUND_STATION_ACTIONS = {
    1: Action.RTL,
    2: Action.RTL,
    3: Action.SMART_RTL,
    4: Action.SMART_RTL_OR_LAND,
    5: Action.LAND,
    6: Action.LANDING_SEQUENCE,
    7: Action.BRAKE,
}
"""FS_GCS_ENABLE; 0 does nothing, others return."""


class Failsafes:
    """The failsafes of one vehicle."""

    def __init__(
        self, state: ArduPilotState, voice: ArduPilotVoice, commander: Commander, flight_modes: FlightModes
    ) -> None:
        self.state = state
        self.voice = voice
        self.commander = commander
        self.flight_modes = flight_modes
        self._priority = len(PRIORITIES)
        self._below_since_us: dict[BatteryLevel, int] = {}
        self._ekf_was_good = False
        self._ekf_bad_checks = 0
        self._ekf_failed = False
        self._ekf_acted = False
        self._ekf_warned_us: int | None = None
        self._ground_station_lost = False

    def update(self) -> None:
        """A hundred times a second."""
        now = self.state.clock.uptime_us
        if now % CHECK_PERIOD_US == 0:
            self._check_estimator(now)
            self._check_battery(now)
        if now % GROUND_STATION_PERIOD_US == 0:
            self._check_ground_station(now)

    # --- estimator ---------------------------------------------------------------------------------------------
    def _check_estimator(self, now_us: int) -> None:
        a = self.state
        if a.parameters["FS_EKF_THRESH"] <= 0.0:
            self._ekf_bad_checks = 0
            self._clear_estimator()
            return
        good = a.position_known
        self._ekf_was_good |= good
        if not self._ekf_was_good:
            return
        if good:
            self._ekf_bad_checks = max(self._ekf_bad_checks - 1, 0)
            if not self._ekf_bad_checks:
                self._clear_estimator()
            return
        if self._ekf_failed:
            return
        self._ekf_bad_checks += 1
        if self._ekf_bad_checks < EKF_BAD_CHECKS:
            return
        self._ekf_failed = True
        if self._ekf_warned_us is None or now_us - self._ekf_warned_us > EKF_WARN_AGAIN_US:
            self._ekf_warned_us = now_us
            self.voice.say(Severity.CRITICAL, "EKF variance")
        if a.armed:
            self._act_on_estimator()

    def _act_on_estimator(self) -> None:
        a = self.state
        self._ekf_acted = True
        action = int(a.parameters["FS_EKF_ACTION"])
        stays = not a.mode.value.needs_position and action != EKF_LAND_ALWAYS
        if action == EKF_REPORT_ONLY or stays or a.mode is Mode.LAND:
            self.voice.say(Severity.CRITICAL, "EKF Failsafe")
            return
        if action != EKF_ALT_HOLD or not self.commander.request_mode(Mode.ALT_HOLD.custom_mode):
            self._land()
        self.voice.say(Severity.CRITICAL, f"EKF Failsafe: changed to {a.mode.name} Mode")

    def _clear_estimator(self) -> None:
        if self._ekf_failed and self._ekf_acted:
            self.voice.say(Severity.CRITICAL, "EKF Failsafe Cleared")
        self._ekf_failed = self._ekf_acted = False

    # --- battery -----------------------------------------------------------------------------------------------
    def _check_battery(self, now_us: int) -> None:
        a, p = self.state, self.state.parameters
        if not a.armed:
            return
        volts = float(a.core.state[body.BATTERY_VOLTAGE])
        found = BatteryLevel.OK
        for level, name in ((BatteryLevel.LOW, "LOW"), (BatteryLevel.CRITICAL, "CRT")):
            if not 0.0 < volts < p[f"BATT_{name}_VOLT"]:
                self._below_since_us.pop(level, None)
            elif now_us - self._below_since_us.setdefault(level, now_us) > p["BATT_LOW_TIMER"] * 1e6 > 0:
                found = level
        if found <= a.battery:
            return
        a.battery = found
        used = float(a.core.state[body.CHARGE_USED]) / 3.6
        self.voice.say(
            Severity.WARNING, f"Battery 1 is {found.name.lower()} {volts:.2f}V used {used:.0f} mAh"
        )
        number = int(p[f"BATT_FS_{'LOW' if found is BatteryLevel.LOW else 'CRT'}_ACT"])
        action = ACTIONS.get(number, Action.NONE)
        priority = PRIORITIES.index(action) if action in PRIORITIES else len(PRIORITIES)
        if priority > self._priority:
            return
        self._priority = priority
        if self._disarms():
            self.commander.disarm()
            self.voice.say(Severity.WARNING, "Battery Failsafe - Disarming")
        elif a.is_landing and int(p["FS_OPTIONS"]) & CONTINUE_IF_LANDING and action:
            self.voice.say(Severity.WARNING, "Battery Failsafe - Continuing Landing")
            self._act(Action.LAND)
        else:
            self.voice.say(Severity.WARNING, "Battery Failsafe")
            self._act(action)

    # --- ground station ----------------------------------------------------------------------------------------
    def _check_ground_station(self, now_us: int) -> None:
        a, p = self.state, self.state.parameters
        enabled = int(p["FS_GCS_ENABLE"])
        system = int(p["MAV_GCS_SYSID"])
        heard = [at_us for (sender, _), at_us in a.heartbeats.items() if sender == system]
        if not enabled or not heard:
            return
        lost = a.clock.time_us - max(heard) > p["FS_GCS_TIMEOUT"] * 1e6
        if lost == self._ground_station_lost:
            return
        self._ground_station_lost = lost
        if not lost:
            self.voice.say(Severity.WARNING, "GCS Failsafe Cleared")
            return
        action = GROUND_STATION_ACTIONS.get(enabled, Action.RTL)
        options = int(p["FS_OPTIONS"])
        if not a.armed:
            self.voice.say(Severity.WARNING, "GCS Failsafe")
        elif self._disarms():
            self.commander.disarm()
            self.voice.say(Severity.WARNING, "GCS Failsafe - Disarming")
        elif a.is_landing and self._priority <= PRIORITIES.index(Action.LAND):
            self.voice.say(Severity.WARNING, "GCS + Battery Failsafe - Continuing Landing")
            self._act(Action.LAND)
        elif a.is_landing and options & CONTINUE_IF_LANDING:
            self.voice.say(Severity.WARNING, "GCS Failsafe - Continuing Landing")
            self._act(Action.LAND)
        elif options & CONTINUE_IF_PILOT_FLIES and a.mode in PILOT_MODES:
            self.voice.say(Severity.WARNING, "GCS Failsafe - Continuing Pilot Control")
        else:
            self.voice.say(Severity.WARNING, "GCS Failsafe")
            self._act(action)

    # --- acting ------------------------------------------------------------------------------------------------
    def _disarms(self) -> bool:
        """Whether it disarms whatever the action is: on the ground (`should_disarm_on_failsafe`)."""
        a = self.state
        no_throttle = a.mode.value.manual_throttle and a.sticks.throttle <= 0.0
        return a.in_arming_delay or a.landed or no_throttle

    def _land(self) -> None:
        """LAND, after a pause of 4 s in which the pilot can step in."""
        self.commander.request_mode(Mode.LAND.custom_mode)
        self.flight_modes.pause_landing()

    def _act(self, action: Action) -> None:
        """As `Copter::do_failsafe_action`; the stub keeps no path to go back on and has no mission."""
        if action is Action.NONE:
            return
        if action is Action.TERMINATE:
            self.commander.disarm()
            return
        wanted: Mode | None = Mode.RTL
        if action in (Action.SMART_RTL, Action.SMART_RTL_OR_LAND):
            self.voice.say(Severity.WARNING, "Mode change to SMARTRTL failed: init failed")
            instead = "Trying RTL" if action is Action.SMART_RTL else "Using Land"
            self.voice.say(Severity.WARNING, f"SmartRTL Unavailable, {instead} Mode")
            wanted = Mode.RTL if action is Action.SMART_RTL else None
        elif action is Action.LANDING_SEQUENCE:
            self.voice.say(
                Severity.WARNING, "Mode change to AUTO RTL failed: No return path or landing sequence found"
            )
            self.voice.say(Severity.WARNING, "Trying RTL Mode")
        elif action is Action.BRAKE:
            wanted = Mode.BRAKE
        elif action is Action.LAND:
            wanted = None
        if wanted is not None and self.commander.request_mode(wanted.custom_mode):
            return
        if action is Action.BRAKE:
            self.voice.say(Severity.WARNING, "Trying Land Mode")
        self._land()
