"""ArduCopter 4.7 as a firmware of the stub: its parts, and what it does a hundred times a second.

Behaviour follows the capture of ArduCopter 4.7.0-dev (see `tests/conformance`). Modes and arming are in `commander.py`,
modes are flown in `flight_modes.py`, targets taken in `guided.py`, `protocol.py` has what it takes, `messages.py` what it
sends, `boot.py` how it comes up.
"""

from __future__ import annotations

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.announcements import Announcements
from sitl_stub.firmware.ardupilot.boot import Boot
from sitl_stub.firmware.ardupilot.commander import Commander
from sitl_stub.firmware.ardupilot.core import ArduPilotCore
from sitl_stub.firmware.ardupilot.failsafes import Failsafes
from sitl_stub.firmware.ardupilot.flight_modes import FlightModes
from sitl_stub.firmware.ardupilot.guided import Guided
from sitl_stub.firmware.ardupilot.land_detector import LandDetector
from sitl_stub.firmware.ardupilot.messages import ArduPilotMessages
from sitl_stub.firmware.ardupilot.modes import Mode, mode_named
from sitl_stub.firmware.ardupilot.parameter_protocol import ArduPilotParameterProtocol
from sitl_stub.firmware.ardupilot.parameters import ArduPilotParameters
from sitl_stub.firmware.ardupilot.protocol import ArduPilotProtocol
from sitl_stub.firmware.ardupilot.setpoints import Setpoints
from sitl_stub.firmware.ardupilot.state import ORIGIN, ArduPilotState
from sitl_stub.firmware.ardupilot.statistics import Statistics
from sitl_stub.firmware.ardupilot.voice import ArduPilotVoice
from sitl_stub.firmware.common.autopilot import Autopilot
from sitl_stub.firmware.common.clock import Clock
from sitl_stub.firmware.common.commands import Result
from sitl_stub.firmware.common.mavlink_ids import Severity

PREARM_PHASE_US = 250_000
"""When within each second the checks run."""
TIMESYNC_EVERY_US = 10_000_000
"""Outside lockstep; in lockstep the server sends them."""


class ArduPilot(Autopilot):
    """One ArduCopter."""

    core: ArduPilotCore
    parameters: ArduPilotParameters
    voice: ArduPilotVoice
    state: ArduPilotState
    unknown_interval_result = Result.DENIED
    unknown_request_result = Result.FAILED

    def __init__(
        self, core: ArduPilotCore, parameters: ArduPilotParameters, ready_after_s: float = 42.0
    ) -> None:
        self.ready_after_s = ready_after_s
        super().__init__(core, parameters, Clock(core), ArduPilotVoice())

    def make_parts(self) -> None:
        """Everything as it is when the firmware starts."""
        self.state = state = ArduPilotState(
            core=self.core,
            parameters=self.parameters,
            clock=self.clock,
            radio=self.radio,
            origin=ORIGIN,
            boot=Boot(self.clock, self.ready_after_s),
        )
        parameter_protocol = ArduPilotParameterProtocol(self.parameters, self.voice)
        self.parameter_protocol = parameter_protocol
        self.land_detector = LandDetector(state)
        setpoints = Setpoints(state, self.land_detector)
        guided = Guided(state, setpoints)
        flight_modes = FlightModes(state, setpoints, guided)
        self.commander = Commander(state, self.voice, flight_modes, self.streams)
        self.failsafes = Failsafes(state, self.voice, self.commander, flight_modes)
        self.announcements = Announcements(state, self.voice, self.commander, self.streams)
        self.statistics = Statistics(state, parameter_protocol.announce)
        self.streams.define(ArduPilotMessages(state, guided).definitions())
        taken = ArduPilotProtocol(
            state, self.voice, guided, self.commander, self.streams, self.command_protocol
        )
        self.command_protocol.handlers.update(taken.commands())
        self.messages.update(taken.messages())
        setpoints.limit_vertical()
        setpoints.rest_on_ground()

    @property
    def takes_setpoints(self) -> bool:
        """Whether GUIDED or GUIDED_NOGPS flies."""
        return self.state.mode.value.takes_targets

    @property
    def mode_name(self) -> str:
        """Name of the mode that flies."""
        return self.state.mode.name

    def send_following(self) -> int:
        """Texts said since the last instant, then the streams: an acknowledgement comes before its explanation."""
        return self.voice.send_waiting() + super().send_following()

    def take_off_alone(self, height_m: float) -> None:
        """GUIDED and NAV_TAKEOFF as a ground station asks for them; then LOITER, the sticks centred."""
        commander = self.commander
        commander.request_mode(Mode.GUIDED.custom_mode)
        self.run_until(lambda: not commander.arming_refusals(), 120.0, "not ready to arm")
        commander.request_arm(forced=False)
        commander.request_take_off(height_m)
        self.run_until(lambda: self.hovers_at(height_m), 120.0, f"not at {height_m:g} m")
        self.pilot_mode(Mode.LOITER.name)
        self.run_until(lambda: self.hovers_at(height_m), 30.0, f"not at rest at {height_m:g} m")

    # --- the pilot ---------------------------------------------------------------------------------------------
    def pilot_mode(self, name: str) -> None:
        """The pilot, sticks centred, switches to the mode of that name."""
        mode = mode_named(name)
        if mode is not None and self.commander.request_mode(mode.custom_mode) and not self.state.landed:
            self.pilot_sticks(0.0, 0.0, 0.0, 0.5)

    def pilot_sticks(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        """The pilot moves the sticks: −1..1 (pitch forward positive), throttle 0..1."""
        self.state.sticks.put(roll, pitch, yaw, throttle)

    def pilot_disarm(self, forced: bool) -> None:
        """The pilot disarms; not in the air unless `forced`."""
        self.commander.request_disarm(forced)

    def estimate_jumped(self, jump_ned: tuple[float, float, float], yaw_rad: float) -> None:
        """The estimator has been reset: the position controllers take what they want along."""
        north, east, down = jump_ned
        self.core.memory[at.DESIRED_POSITION : at.DESIRED_POSITION + 3] += (north, east, -down)

    # --- the loop ----------------------------------------------------------------------------------------------
    def run_logic(self) -> None:
        """Everything that happens a hundred times a second."""
        self.announcements.tell_of_boot()
        crash = self.land_detector.update()
        if crash is not None:
            self.voice.say(Severity.EMERGENCY, crash)
            self.commander.disarm()
        self.commander.run()
        if self.time_us % 1_000_000 == PREARM_PHASE_US:
            self.state.prearm_good = self.armed or not self.commander.arming_refusals()
        if self.time_us % TIMESYNC_EVERY_US == 0 and not self.clock.lockstep:
            self.voice.broadcast("TIMESYNC", tc1=0, ts1=self.clock.stamp_us * 1000 + 1)
        self.commander.disarm_when_idle()
        self.failsafes.update()
        self.announcements.update()
        self.statistics.update()
