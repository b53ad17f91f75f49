"""PX4's commander: intended mode, arming and its refusals, offboard loss, landing and disarming.

`intended` is what was last asked for; `mode` is what flies, which differs only in a failsafe. When the cause of a
failsafe is gone the intended mode flies again; after disarming the mode chosen before arming comes back. Both as the
capture shows.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.common.commands import Result
from sitl_stub.firmware.common.mavlink_ids import Severity
from sitl_stub.firmware.common.sticks import ArmingGesture
from sitl_stub.firmware.px4.battery import BatteryLevel, BatteryWatch, battery_mode
from sitl_stub.firmware.px4.events import Event, Reason
from sitl_stub.firmware.px4.modes import (
    FAILSAFE_ACTIONS,
    FAILSAFE_DISARM,
    FAILSAFE_TERMINATE,
    STICK_LOSS_ACTIONS,
    Mode,
)
from sitl_stub.firmware.px4.navigator import Navigator
from sitl_stub.firmware.px4.offboard import OffboardKind, OffboardSetpoint
from sitl_stub.firmware.px4.state import NO_STICKS, Px4State
from sitl_stub.firmware.px4.voice import Px4Voice

OVERRIDE_AUTO, OVERRIDE_OFFBOARD = 1, 2
"""Bits of COM_RC_OVERRIDE."""
FORCE_MAGIC = 21196.0
"""Second parameter of the arm command: disarms in the air. PX4 checks all the same before it arms by MAVLink."""
SEVERITY = {Mode.LOITER: 5, Mode.RTL: 6, Mode.LAND: 7}
"""failsafe_action_t of modes: of two failsafes the higher number acts."""
FALLBACKS = (Mode.POSCTL, Mode.ALTCTL, Mode.STABILIZED, Mode.LOITER, Mode.RTL)
"""Where one cannot run the next is tried, and landing at the end."""
EXCEPT_AUTO, EXCEPT_OFFBOARD = 2, 4
"""Bits of COM_RCL_EXCEPT."""
ARM_GESTURE_US = 1_000_000
"""COM_RC_ARM_HYST."""
LONGEST_HOLD_S = 25.0
"""Greatest COM_FAIL_ACT_T that PX4 documents."""
STICKS_CAUSE = 1
"""failsafe_cause_t."""
FALLBACK_SEVERITY = {Mode.POSCTL: 2, Mode.ALTCTL: 3, Mode.STABILIZED: 4}


class Commander:
    """Modes and arming of one vehicle."""

    def __init__(
        self, state: Px4State, voice: Px4Voice, offboard: OffboardSetpoint, navigator: Navigator
    ) -> None:
        self.state = state
        self.voice = voice
        self.offboard = offboard
        self.navigator = navigator
        self.taken_off = False
        self.battery = BatteryWatch()
        self._sticks_optional = True
        """There were none at arming, nor since: that none are there is no loss."""
        self._gesture = ArmingGesture(ARM_GESTURE_US)
        self._sticks_lost = False
        """Stays until somebody chooses a mode."""
        self._hold_until_us: int | None = None
        """While this lies ahead the vehicle holds before a failsafe acts; None: none is about to."""
        self._killed_since_us: int | None = None
        self._mode_after_disarm = Mode.LOITER
        self._landed_since_us: int | None = None

    # --- can it? -----------------------------------------------------------------------------------------------
    def sticks_present(self) -> bool:
        """Whether MANUAL_CONTROL is coming in (COM_RC_LOSS_T), or a radio is on."""
        a = self.state
        if a.sticks.radio:
            return True
        return a.clock.time_us - a.sticks.last_us < a.parameters["COM_RC_LOSS_T"] * 1e6

    def offboard_signal(self) -> bool:
        """Whether offboard setpoints are coming in (COM_OF_LOSS_T) and can be flown with the present estimate."""
        a = self.state
        if not self.offboard.fresh(a.clock.time_us, a.parameters["COM_OF_LOSS_T"]):
            return False
        needs_position = self.offboard.kind in (OffboardKind.POSITION, OffboardKind.VELOCITY)
        return a.core.position_valid or not needs_position

    def can_run(self, mode: Mode) -> bool:
        """Whether `mode` could fly now."""
        if mode is Mode.OFFBOARD:
            return self.offboard_signal()
        if mode is Mode.MISSION:
            return self.navigator.mission.valid and self.state.core.position_valid
        if mode.value.needs_sticks and not self.sticks_present():
            return False
        return self.state.core.position_valid or not mode.value.needs_position

    def arming_refusal(self) -> str | None:
        """Why it would not arm in the intended mode, or None."""
        a = self.state
        if not a.system_ready:
            return "Preflight Fail: system not ready"
        if a.killed:
            return "Preflight Fail: Kill switch engaged"
        if self.battery.warning >= BatteryLevel.CRITICAL:
            return "Preflight Fail: Critical battery"
        if not self.state.intended.value.can_arm:
            return "Arming denied: mode does not allow arming"
        if not self.can_run(self.state.intended):
            if self.state.intended is Mode.OFFBOARD:
                return "Arming denied: no offboard signal"
            return "Arming denied: mode requirements not met"
        return None

    # --- requests ----------------------------------------------------------------------------------------------
    def request_mode(self, mode: Mode | None) -> Result:
        """Somebody asks for a mode: always granted on the ground, in the air only if it can run."""
        if mode is None:
            return Result.TEMPORARILY_REJECTED
        if self.state.armed and not self.can_run(mode):
            name = mode.value.name
            self.voice.announce(Severity.CRITICAL, f"Switching to {name} is currently not available")
            return Result.TEMPORARILY_REJECTED
        self.state.intended = mode
        self.battery.accept()
        self._sticks_lost = False
        if not self.state.armed:
            self._mode_after_disarm = mode
        self._choose_mode()
        return Result.ACCEPTED

    def _arm_by_gesture(self) -> None:
        """By the sticks it is armed in modes that are flown by them only."""
        if self.state.armed:
            return
        if not self.state.intended.value.needs_sticks:
            text = "Arming denied: switch to manual mode first"
            self.voice.announce(Severity.CRITICAL, text, Event.ARMING_DENIED)
            return
        self.request_arm(True, forced=False, why=Reason.STICK_GESTURE)

    def request_arm(self, arm: bool, forced: bool, why: Reason = Reason.COMMAND) -> Result:
        """COMPONENT_ARM_DISARM, or the sticks."""
        a = self.state
        if not arm:
            if self.state.armed and not a.ground.landed and not forced:
                text = "Disarming denied: not landed"
                self.voice.announce(
                    Severity.CRITICAL, text, Event.DISARMING_DENIED, old_text="Disarming denied! Not landed"
                )
                return Result.TEMPORARILY_REJECTED
            if self.state.armed:
                self.disarm(Reason.COMMAND)
            return Result.ACCEPTED
        if self.state.armed:
            return Result.ACCEPTED
        refusal = self.arming_refusal()
        if refusal is not None:
            self.voice.announce(Severity.CRITICAL, refusal, Event.ARMING_DENIED)
            return Result.TEMPORARILY_REJECTED
        self.state.armed = True
        self.taken_off = False
        a.armed_us = self._landed_since_us = a.clock.time_us
        self.set_home_here()
        self.battery.accept()
        self._sticks_optional = not self.sticks_present()
        self.voice.announce(Severity.INFO, f"Armed by {why.words}", Event.ARMED, bytes((why,)))
        self._enter(self.state.mode)
        return Result.ACCEPTED

    def disarm(self, why: Reason) -> None:
        """Stop the rotors; the mode chosen before arming comes back."""
        self.state.armed = False
        self.state.failsafe = False
        a = self.state
        a.core.idle()
        self.voice.announce(Severity.INFO, f"Disarmed by {why.words}", Event.DISARMED, bytes((why,)))
        self.state.intended = self._mode_after_disarm
        self._choose_mode()

    def override_by_sticks(self, moved: float) -> None:
        """The pilot has moved a stick by that share of its way: COM_RC_OVERRIDE hands over beyond COM_RC_STICK_OV."""
        p = self.state.parameters
        bit = (
            OVERRIDE_OFFBOARD
            if self.state.mode is Mode.OFFBOARD
            else OVERRIDE_AUTO
            if self.state.mode.is_auto
            else 0
        )
        far = moved > 0.01 * p["COM_RC_STICK_OV"]
        if not (self.state.armed and self.taken_off and far and int(p["COM_RC_OVERRIDE"]) & bit):
            return
        for mode in (Mode.POSCTL, Mode.ALTCTL):
            if self.can_run(mode):
                axes = "position" if mode is Mode.POSCTL else "altitude"
                old_text = f"Pilot took over {axes} control using sticks"
                self.voice.announce(
                    Severity.INFO, "Pilot took over using sticks", Event.STICKS, old_text=old_text
                )
                self.request_mode(mode)
                return

    def set_home_here(self) -> None:
        """Home is where the vehicle is (PX4 sets it on arming)."""
        a = self.state
        w, x, y, z = a.core.quaternion.tolist()
        a.home_quaternion = (w, x, y, z)
        a.home_set_us = a.clock.stamp_us
        self.set_home(a.core.position_ned)

    def set_home(self, position_ned: NDArray[np.float64]) -> None:
        """Home is at (3,), m."""
        self.state.home_ned = np.array(position_ned)

    def takeoff_done(self) -> None:
        """The climb of TAKEOFF is over: hold."""
        if self.state.mode is Mode.TAKEOFF:
            self.state.intended = Mode.LOITER
            self._choose_mode()

    # --- every 10 ms -------------------------------------------------------------------------------------------
    def update(self) -> None:
        """Failsafes, landing, disarming."""
        a = self.state
        if self.sticks_present() and self._gesture.made(a.sticks, a.clock.time_us):
            self._arm_by_gesture()
        self._look_at_battery()
        self._look_at_kill_switch()
        if self.state.armed:
            self._choose_mode()
            landed = a.ground.landed
            if not landed:
                if not self.taken_off:
                    self.voice.announce(Severity.INFO, "Takeoff detected", Event.TAKEOFF_DETECTED)
                self.taken_off = True
                self._landed_since_us = None
            elif self._landed_since_us is None:
                self._landed_since_us = a.clock.time_us
                self.voice.announce(Severity.INFO, "Landing detected", Event.LANDING_DETECTED)
            if self._landed_since_us is not None:
                name = "COM_DISARM_LAND" if self.taken_off else "COM_DISARM_PRFLT"
                after = a.parameters[name]
                if after > 0 and a.clock.time_us - self._landed_since_us >= after * 1e6:
                    self.disarm(Reason.LANDING if self.taken_off else Reason.PREFLIGHT_INACTION)

    def _look_at_battery(self) -> None:
        a = self.state
        worse = self.battery.look(a.charge_left, a.parameters, a.armed)
        a.battery = self.battery.level
        if not worse:
            return
        level = self.battery.warning
        if level is BatteryLevel.LOW:
            self.voice.announce(Severity.CRITICAL, "Low battery level, return advised", Event.BATTERY_LOW)
        elif battery_mode(level, a.parameters) is None:
            if level is BatteryLevel.CRITICAL:
                old_text = "Critical battery level, return now"
                self.voice.announce(
                    Severity.CRITICAL,
                    "Critical battery level, land now",
                    Event.BATTERY_CRITICAL,
                    old_text=old_text,
                )
            else:
                text, old_text = (
                    "Emergency battery level, land immediately",
                    "Dangerous battery level, land now",
                )
                self.voice.announce(Severity.EMERGENCY, text, Event.BATTERY_EMERGENCY, old_text=old_text)

    def _look_at_kill_switch(self) -> None:
        a = self.state
        if not (a.killed and self.state.armed):
            if self._killed_since_us is not None and self.state.armed:
                self.voice.announce(
                    Severity.INFO, "Kill disengaged", Event.KILL_OVER, old_text="Kill-switch disengaged"
                )
            self._killed_since_us = None
            return
        if self._killed_since_us is None:
            self._killed_since_us = a.clock.time_us
            landed = a.ground.landed
            event = Event.KILL_ON_GROUND if landed else Event.KILL_IN_AIR
            severity = Severity.INFO if landed else Severity.CRITICAL
            self.voice.announce(severity, "Kill engaged", event, old_text="Kill-switch engaged")
        after = a.parameters["COM_KILL_DISARM"]
        if after > 0 and a.clock.time_us - self._killed_since_us >= after * 1e6:
            self.disarm(Reason.KILL_SWITCH)

    def _battery_failsafe(self, mode: Mode) -> Mode | None:
        """The mode the battery forces on `mode`, or None."""
        forced = self.battery.forced(self.state.parameters)
        if forced is None or not self.taken_off or mode in (forced, Mode.LAND, Mode.PRECISION_LAND):
            return None
        return forced if self.can_run(forced) else Mode.LAND

    def _look_at_sticks(self, mode: Mode) -> Mode | None:
        """What the loss of sticks forces on `mode` (NAV_RCL_ACT unless COM_RCL_EXCEPT), or None."""
        p = self.state.parameters
        if self.sticks_present():
            self._sticks_optional = False
        elif not self._sticks_optional and int(p["COM_RC_IN_MODE"]) != NO_STICKS:
            bit = EXCEPT_OFFBOARD if mode is Mode.OFFBOARD else EXCEPT_AUTO if mode.is_auto else 0
            self._sticks_lost |= not int(p["COM_RCL_EXCEPT"]) & bit
        action = STICK_LOSS_ACTIONS.get(int(p["NAV_RCL_ACT"])) if self._sticks_lost else None
        if action is None or mode is action or (mode is Mode.LAND and action is Mode.RTL):
            return None
        return action if self.can_run(action) else Mode.LAND

    def _lasting_failsafe(self, mode: Mode) -> tuple[Mode, str, str, int] | None:
        """The worst that battery or lost sticks force on `mode`: what flies, cause in words (old and new), its number."""
        battery, sticks = self._battery_failsafe(mode), self._look_at_sticks(mode)
        if battery is not None and (sticks is None or SEVERITY[battery] >= SEVERITY[sticks]):
            critical = self.battery.warning is BatteryLevel.CRITICAL
            words = ("Critical", "Critical") if critical else ("Emergency", "Dangerous")
            return (
                battery,
                f"{words[0]} battery level",
                f"{words[1]} battery level",
                self.battery.warning.cause,
            )
        if sticks is not None:
            return sticks, "Manual control loss", "Manual control lost", STICKS_CAUSE
        return None

    def _holds(self, action: Mode, cause: str, old_cause: str, number: int) -> bool:
        """Whether it holds a while yet, so that the pilot can step in, before `action` (COM_FAIL_ACT_T)."""
        a = self.state
        if self._hold_until_us is None:
            delayed = action is not Mode.LOITER and not self.state.failsafe and self.can_run(Mode.LOITER)
            wait_s = min(max(float(a.parameters["COM_FAIL_ACT_T"]), 0.0), LONGEST_HOLD_S) if delayed else 0.0
            self._hold_until_us = a.clock.time_us + int(wait_s * 1e6)
            name = action.value.name
            text = f"{cause}: switching to {name}"
            old_text = f"{old_cause}, executing {name} in {wait_s:.0f} seconds"
            told = struct.pack("<IB", self.state.intended.custom_mode, SEVERITY[action])
            event = Event.FAILSAFE_CAUSED
            if wait_s > 0:
                text += f" in {wait_s:.0f} seconds"
                told += struct.pack("<H", int(wait_s))
                event = Event.FAILSAFE_HOLDS
            self.voice.announce(Severity.CRITICAL, text, event, told + bytes((number,)), old_text)
        return a.clock.time_us < self._hold_until_us

    def _choose_mode(self) -> None:
        mode = self.state.intended
        failsafe = False
        if self.state.armed:
            lost = not self.can_run(mode)
            if lost and mode is Mode.OFFBOARD and self._offboard_loss_disarms():
                self.disarm(Reason.FAILSAFE)
                return
            fallback = self._fallback(mode) if lost else None
            lasting = self._lasting_failsafe(mode)
            worse = lasting is None or (
                fallback is not None and SEVERITY.get(fallback, 0) > SEVERITY[lasting[0]]
            )
            if fallback is not None and worse:
                if not self.state.failsafe:
                    self._tell_fallback(fallback)
                mode = fallback
            elif lasting is not None:
                mode = Mode.LOITER if self._holds(*lasting) else lasting[0]
            if lasting is None:
                self._hold_until_us = None
            failsafe = fallback is not None or lasting is not None
        if self.state.failsafe and not failsafe:
            self.voice.note("failsafe cleared")
        self.state.failsafe = failsafe
        if mode is not self.state.mode:
            self.state.mode = mode
            self._enter(mode)

    def _tell_fallback(self, mode: Mode) -> None:
        """A failsafe begins because the mode that was meant to fly cannot."""
        lost = "no offboard" if self.state.intended is Mode.OFFBOARD else "no local position"
        action = SEVERITY.get(mode) or FALLBACK_SEVERITY[mode]
        self.voice.announce(
            Severity.CRITICAL,
            f"Failsafe activated: {lost}, switching to {mode.value.name}",
            Event.FAILSAFE,
            struct.pack("<IB", self.state.intended.custom_mode, action),
            old_text=f"Failsafe enabled: {lost}",
        )

    def _offboard_loss_disarms(self) -> bool:
        return int(self.state.parameters["COM_OBL_RC_ACT"]) in (FAILSAFE_DISARM, FAILSAFE_TERMINATE)

    def _fallback(self, mode: Mode) -> Mode:
        """What flies when `mode` cannot (`Failsafe::checkModeFallback`, `FailsafeBase::getSelectedAction`)."""
        p = self.state.parameters
        after_sticks = STICK_LOSS_ACTIONS.get(int(p["NAV_RCL_ACT"]), Mode.RTL)
        wanted = Mode.RTL
        if mode is Mode.OFFBOARD:
            wanted = FAILSAFE_ACTIONS.get(int(p["COM_OBL_RC_ACT"]), Mode.POSCTL)
            if wanted.value.needs_sticks and not self.sticks_present():
                wanted = after_sticks
        elif mode.value.needs_sticks:
            wanted = Mode.ALTCTL if self.sticks_present() else after_sticks
        chain = FALLBACKS[FALLBACKS.index(wanted) :] if wanted in FALLBACKS else (wanted,)
        return next((one for one in chain if self.can_run(one)), Mode.LAND)

    def _enter(self, mode: Mode) -> None:
        if mode is not Mode.OFFBOARD:
            self.navigator.enter(mode)
        self.voice.note(f"mode {mode.name}")

    @property
    def ready_to_arm(self) -> bool:
        """The pre-arm bit of SYS_STATUS: for the intended mode."""
        return self.arming_refusal() is None
