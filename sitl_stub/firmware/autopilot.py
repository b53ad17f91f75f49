"""The core every firmware shares: time, links, streams, the command and parameter protocols, TIMESYNC, PING.

A firmware is a subclass that fills the tables `commands` and `messages`, defines its streams, and runs its modes in
`run_logic`. Nothing in here reads a clock: time is `time_us` of the flight core, so that everything on the wire is a
function of the seed and of what clients sent at which simulated instant.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from sitl_stub.firmware.parameters import INT32, ParameterError, ParameterTable
from sitl_stub.firmware.streams import Builder, LinkStreams, StreamTable
from sitl_stub.firmware.vehicle_core import VehicleCore
from sitl_stub.mavlink.codec import LAYOUTS, Received
from sitl_stub.mavlink.links import Link
from sitl_stub.physics import vehicle as body

if TYPE_CHECKING:
    from sitl_stub.faults.director import FaultDirector

LOGIC_PERIOD_US = 10_000
PARAMETERS_PER_INSTANT = 10
LATEST_CLOCK_US = (2**32 - 1) * 1000
"""What `time_boot_ms` can hold."""
REFUSED_PROBE_US = 500_000
LONGEST_INTERVAL_US = 2.0**31 - 1.0
"""What MESSAGE_INTERVAL can tell."""
UINT32 = 5
AIRBORNE_ABOVE_M = 0.05
"""Truth, for what comes after take-off."""
SIMULATED_EPOCH_US = 1_795_335_292_521_929
"""Unix time of boot, µs: that of the PX4 capture. Fixed, so that SYSTEM_TIME repeats."""


HIGHEST_M = 83_000.0


def whole(number: float) -> int:
    """A command's float as a whole number; −1 where there is none."""
    return int(number) if math.isfinite(number) else -1


def is_place(latitude_deg: float, longitude_deg: float, altitude_m: float) -> bool:
    """Whether these can be a place: NaN is none."""
    return abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0 and abs(altitude_m) <= HIGHEST_M


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5


@dataclass(frozen=True, slots=True)
class Command:
    """COMMAND_LONG or COMMAND_INT as one thing."""

    number: int
    params: tuple[float, ...]
    """Seven numbers; 5 and 6 of a COMMAND_INT are already in degrees."""
    sender_system: int
    sender_component: int


