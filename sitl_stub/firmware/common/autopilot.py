"""The core every firmware shares: time, links, streams, TIMESYNC, PING; commands and parameters have files of their own.

A firmware is a subclass that fills the tables `commands` and `messages`, defines its streams, and runs its modes in
`run_logic`. Nothing in here reads a clock: time is `time_us` of the flight core, so that everything on the wire is a
function of the seed and of what clients sent at which simulated instant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sitl_stub.firmware.common.commands import CommandHandler, CommandProtocol, MessageHandler, Result
from sitl_stub.firmware.common.parameter_protocol import ParameterProtocol
from sitl_stub.firmware.common.parameters import ParameterTable
from sitl_stub.firmware.common.streams import Builder, LinkStreams, StreamTable
from sitl_stub.firmware.common.vehicle_core import VehicleCore
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link
from sitl_stub.physics import vehicle as body

if TYPE_CHECKING:
    from sitl_stub.faults.director import FaultDirector

LOGIC_PERIOD_US = 10_000
LATEST_CLOCK_US = (2**32 - 1) * 1000
"""What `time_boot_ms` can hold."""
REFUSED_PROBE_US = 500_000
AIRBORNE_ABOVE_M = 0.05
"""Truth, for what comes after take-off."""
SIMULATED_EPOCH_US = 1_795_335_292_521_929
"""Unix time of boot, µs: that of the PX4 capture. Fixed, so that SYSTEM_TIME repeats."""


class Autopilot:
    """A firmware's skeleton. Subclasses set `identity` values, tables and logic."""

    integers_as_bits = True
    """PX4 sends integer parameters as bit patterns inside the float; ArduPilot converts them."""
    hash_leads_list = False
    """PX4 sends `_HASH_CHECK` before the list, so that a ground station with the same list can stop it."""
    unknown_interval_result = Result.FAILED
    unknown_request_result = Result.DENIED

    def __init__(self, core: VehicleCore, parameters: ParameterTable, system_id: int = 1) -> None:
        self.core = core
        self.parameters = parameters
        self.system_id = system_id
        self.component_id = 1
        self.links: list[Link] = []
        self.heartbeats: dict[tuple[int, int], int] = {}
        """Simulated time of the last HEARTBEAT by sender (system, component), µs."""
        self.on_text: Callable[[str], None] = lambda text: None
        """Called with every notable event in words (the command line prints them)."""
        self.booted_us = 0
        """When the firmware last started: later than now while it is restarting."""
        self.killed = False
        """The pilot's kill switch: rotors stopped though armed."""
        self._clock_errors_us: dict[object, int] = {}
        self._clock_offset_us = 0
        self.lockstep = False
        """Set by the server: TIMESYNC requests are then its business."""
        self.faults: FaultDirector | None = None
        """What is to go wrong; it puts itself here."""
        self._parameter_changes = parameters.changes
        self.command_protocol = CommandProtocol(self)
        self.parameter_protocol = ParameterProtocol(self)
        self.commands: dict[int, CommandHandler] = {
            410: self.command_protocol.ignore,
            510: self.command_protocol.get_message_interval,
            511: self.command_protocol.set_message_interval,
            512: self.command_protocol.request_message,
        }
        self.messages: dict[str, MessageHandler] = {
            "HEARTBEAT": self._heartbeat,
            "COMMAND_LONG": self.command_protocol.take_long,
            "COMMAND_INT": self.command_protocol.take_int,
            "PARAM_REQUEST_LIST": self.parameter_protocol.request_list,
            "PARAM_REQUEST_READ": self.parameter_protocol.request_read,
            "PARAM_SET": self.parameter_protocol.take,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
            "MISSION_REQUEST_LIST": self._mission_request_list,
        }
        self.streams = StreamTable(self.stream_definitions(), core.control_period_us)

    # --- for subclasses ----------------------------------------------------------------------------------------
    def stream_definitions(self) -> Sequence[tuple[str, Builder, Mapping[str, float]]]:
        """Messages the firmware can send: name, builder, default rate by link role; in the order of sending."""
        raise NotImplementedError

    def run_logic(self) -> None:
        """Modes, failsafes, landing: called every LOGIC_PERIOD_US of simulated time."""
        raise NotImplementedError

    def parameters_changed(self) -> None:
        """Take changed parameters into the loops."""
        self.core.use_parameters(self.parameters)

    def link_opened(self, link: Link) -> None:
        """A client has appeared; its default streams are already on."""

    @property
    def armed(self) -> bool:
        """Whether the rotors may turn."""
        raise NotImplementedError

    @property
    def takes_setpoints(self) -> bool:
        """Whether it is in a mode that flies what a companion sends."""
        raise NotImplementedError

    @property
    def airborne(self) -> bool:
        """Whether the feet are off the ground in truth."""
        core = self.core
        clearance = float(core.environment[body.GROUND_DOWN] - core.state[body.POSITION + 2])
        return clearance - core.vehicle.foot_height_m > AIRBORNE_ABOVE_M

    # --- time --------------------------------------------------------------------------------------------------
    @property
    def time_us(self) -> int:
        """Simulated time since boot."""
        return self.core.time_us

    @property
    def uptime_us(self) -> int:
        """Simulated time since the firmware last started; negative while it is restarting."""
        return self.core.time_us - self.booted_us

    @property
    def clock_us(self) -> int:
        """The autopilot's own clock, which goes into every time stamp: `uptime_us` unless a fault puts it wrong."""
        clock = self.core.time_us - self.booted_us + self._clock_offset_us
        return clock if 0 <= clock <= LATEST_CLOCK_US else min(max(clock, 0), LATEST_CLOCK_US)

    def put_clock_wrong(self, cause: object, by_us: int) -> None:
        """Let `cause` shift the clock by so much; 0 takes its share back."""
        self._clock_errors_us[cause] = by_us
        self._clock_offset_us = sum(self._clock_errors_us.values())

    @property
    def next_instant_us(self) -> int:
        """The next instant at which logic runs, messages may be due or a fault has something to do."""
        now = self.core.time_us
        loop = self.streams.loop_period_us
        instant = min((now // loop + 1) * loop, (now // LOGIC_PERIOD_US + 1) * LOGIC_PERIOD_US)
        return instant if self.faults is None else self.faults.next_instant_us(instant)

    def whole_period_us(self, time_us: int) -> int:
        """The first whole control period not before `time_us`."""
        period = self.core.control_period_us
        return -(-time_us // period) * period

    @property
    def next_period_us(self) -> int:
        """The end of the control period that begins now."""
        return self.core.time_us + self.core.control_period_us

    def step(self, led: Callable[[], None] = lambda: None) -> int:
        """Go on to the next instant, run what is due there and send; returns the number of messages sent.

        `led` is called once what a controller acts upon has been sent, where there was anything of that; the rest follows.
        """
        instant = self.next_instant_us
        self.core.advance_to(instant)
        sent = 0
        if self.uptime_us < 0:
            return 0 if self.faults is None else self.faults.run()
        if self.faults is not None:
            sent = self.faults.run()
            if instant % LOGIC_PERIOD_US and instant % self.streams.loop_period_us:
                return sent  # an instant of the faults alone
            if self.uptime_us < 0:
                return sent  # one of them has just restarted it
        if instant % LOGIC_PERIOD_US == 0:
            self.run_logic()
        leading = self.send_leading()
        if leading:
            led()
        return sent + leading + self.send_following()

    def advance_to(self, time_us: int) -> None:
        """Run every instant up to `time_us` and the loops up to it (whole control periods)."""
        while self.next_instant_us <= time_us:
            self.step()
        self.core.advance_to(time_us)

    def _listening(self) -> list[tuple[Link, LinkStreams]]:
        """Links to send on now: where nobody listens, one knocks once in a while instead of talking."""
        probing = not self.core.time_us % REFUSED_PROBE_US
        return [(link, link.firmware_data) for link in self.links if probing or not link.refused]

    def send_leading(self) -> int:
        """Send what of `streams.LEADING` is due now, on every link; returns the number of messages."""
        now = self.core.time_us
        return sum(streams.send_due(link, now, streams.leading) for link, streams in self._listening())

    def send_following(self) -> int:
        """Send everything else that is due now, on every link; returns the number of messages."""
        sent = 0
        now = self.core.time_us
        for link, streams in self._listening():
            sent += streams.send_due(link, now, streams.following)
            if streams.parameters_waiting:
                sent += self.parameter_protocol.send_waiting(link, streams)
        return sent

    # --- what happens to it --------------------------------------------------------------------------------------
    def restart(self, silent_s: float) -> None:
        """Start the firmware anew, in flight or not: rotors stop, its time begins at 0 after `silent_s` of silence.

        Parameters are kept, modes, setpoints, home and the intervals clients asked for are not.
        """
        self.booted_us = self.core.time_us + self.whole_period_us(round(silent_s * 1e6))
        self._clock_errors_us.clear()
        self._clock_offset_us = 0
        self.heartbeats.clear()
        self.core.reset_controllers()
        for link in self.links:
            link.writer.sequence = 0
            link.traffic.clear()
            self.streams.close(link)
            link.firmware_data = self.streams.open(link, self.booted_us)
        self.power_up()

    def power_up(self) -> None:
        """Everything as it is when the firmware starts."""
        raise NotImplementedError

    def pilot_mode(self, name: str) -> None:
        """The pilot, sticks centred, switches to the mode of that name (see `mode_named`)."""
        raise NotImplementedError

    @property
    def mode_name(self) -> str:
        """Name of the mode that flies."""
        raise NotImplementedError

    def pilot_sticks(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        """The pilot moves the sticks: −1..1 (pitch forward positive), throttle 0..1."""
        raise NotImplementedError

    @property
    def sticks_now(self) -> tuple[float, float, float, float]:
        """Roll, pitch, yaw, throttle as `pilot_sticks` takes them."""
        raise NotImplementedError

    def pilot_disarm(self, forced: bool) -> None:
        """The pilot disarms; not in the air unless `forced`."""
        raise NotImplementedError

    def estimate_jumped(self, jump_ned: tuple[float, float, float], yaw_rad: float) -> None:
        """The estimator has been reset: own modes take their setpoints along, so that the vehicle stays where it is."""
        raise NotImplementedError

    # --- links -------------------------------------------------------------------------------------------------
    def attach(self, link: Link) -> None:
        """Take a client on."""
        link.writer.system = self.system_id
        link.writer.component = self.component_id
        self.links.append(link)
        link.firmware_data = self.streams.open(link, self.time_us)
        if self.faults is not None:
            self.faults.frames.take_on(link)
        self.link_opened(link)

    def detach(self, link: Link) -> None:
        """Let a client go."""
        if link in self.links:
            self.links.remove(link)
            self.streams.close(link)
            if self.faults is not None:
                self.faults.frames.let_go(link)

    def broadcast(self, name: str, **fields: Any) -> None:
        """Send one message to every client."""
        for link in self.links:
            link.send(name, **fields)

    def say(self, severity: int, text: str) -> None:
        """STATUSTEXT (MAV_SEVERITY) to every client."""
        self.on_text(text)
        self.broadcast("STATUSTEXT", severity=severity, text=text[:50])

    def handle(self, link: Link, message: Received) -> None:
        """A message of a client has come at the present instant: faults of the link may lose, delay or damage it."""
        link.last_heard_us = self.time_us
        if self.faults is None:
            self.take_in(link, message)
        else:
            self.faults.frames.take_in(link, message)

    def take_in(self, link: Link, message: Received) -> None:
        """Take in one message of a client; while the firmware is starting nobody listens."""
        if self.uptime_us < 0:
            return
        link.traffic.take(message)
        link.writer.version = message.mavlink_version
        handler = self.messages.get(message.name)
        if handler is None:
            return
        values = message.values
        if values.get("target_system", 0) not in (0, self.system_id):
            return
        if values.get("target_component", 0) not in (0, self.component_id):
            return
        handler(link, message)
        if self.parameters.changes != self._parameter_changes:
            self._parameter_changes = self.parameters.changes
            self.parameters_changed()

    # --- time and the rest -------------------------------------------------------------------------------------
    def _timesync(self, link: Link, message: Received) -> None:
        if message.values["tc1"] == 0:
            link.send("TIMESYNC", tc1=self.clock_us * 1000, ts1=message.values["ts1"])

    def _ping(self, link: Link, message: Received) -> None:
        v = message.values
        if v["target_system"] == 0 and v["target_component"] == 0:
            link.send(
                "PING",
                time_usec=v["time_usec"],
                seq=v["seq"],
                target_system=message.system,
                target_component=message.component,
            )

    def _heartbeat(self, link: Link, message: Received) -> None:
        self.heartbeats[(message.system, message.component)] = self.time_us

    def _mission_request_list(self, link: Link, message: Received) -> None:
        link.send(
            "MISSION_COUNT",
            target_system=message.system,
            target_component=message.component,
            count=0,
            mission_type=message.values.get("mission_type", 0),
        )
