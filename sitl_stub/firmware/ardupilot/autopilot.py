"""ArduCopter 4.7 as a firmware of the stub: state, arming and its refusals, commands and messages.

Behaviour follows the capture of ArduCopter 4.7.0-dev (see `tests/conformance`). Modes are flown in `flight_modes.py`,
targets taken in `guided.py`, messages built in `messages.py`, how it comes up in `boot.py`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.boot import Boot, Happenings
from sitl_stub.firmware.ardupilot.core import ArduPilotCore
from sitl_stub.firmware.ardupilot.failsafes import BatteryLevel, Failsafes
from sitl_stub.firmware.ardupilot.flight_modes import Flight
from sitl_stub.firmware.ardupilot.guided import Guided
from sitl_stub.firmware.ardupilot.land_detector import GroundSense
from sitl_stub.firmware.ardupilot.messages import ArduPilotMessages
from sitl_stub.firmware.ardupilot.modes import BY_NUMBER, Mode, mode_named
from sitl_stub.firmware.ardupilot.parameters import ArduPilotParameters
from sitl_stub.firmware.ardupilot.protocol import ArduPilotCommands
from sitl_stub.firmware.ardupilot.statistics import Statistics
from sitl_stub.firmware.common.autopilot import Autopilot
from sitl_stub.firmware.common.commands import Result
from sitl_stub.firmware.common.streams import Builder
from sitl_stub.mavlink.links import Link

CRITICAL, WARNING, INFO = 2, 4, 6
"""MAV_SEVERITY."""
ARMING_DELAY_US = 2_000_000
LOGGING_AFTER_US = 15_000_000
"""How long a refused arming keeps the log open."""
CHUNK_BYTES = 50
PREARM_PHASE_US = 250_000
"""When within each second the checks run."""
TIMESYNC_EVERY_US = 10_000_000
"""Outside lockstep; in lockstep the server sends them."""


class ArduPilot(Autopilot):
    """One ArduCopter."""

    core: ArduPilotCore
    parameters: ArduPilotParameters
    integers_as_bits = False
    unknown_interval_result = Result.DENIED
    unknown_request_result = Result.FAILED

    def __init__(
        self, core: ArduPilotCore, parameters: ArduPilotParameters, ready_after_s: float = 42.0
    ) -> None:
        self.ready_after_s = ready_after_s
        self.say_messages = ArduPilotMessages(self)
        super().__init__(core, parameters)
        self.power_up()
        self.protocol = ArduPilotCommands(self)
        self.commands.update(self.protocol.commands())
        self.messages.update(self.protocol.messages())

    def power_up(self) -> None:
        """Everything as it is when the firmware starts."""
        self.mode = Mode.STABILIZE
        self.landed = True
        self.auto_armed = False
        """Whether flying has been asked for since arming; until then an armed vehicle stays on the ground."""
        self.take_off_done = True
        self.home_ned = np.zeros(3)
        self.prearm_good = False
        self._armed = False
        self._armed_us = 0
        self._idle_since_us = 0
        self._log_until_us = 0
        self._text_number = 0
        self._texts: list[tuple[Link, int, str, int, int]] = []
        self.guided = Guided(self)
        self.flight = Flight(self)
        self.ground_sense = GroundSense(self)
        self.boot = Boot(self, self.ready_after_s)
        self.happenings = Happenings(self)
        self.failsafes = Failsafes(self)
        self.statistics = Statistics(self)
        self.flight.limit_vertical()
        self.flight.rest_on_ground()

    # --- state -------------------------------------------------------------------------------------------------
    @property
    def armed(self) -> bool:
        """Whether the rotors may turn."""
        return self._armed

    @property
    def takes_setpoints(self) -> bool:
        """Whether GUIDED or GUIDED_NOGPS flies."""
        return self.mode.value.takes_targets

    @property
    def in_arming_delay(self) -> bool:
        """The first two seconds after arming: the motors do not turn yet."""
        return self._armed and self.time_us - self._armed_us <= ARMING_DELAY_US

    @property
    def maybe_landed(self) -> bool:
        """Whether it looks like the ground already."""
        return self.ground_sense.maybe

    @property
    def position_known(self) -> bool:
        """Whether the estimator has a position it vouches for."""
        return self.boot.position_found and self.core.position_valid

    @property
    def gps_found(self) -> bool:
        """Whether the receiver has been found."""
        return self.has_gps and self.boot.gps_found

    @property
    def ekf_started(self) -> bool:
        """Whether the filter has its attitude."""
        return self.boot.ekf_started

    @property
    def ahrs_ready(self) -> bool:
        """Whether the attitude is vouched for (its bit in SYS_STATUS)."""
        return self.boot.ahrs_ready

    @property
    def has_gps(self) -> bool:
        """Whether there is a receiver (GPS1_TYPE). Without, the position is that of poses from outside, taken as given."""
        return self.parameters["GPS1_TYPE"] != 0.0

    @property
    def home_known(self) -> bool:
        """Whether there is a home; without a GPS nobody sets one."""
        return self.has_gps and self.boot.home_known

    @property
    def logs(self) -> bool:
        """Whether the log is open."""
        return self._armed or self.time_us < self._log_until_us

    @property
    def height_above_home_m(self) -> float:
        """Estimated height over home."""
        return float(self.home_ned[2] - self.core.position_ned[2])

    @property
    def distance_from_home_m(self) -> float:
        """Estimated horizontal distance from home."""
        offset = self.core.position_ned[:2] - self.home_ned[:2]
        return math.hypot(float(offset[0]), float(offset[1]))

    # --- saying ------------------------------------------------------------------------------------------------
    def say(self, severity: int, text: str) -> None:
        """STATUSTEXT to every client; longer than 50 bytes goes in chunks under one id."""
        self.on_text(text)
        for link in self.links:
            self.say_to(link, severity, text)

    def send_following(self) -> int:
        """Texts said since the last instant, then the streams: an acknowledgement comes before its explanation."""
        texts, self._texts = self._texts, []
        for link, severity, text, number, chunk in texts:
            link.send("STATUSTEXT", severity=severity, text=text, id=number, chunk_seq=chunk)
        return len(texts) + super().send_following()

    def say_to(self, link: Link, severity: int, text: str) -> None:
        """STATUSTEXT to one client."""
        chunks = [text[at : at + CHUNK_BYTES] for at in range(0, len(text), CHUNK_BYTES)] or [""]
        number = 0
        if len(chunks) > 1:
            self._text_number = self._text_number % 65535 + 1
            number = self._text_number
        for index, chunk in enumerate(chunks):
            self._texts.append((link, severity, chunk, number, index))

    # --- modes and arming --------------------------------------------------------------------------------------
    def request_mode(self, number: int) -> bool:
        """Somebody asks for a mode: any on the ground while disarmed, in the air only what can be flown."""
        mode = BY_NUMBER.get(number)
        if mode is None:
            self.say(WARNING, f"No such mode {number}")
            return False
        if mode is self.mode:
            return True
        refusal = self._mode_refusal(mode) if self._armed else None
        if refusal is not None:
            self.say(WARNING, f"Mode change to {mode.name} failed: {refusal}")
            return False
        self.mode = mode
        self.flight.enter(mode)
        self.on_text(f"mode {mode.name}")
        self.flight.run()
        for link in self.links:
            self.streams.build(link, 0)
        return True

    def _mode_refusal(self, mode: Mode) -> str | None:
        if mode.value.manual_throttle and self.landed and not self.mode.value.manual_throttle:
            hover = self.parameters["MOT_THST_HOVER"]
            if self.flight.sticks.throttle > 0.5 * hover:
                return "throttle too high"
        if mode.value.needs_position and not self.position_known:
            return "requires position"
        if mode is Mode.AUTO:
            return "init failed"
        return None

    def arming_refusals(self) -> list[str]:
        """What stands against arming in the present mode, in ArduPilot's words; empty when nothing does."""
        refusals = []
        if not self.boot.accelerometers_agree:
            refusals.append("Accels inconsistent")
        if self.mode.value.needs_position:
            if not self.home_known:
                refusals.append("AHRS: waiting for home")
            elif not self.position_known:
                refusals.append("Need Position Estimate")
        refusals += self.failsafes.battery_refusals()
        if self.mode is Mode.AUTO:
            refusals.append("Mode requires mission")
        if self.failsafes.battery > BatteryLevel.OK:
            refusals.append("Battery failsafe")
        if self.killed:
            refusals.append("Motors Emergency Stopped")
        return refusals

    def request_arm(self, forced: bool) -> Result:
        """COMPONENT_ARM_DISARM with 1."""
        if self._armed:
            return Result.ACCEPTED
        refusals = [] if forced else self.arming_refusals()
        if not refusals and not forced:
            if not self.mode.value.can_arm:
                refusals.append(f"{self.mode.name} mode not armable")
            elif self.flight.sticks.throttle > 0.0 and not self.mode.value.takes_targets:
                refusals.append("Throttle too high")
        if refusals:
            for refusal in refusals:
                self.say(CRITICAL, f"Arm: {refusal}")
            self._log_until_us = self.time_us + LOGGING_AFTER_US
            return Result.FAILED
        self._armed = True
        self._armed_us = self._idle_since_us = self.time_us
        self.auto_armed = False
        if self.position_known:
            self.home_ned = np.array(self.core.position_ned)
        for link in self.links:
            if self.home_known:
                self.streams.build(link, 49)
                self.streams.build(link, 242)
        self.say(INFO, "Arming motors")
        return Result.ACCEPTED

    def request_disarm(self, forced: bool) -> Result:
        """COMPONENT_ARM_DISARM with 0: refused in the air unless forced."""
        if not self._armed:
            return Result.ACCEPTED
        if not self.landed and not forced:
            return Result.FAILED
        self.disarm()
        return Result.ACCEPTED

    def disarm(self) -> None:
        """Stop the motors."""
        if not self._armed:
            return
        self._armed = False
        self.auto_armed = False
        self._log_until_us = self.time_us + LOGGING_AFTER_US
        self.landed = True
        self.flight.takeoff_height_m = None
        self.flight.rest_on_ground()
        self.flight.run()
        self.say(INFO, "Disarming motors")

    def request_take_off(self, height_above_home_m: float) -> bool:
        """MAV_CMD_NAV_TAKEOFF: armed, on the ground, in a mode that takes off, upwards."""
        if not (
            self._armed and self.landed and self.mode.value.takes_off and math.isfinite(height_above_home_m)
        ):
            return False
        if height_above_home_m <= self.height_above_home_m:
            return False
        height = height_above_home_m - float(self.home_ned[2])
        if self.mode is Mode.GUIDED:
            self.guided.take_off(height)
        else:
            self.flight.start_take_off()
            self.flight.takeoff_height_m = height
        self.take_off_done = False
        return True

    # --- the pilot ---------------------------------------------------------------------------------------------
    def pilot_mode(self, name: str) -> None:
        """The pilot, sticks centred, switches to the mode of that name."""
        mode = mode_named(name)
        if mode is not None and self.request_mode(mode.number) and not self.landed:
            self.pilot_sticks(0.0, 0.0, 0.0, 0.5)

    @property
    def mode_name(self) -> str:
        """Name of the mode that flies."""
        return self.mode.name

    def pilot_sticks(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        """The pilot moves the sticks: −1..1 (pitch forward positive), throttle 0..1."""
        sticks = self.flight.sticks
        sticks.roll, sticks.pitch, sticks.yaw, sticks.throttle = roll, -pitch, yaw, throttle

    @property
    def sticks_now(self) -> tuple[float, float, float, float]:
        """Roll, pitch, yaw, throttle as `pilot_sticks` takes them."""
        sticks = self.flight.sticks
        return sticks.roll, -sticks.pitch, sticks.yaw, sticks.throttle

    def pilot_disarm(self, forced: bool) -> None:
        """The pilot disarms; not in the air unless `forced`."""
        self.request_disarm(forced)

    def estimate_jumped(self, jump_ned: tuple[float, float, float], yaw_rad: float) -> None:
        """The estimator has been reset: the position controllers take what they want along."""
        north, east, down = jump_ned
        self.core.memory[at.DESIRED_POSITION : at.DESIRED_POSITION + 3] += (north, east, -down)

    # --- the loop ----------------------------------------------------------------------------------------------
    def run_logic(self) -> None:
        """Everything that happens a hundred times a second."""
        self.boot.update()
        self.ground_sense.update()
        self.flight.run()
        if self.time_us % 1_000_000 == PREARM_PHASE_US:
            self.prearm_good = self._armed or not self.arming_refusals()
        if self.time_us % TIMESYNC_EVERY_US == 0 and not self.lockstep:
            self.broadcast("TIMESYNC", tc1=0, ts1=self.clock_us * 1000 + 1)
        self._disarm_when_idle()
        self.failsafes.update()
        self.happenings.update()
        self.statistics.update()

    def _disarm_when_idle(self) -> None:
        """DISARM_DELAY: armed, on the ground, throttle down, motors idle."""
        delay = self.parameters["DISARM_DELAY"]
        idle = self.landed and self.core.spool_state <= 1.0 and self.flight.sticks.throttle <= 0.0
        if not self._armed or not idle or delay <= 0:
            self._idle_since_us = self.time_us
        elif self.time_us - self._idle_since_us >= delay * 1e6:
            self.disarm()

    def parameters_changed(self) -> None:
        """Take changed parameters into the loops."""
        self.core.use_parameters(self.parameters)

    def stream_definitions(self) -> Sequence[tuple[str, Builder, Mapping[str, float]]]:
        """Everything on request, HEARTBEAT unasked."""
        return self.say_messages.definitions()