CommandHandler = Callable[[Link, Command], Result | None]
"""Returns the result to acknowledge, or None when the handler has acknowledged itself (or keeps silent)."""
MessageHandler = Callable[[Link, Received], None]


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
        self.commands: dict[int, CommandHandler] = {
            410: self._ignore_command,
            510: self._get_message_interval,
            511: self._set_message_interval,
            512: self._request_message,
        }
        self.messages: dict[str, MessageHandler] = {
            "HEARTBEAT": self._heartbeat,
            "COMMAND_LONG": self._command_long,
            "COMMAND_INT": self._command_int,
            "PARAM_REQUEST_LIST": self._param_request_list,
            "PARAM_REQUEST_READ": self._param_request_read,
            "PARAM_SET": self._param_set,
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
        return min(max(self.uptime_us + self._clock_offset_us, 0), LATEST_CLOCK_US)

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

    def step(self) -> int:
        """Go on to the next instant, run what is due there and send; returns the number of messages sent."""
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
        return sent + self.send_due()

    def advance_to(self, time_us: int) -> None:
        """Run every instant up to `time_us` and the loops up to it (whole control periods)."""
        while self.next_instant_us <= time_us:
            self.step()
        self.core.advance_to(time_us)

    def send_due(self) -> int:
        """Send every message due now on every link."""
        sent = 0
        now = self.core.time_us
        for link in self.links:
            streams: LinkStreams = link.firmware_data
            if link.refused and now % REFUSED_PROBE_US:
                continue  # nobody listens there: knock once in a while instead of talking
            sent += streams.send_due(link, now)
            if streams.parameters_waiting:
                sent += self._send_waiting_parameters(link, streams)
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

    # --- commands ----------------------------------------------------------------------------------------------
    def acknowledge(self, link: Link, command: Command, result: Result) -> None:
        """Send COMMAND_ACK to whoever sent the command."""
        link.send(
            "COMMAND_ACK",
            command=command.number,
            result=int(result),
            target_system=command.sender_system,
            target_component=command.sender_component,
        )

    def _run_command(self, link: Link, command: Command) -> None:
        handler = self.commands.get(command.number)
        result = Result.UNSUPPORTED if handler is None else handler(link, command)
        if result is not None:
            self.acknowledge(link, command, result)

    def _command_long(self, link: Link, message: Received) -> None:
        v = message.values
        params = tuple(float(v[f"param{i}"]) for i in range(1, 8))
        self._run_command(link, Command(v["command"], params, message.system, message.component))

    def _command_int(self, link: Link, message: Received) -> None:
        v = message.values
        place = (v["x"] * 1e-7, v["y"] * 1e-7, float(v["z"]))
        params = (*(float(v[f"param{i}"]) for i in range(1, 5)), *place)
        self._run_command(link, Command(v["command"], params, message.system, message.component))

    def _ignore_command(self, link: Link, command: Command) -> Result | None:
        return Result.ACCEPTED

    def _set_message_interval(self, link: Link, command: Command) -> Result | None:
        message_id, interval = self._message_id(command), min(command.params[1], LONGEST_INTERVAL_US)
        if (
            message_id is None
            or not math.isfinite(interval)
            or not self.streams.set_interval(link, message_id, interval, self.time_us)
        ):
            return self.unknown_interval_result
        return Result.ACCEPTED

    @staticmethod
    def _message_id(command: Command) -> int | None:
        number = command.params[0]
        return int(number) if 0 <= number < 2**24 else None

    def _get_message_interval(self, link: Link, command: Command) -> Result | None:
        message_id = self._message_id(command)
        stream = None if message_id is None else self.streams.of(link).streams.get(message_id)
        interval = 0
        if stream is not None:
            interval = round(stream.interval_us) if stream.interval_us > 0 else -1
        link.send("MESSAGE_INTERVAL", message_id=(message_id or 0) & 0xFFFF, interval_us=interval)
        return Result.ACCEPTED

    def _request_message(self, link: Link, command: Command) -> Result | None:
        message_id = self._message_id(command)
        if message_id is None or not self.streams.build(link, message_id):
            return self.unknown_request_result
        return Result.ACCEPTED

    # --- parameters --------------------------------------------------------------------------------------------
    def _wire_value(self, name: str) -> float:
        value = self.parameters[name]
        if isinstance(value, int) and self.integers_as_bits:
            return float(struct.unpack("<f", struct.pack("<i", value))[0])
        return float(value)

    def send_parameter(self, link: Link, name: str) -> None:
        """Send one PARAM_VALUE."""
        layout = LAYOUTS["PARAM_VALUE"]
        value = self.parameters[name]
        kind = self.parameters.kind(name)
        if isinstance(value, int) and self.integers_as_bits:
            # Packed by hand: a bit pattern that is a signalling NaN must not pass through a Python float.
            frame_value = struct.pack("<i", value)
        else:
            frame_value = struct.pack("<f", value)
        payload = frame_value + struct.pack(
            "<HH16sB", len(self.parameters), self.parameters.index(name), name.encode(), kind
        )
        link.send_payload(layout, payload)

    def _send_waiting_parameters(self, link: Link, streams: LinkStreams) -> int:
        count = min(PARAMETERS_PER_INSTANT, len(streams.parameters_waiting))
        for _ in range(count):
            name = self.parameters.name_at(streams.parameters_waiting.pop())
            if name is not None:
                self.send_parameter(link, name)
        return count

    def _param_request_list(self, link: Link, message: Received) -> None:
        streams: LinkStreams = link.firmware_data
        if self.hash_leads_list:
            self._send_parameter_hash(link)
        streams.parameters_waiting = list(range(len(self.parameters) - 1, -1, -1))

    def _send_parameter_hash(self, link: Link) -> None:
        name = b"_HASH_CHECK"
        payload = struct.pack("<IHH16sB", self.parameters.hash(), len(self.parameters), 0xFFFF, name, UINT32)
        link.send_payload(LAYOUTS["PARAM_VALUE"], payload)

    def _param_request_read(self, link: Link, message: Received) -> None:
        index = message.values["param_index"]
        name = message.values["param_id"] if index < 0 else self.parameters.name_at(index)
        if name == "_HASH_CHECK":
            self._send_parameter_hash(link)
        elif name is not None and name in self.parameters:
            self.send_parameter(link, name)

    def _param_set(self, link: Link, message: Received) -> None:
        name = message.values["param_id"]
        if name == "_HASH_CHECK":
            streams: LinkStreams = link.firmware_data
            streams.parameters_waiting = []
            return
        if name not in self.parameters:
            return
        value = float(message.values["param_value"])
        if self.parameters.kind(name) == INT32 and self.integers_as_bits:
            value = float(struct.unpack("<i", struct.pack("<f", value))[0])
        elif self.parameters.kind(name) == INT32:
            value = float(round(value)) if value == value and abs(value) < 2**31 else value
        try:
            self.parameters.set(name, value)
        except ParameterError as error:
            self.on_text(str(error))
        for other in self.links:
            self.send_parameter(other, name)

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
