"""ArduCopter's modes and arming: who asks for what, what stands against it, what follows."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.ardupilot.battery import BatteryLevel, voltage_refusals
from sitl_stub.firmware.ardupilot.flight_modes import FlightModes
from sitl_stub.firmware.ardupilot.modes import BY_NUMBER, Mode
from sitl_stub.firmware.ardupilot.state import ArduPilotState
from sitl_stub.firmware.ardupilot.voice import ArduPilotVoice
from sitl_stub.firmware.common.commands import Result
from sitl_stub.firmware.common.mavlink_ids import Severity
from sitl_stub.firmware.common.sticks import ArmingGesture
from sitl_stub.firmware.common.streams import StreamTable
from sitl_stub.physics import vehicle as body

LOGGING_AFTER_US = 15_000_000
"""How long a refused arming keeps the log open."""

ARM_GESTURE_US = 2_000_000
"""ARM_DELAY."""
GUIDED_ARMS_BY_STICKS = 1
"""Of GUID_OPTIONS."""


class Commander:
    """Modes and arming of one vehicle."""

    def __init__(
        self, state: ArduPilotState, voice: ArduPilotVoice, flight_modes: FlightModes, streams: StreamTable
    ) -> None:
        self.state = state
        self.voice = voice
        self.flight_modes = flight_modes
        self.setpoints = flight_modes.setpoints
        self.guided = flight_modes.guided
        self.streams = streams
        self._idle_since_us = 0
        self._gesture = ArmingGesture(ARM_GESTURE_US)

    def run(self) -> None:
        """A hundred times a second: the mode that flies; a landing that is over stops the motors."""
        if self._gesture.made(self.state.sticks, self.state.clock.time_us) and not self.state.armed:
            self._arm_by_gesture()
        if self.flight_modes.run():
            self.disarm()

    def set_home(self, position_ned: NDArray[np.float64]) -> None:
        """Home is at (3,), m."""
        self.state.home_ned = np.array(position_ned)

    def request_mode(self, number: int) -> bool:
        """Somebody asks for a mode: any on the ground while disarmed, in the air only what can be flown."""
        mode = BY_NUMBER.get(number)
        if mode is None:
            self.voice.say(Severity.WARNING, f"No such mode {number}")
            return False
        if mode is self.state.mode:
            return True
        refusal = self._mode_refusal(mode) if self.state.armed else None
        if refusal is not None:
            self.voice.say(Severity.WARNING, f"Mode change to {mode.name} failed: {refusal}")
            return False
        self.state.mode = mode
        self.flight_modes.enter(mode)
        self.voice.note(f"mode {mode.name}")
        self.run()
        for link in self.voice.links:
            self.streams.send_named(link, "HEARTBEAT")
        return True

    def _mode_refusal(self, mode: Mode) -> str | None:
        if mode.value.manual_throttle and self.state.landed and not self.state.mode.value.manual_throttle:
            hover = self.state.parameters["MOT_THST_HOVER"]
            if self.state.sticks.throttle > 0.5 * hover:
                return "throttle too high"
        if mode.value.needs_position and not self.state.position_known:
            return "requires position"
        if mode is Mode.AUTO:
            return "init failed"
        return None

    def arming_refusals(self) -> list[str]:
        """What stands against arming in the present mode, in ArduPilot's words; empty when nothing does."""
        refusals = []
        if not self.state.boot.accelerometers_agree:
            refusals.append("Accels inconsistent")
        if self.state.mode.value.needs_position:
            if not self.state.home_known:
                refusals.append("AHRS: waiting for home")
            elif not self.state.position_known:
                refusals.append("Need Position Estimate")
        volts = float(self.state.core.state[body.BATTERY_VOLTAGE])
        refusals += voltage_refusals(volts, self.state.parameters)
        if self.state.mode is Mode.AUTO:
            refusals.append("Mode requires mission")
        if self.state.battery > BatteryLevel.OK:
            refusals.append("Battery failsafe")
        if self.state.killed:
            refusals.append("Motors Emergency Stopped")
        return refusals

    def _arm_by_gesture(self) -> None:
        """Rudder arming: GUIDED allows it only with GUID_OPTIONS bit 0."""
        mode, options = self.state.mode, int(self.state.parameters["GUID_OPTIONS"])
        if mode.value.takes_targets and not options & GUIDED_ARMS_BY_STICKS:
            self.voice.say(Severity.CRITICAL, f"Arm: {mode.name} mode not armable")
            return
        self.request_arm(forced=False)

    def request_arm(self, forced: bool) -> Result:
        """COMPONENT_ARM_DISARM with 1."""
        if self.state.armed:
            return Result.ACCEPTED
        refusals = [] if forced else self.arming_refusals()
        if not refusals and not forced:
            if not self.state.mode.value.can_arm:
                refusals.append(f"{self.state.mode.name} mode not armable")
            elif self.state.sticks.throttle > 0.0 and not self.state.mode.value.takes_targets:
                refusals.append("Throttle too high")
        if refusals:
            for refusal in refusals:
                self.voice.say(Severity.CRITICAL, f"Arm: {refusal}")
            self.state.log_until_us = self.state.clock.time_us + LOGGING_AFTER_US
            return Result.FAILED
        self.state.armed = True
        self.state.armed_us = self._idle_since_us = self.state.clock.time_us
        self.setpoints.forget_flight()
        if self.state.position_known:
            self.set_home(self.state.core.position_ned)
        for link in self.voice.links:
            if self.state.home_known:
                self.streams.send_named(link, "GPS_GLOBAL_ORIGIN", "HOME_POSITION")
        self.voice.say(Severity.INFO, "Arming motors")
        return Result.ACCEPTED

    def request_disarm(self, forced: bool) -> Result:
        """COMPONENT_ARM_DISARM with 0: refused in the air unless forced."""
        if not self.state.armed:
            return Result.ACCEPTED
        if not self.state.landed and not forced:
            return Result.FAILED
        self.disarm()
        return Result.ACCEPTED

    def disarm(self) -> None:
        """Stop the motors."""
        if not self.state.armed:
            return
        self.state.armed = False
        self.setpoints.forget_flight()
        self.state.log_until_us = self.state.clock.time_us + LOGGING_AFTER_US
        self.setpoints.land_detector.disarmed()
        self.flight_modes.takeoff_height_m = None
        self.setpoints.rest_on_ground()
        self.flight_modes.run()
        self.voice.say(Severity.INFO, "Disarming motors")

    def request_take_off(self, height_above_home_m: float) -> bool:
        """MAV_CMD_NAV_TAKEOFF: armed, on the ground, in a mode that takes off, upwards."""
        if not (
            self.state.armed
            and self.state.landed
            and self.state.mode.value.takes_off
            and math.isfinite(height_above_home_m)
        ):
            return False
        if height_above_home_m <= self.state.height_above_home_m:
            return False
        height = height_above_home_m - float(self.state.home_ned[2])
        if self.state.mode is Mode.GUIDED:
            self.guided.take_off(height)
        else:
            self.setpoints.start_take_off()
            self.flight_modes.takeoff_height_m = height
        return True

    def disarm_when_idle(self) -> None:
        """DISARM_DELAY: armed, on the ground, throttle down, motors idle."""
        delay = self.state.parameters["DISARM_DELAY"]
        idle = self.state.landed and self.state.core.spool_state <= 1.0 and self.state.sticks.throttle <= 0.0
        if not self.state.armed or not idle or delay <= 0:
            self._idle_since_us = self.state.clock.time_us
        elif self.state.clock.time_us - self._idle_since_us >= delay * 1e6:
            self.disarm()
