"""PX4's commander: intended mode, arming and its refusals, offboard loss, landing and disarming.

`intended` is what was last asked for; `mode` is what flies, which differs only in a failsafe. When the cause of a
failsafe is gone the intended mode flies again; after disarming the mode chosen before arming comes back. Both as the
capture shows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl_stub.firmware.autopilot import Result
from sitl_stub.firmware.px4_battery import BatteryLevel, battery_level, battery_mode
from sitl_stub.firmware.px4_events import Event
from sitl_stub.firmware.px4_modes import FAILSAFE_ACTIONS, FAILSAFE_DISARM, FAILSAFE_TERMINATE, Mode
from sitl_stub.firmware.px4_offboard import OffboardKind
from sitl_stub.physics import vehicle as body

if TYPE_CHECKING:
    from sitl_stub.firmware.px4 import Px4

OVERRIDE_AUTO, OVERRIDE_OFFBOARD = 1, 2
"""Bits of COM_RC_OVERRIDE."""
FORCE_MAGIC = 21196.0
"""Second parameter of the arm command that skips the checks."""


class Commander:
    """Modes and arming of one vehicle."""

    def __init__(self, autopilot: Px4) -> None:
        self.autopilot = autopilot
        self.intended = Mode.LOITER
        self.mode = Mode.LOITER
        self.armed = False
        self.failsafe = False
        self.taken_off = False
        self.battery = BatteryLevel.OK
        self._battery_disregarded = BatteryLevel.OK
        """Somebody has chosen a mode at that level of charge: only a worse one takes it away."""
        self._killed_since_us: int | None = None
        self._mode_after_disarm = Mode.LOITER
        self._landed_since_us: int | None = None
        self._armed_at_us = 0
        self._was_ready = False

    # --- can it? -----------------------------------------------------------------------------------------------
    def sticks_present(self) -> bool:
        """Whether MANUAL_CONTROL is coming in (COM_RC_LOSS_T), or a radio is on."""
        a = self.autopilot
        if a.navigator.sticks.radio:
            return True
        return a.time_us - a.navigator.sticks.last_us < a.parameters["COM_RC_LOSS_T"] * 1e6

    def offboard_signal(self) -> bool:
        """Whether offboard setpoints are coming in (COM_OF_LOSS_T) and can be flown with the present estimate."""
        a = self.autopilot
        if not a.offboard.fresh(a.time_us, a.parameters["COM_OF_LOSS_T"]):
            return False
        needs_position = a.offboard.kind in (OffboardKind.POSITION, OffboardKind.VELOCITY)
        return a.core.position_valid or not needs_position

    def can_run(self, mode: Mode) -> bool:
        """Whether `mode` could fly now."""
        if mode is Mode.OFFBOARD:
            return self.offboard_signal()
        if mode is Mode.MISSION:
            return False
        if mode.value.needs_sticks and not self.sticks_present():
            return False
        return self.autopilot.core.position_valid or not mode.value.needs_position

    def arming_refusal(self) -> str | None:
        """Why it would not arm in the intended mode, or None."""
        a = self.autopilot
        if not a.system_ready:
            return "Preflight Fail: system not ready"
        if a.killed:
            return "Preflight Fail: Kill switch engaged"
        if not self.intended.value.can_arm:
            return "Arming denied: mode does not allow arming"
        if not self.can_run(self.intended):
            if self.intended is Mode.OFFBOARD:
                return "Arming denied: no offboard signal"
            return "Arming denied: mode requirements not met"
        return None

    # --- requests ----------------------------------------------------------------------------------------------
    def request_mode(self, mode: Mode | None) -> Result:
        """Somebody asks for a mode: always granted on the ground, in the air only if it can run."""
        if mode is None:
            return Result.TEMPORARILY_REJECTED
        if self.armed and not self.can_run(mode):
            self.autopilot.announce(4, f"Switching to mode '{mode.name.title()}' is currently not possible")
            return Result.TEMPORARILY_REJECTED
        self.intended = mode
        self._battery_disregarded = self.battery
        if not self.armed:
            self._mode_after_disarm = mode
        self._choose_mode()
        return Result.ACCEPTED

    def request_arm(self, arm: bool, forced: bool) -> Result:
        """COMPONENT_ARM_DISARM."""
        a = self.autopilot
        if not arm:
            if self.armed and not a.land_detector.landed and not forced:
                a.announce(2, "Disarming denied: not landed")
                return Result.TEMPORARILY_REJECTED
            if self.armed:
                self.disarm("by command" if not forced else "forced")
            return Result.ACCEPTED
        if self.armed:
            return Result.ACCEPTED
        refusal = None if forced and a.system_ready else self.arming_refusal()
        if refusal is not None:
            a.announce(2, refusal, Event.ARMING_DENIED)
            return Result.TEMPORARILY_REJECTED
        self.armed = True
        self.taken_off = False
        self._armed_at_us = a.time_us
        self._landed_since_us = a.time_us
        a.armed_at_us = a.time_us
        a.set_home_here()
        a.announce(6, "Armed by external command", Event.ARMED)
        self._enter(self.mode)
        return Result.ACCEPTED

    def disarm(self, why: str) -> None:
        """Stop the rotors; the mode chosen before arming comes back."""
        self.armed = False
        self.failsafe = False
        a = self.autopilot
        a.core.idle()
        self._battery_disregarded = BatteryLevel.OK
        a.announce(6, f"Disarmed {why}", Event.DISARMED)
        self.intended = self._mode_after_disarm
        self._choose_mode()

    def override_by_sticks(self, moved: float) -> None:
        """The pilot has moved a stick by that share of its way: COM_RC_OVERRIDE hands over beyond COM_RC_STICK_OV."""
        p = self.autopilot.parameters
        bit = OVERRIDE_OFFBOARD if self.mode is Mode.OFFBOARD else OVERRIDE_AUTO if self.mode.is_auto else 0
        far = moved > 0.01 * p["COM_RC_STICK_OV"]
        if not (self.armed and self.taken_off and far and int(p["COM_RC_OVERRIDE"]) & bit):
            return
        for mode in (Mode.POSCTL, Mode.ALTCTL):
            if self.can_run(mode):
                self.autopilot.announce(6, "Pilot took over using sticks")
                self.request_mode(mode)
                return

    def takeoff_done(self) -> None:
        """The climb of TAKEOFF is over: hold."""
        if self.mode is Mode.TAKEOFF:
            self.intended = Mode.LOITER
            self._choose_mode()

    # --- every 10 ms -------------------------------------------------------------------------------------------
    def update(self) -> None:
        """Failsafes, landing, disarming."""
        a = self.autopilot
        self._look_at_battery()
        self._look_at_kill_switch()
        if self.armed:
            self._choose_mode()
            landed = a.land_detector.landed
            if not landed:
                if not self.taken_off:
                    a.announce(6, "Takeoff detected", Event.TAKEOFF_DETECTED)
                self.taken_off = True
                self._landed_since_us = None
            elif self._landed_since_us is None:
                self._landed_since_us = a.time_us
                a.announce(6, "Landing detected", Event.LANDING_DETECTED)
            if self._landed_since_us is not None:
                name = "COM_DISARM_LAND" if self.taken_off else "COM_DISARM_PRFLT"
                after = a.parameters[name]
                if after > 0 and a.time_us - self._landed_since_us >= after * 1e6:
                    self.disarm("by landing" if self.taken_off else "by auto preflight disarming")

    def _look_at_battery(self) -> None:
        core = self.autopilot.core
        used = float(core.state[body.CHARGE_USED] / core.parameters_packed[body.BATTERY_CAPACITY])
        level = battery_level(1.0 - used, self.autopilot.parameters)
        if level > self.battery:
            self.autopilot.announce(4 if level is BatteryLevel.LOW else 2, f"Battery {level.name.lower()}")
        self.battery = level

    def _look_at_kill_switch(self) -> None:
        a = self.autopilot
        if not (a.killed and self.armed):
            self._killed_since_us = None
            return
        if self._killed_since_us is None:
            self._killed_since_us = a.time_us
            a.announce(2, "Kill engaged")
        after = a.parameters["COM_KILL_DISARM"]
        if after > 0 and a.time_us - self._killed_since_us >= after * 1e6:
            self.disarm("by kill switch")

    def _battery_failsafe(self, mode: Mode) -> Mode | None:
        """The mode the battery forces on `mode`, or None."""
        forced = battery_mode(self.battery, self.autopilot.parameters)
        free = self.battery <= self._battery_disregarded or not self.taken_off
        if forced is None or free or mode in (forced, Mode.LAND, Mode.PRECISION_LAND):
            return None
        return forced if self.can_run(forced) else Mode.LAND

    def _choose_mode(self) -> None:
        mode = self.intended
        failsafe = False
        forced = self._battery_failsafe(mode) if self.armed else None
        if forced is not None:
            failsafe = True
            mode = forced
        elif self.armed and not self.can_run(mode):
            failsafe = True
            fallback = self._fallback(mode)
            if fallback is None:
                return
            mode = fallback
        if failsafe and not self.failsafe:
            a = self.autopilot
            cause = "no offboard signal" if self.intended is Mode.OFFBOARD else "mode requirements lost"
            cause = cause if forced is None else f"battery {self.battery.name.lower()}"
            a.announce(2, f"Failsafe activated: {cause}, now {mode.name.title()}", Event.FAILSAFE)
        elif self.failsafe and not failsafe:
            self.autopilot.on_text("failsafe cleared")
        self.failsafe = failsafe
        if mode is not self.mode:
            self.mode = mode
            self._enter(mode)

    def _fallback(self, mode: Mode) -> Mode | None:
        """What flies when `mode` cannot; None: it has been disarmed."""
        a = self.autopilot
        p = a.parameters
        if mode is Mode.OFFBOARD:
            action = int(p["COM_OBL_RC_ACT"])
            if action in (FAILSAFE_DISARM, FAILSAFE_TERMINATE):
                self.disarm("by offboard-loss action")
                return None
            wanted = FAILSAFE_ACTIONS.get(action, Mode.LAND)
        else:
            wanted = {1: Mode.LOITER, 3: Mode.LAND}.get(int(p["NAV_RCL_ACT"]), Mode.RTL)
        for candidate in (wanted, Mode.RTL):
            if self.can_run(candidate):
                return candidate
        return Mode.LAND

    def _enter(self, mode: Mode) -> None:
        a = self.autopilot
        if mode is not Mode.OFFBOARD:
            a.navigator.enter(mode)
        a.on_text(f"mode {mode.name}")

    @property
    def ready_to_arm(self) -> bool:
        """The pre-arm bit of SYS_STATUS: for the intended mode."""
        return self.arming_refusal() is None
