"""The core every firmware shares: time, links, streams, TIMESYNC, PING; commands and parameters have files of their own.

A firmware is a subclass that makes its parts in `power_up` and runs them in `run_logic`. Nothing in here reads a clock:
time is `time_us` of the vehicle's core, so that everything on the wire is a function of the seed and of what clients sent
at which simulated instant.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sitl_stub.firmware.common.clock import Clock
from sitl_stub.firmware.common.commands import CommandProtocol, MessageHandler, Result
from sitl_stub.firmware.common.interference import Interference, Undisturbed
from sitl_stub.firmware.common.parameter_protocol import ParameterProtocol
from sitl_stub.firmware.common.parameters import ParameterTable
from sitl_stub.firmware.common.radio import Radio
from sitl_stub.firmware.common.state import FirmwareState
from sitl_stub.firmware.common.streams import LinkStreams, StreamTable
from sitl_stub.firmware.common.vehicle_core import VehicleCore
from sitl_stub.firmware.common.voice import Voice
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link

LOGIC_PERIOD_US = 10_000
REFUSED_PROBE_US = 500_000
AIRBORNE_ABOVE_M = 0.05
"""Truth, for what comes after take-off."""
SYSTEM_ID, COMPONENT_ID = 1, 1


class Autopilot:
    """A firmware's skeleton. Subclasses make the parts, and run them."""

    unknown_interval_result = Result.FAILED
    unknown_request_result = Result.DENIED
    state: FirmwareState
    """Made by `make_parts`."""
    parameter_protocol: ParameterProtocol
    """Made by `make_parts`."""

    def __init__(self, core: VehicleCore, parameters: ParameterTable, clock: Clock, voice: Voice) -> None:
        self.core = core
        self.parameters = parameters
        self.clock = clock
        self.voice = voice
        self.radio = Radio()
        self.faults: Interference = Undisturbed(self.take_in)
        """What is to go wrong; it puts itself here."""
        self._parameter_changes = parameters.changes
        self.power_up(killed=False)

    def power_up(self, killed: bool) -> None:
        """Everything as it is when the firmware starts; only the pilot's kill switch is where it was."""
        self.streams = StreamTable(self.core.control_period_us)
        self.command_protocol = CommandProtocol(
            self.clock, self.streams, self.unknown_interval_result, self.unknown_request_result
        )
        self.messages: dict[str, MessageHandler] = {
            "HEARTBEAT": self._heartbeat,
            "COMMAND_LONG": self.command_protocol.take_long,
            "COMMAND_INT": self.command_protocol.take_int,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
            "MISSION_REQUEST_LIST": self._mission_request_list,
        }
        self.make_parts()
        self.state.killed = killed
        self.messages.update(self.parameter_protocol.messages())

    # --- for subclasses ----------------------------------------------------------------------------------------
    def make_parts(self) -> None:
        """Make `state`, `parameter_protocol` and what else flies; fill `streams`, `messages` and the commands' handlers."""
        raise NotImplementedError

    def run_logic(self) -> None:
        """Modes, failsafes, landing: called every LOGIC_PERIOD_US of simulated time."""
        raise NotImplementedError

    def link_opened(self, link: Link) -> None:
        """A client has appeared; its default streams are already on."""

    @property
    def takes_setpoints(self) -> bool:
        """Whether it is in a mode that flies what a companion sends."""
        raise NotImplementedError

    @property
    def mode_name(self) -> str:
        """Name of the mode that flies."""
        raise NotImplementedError

    def pilot_mode(self, name: str) -> None:
        """The pilot, sticks centred, switches to the mode of that name (see `mode_named`)."""
        raise NotImplementedError

    def pilot_sticks(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        """The pilot moves the sticks: −1..1 (pitch forward positive), throttle 0..1."""
        raise NotImplementedError

    def pilot_disarm(self, forced: bool) -> None:
        """The pilot disarms; not in the air unless `forced`."""
        raise NotImplementedError

    def estimate_jumped(self, jump_ned: tuple[float, float, float], yaw_rad: float) -> None:
        """The estimator has been reset: own modes take their setpoints along, so that the vehicle stays where it is."""
        raise NotImplementedError

    def take_off_alone(self, height_m: float) -> None:
        """Before anybody listens: arm, climb to `height_m` above the ground and hold there.

        Raises ValueError where it cannot arm or does not come up.
        """
        raise NotImplementedError

    def run_until(self, condition: Callable[[], bool], within_s: float, what: str) -> None:
        """Go on until `condition()` holds; raises ValueError after `within_s` of simulated time."""
        end_us = self.core.time_us + round(within_s * 1e6)
        while not condition():
            if self.core.time_us >= end_us:
                raise ValueError(f"--airborne: {what} after {within_s:.0f} s")
            self.step()

    def hovers_at(self, height_m: float) -> bool:
        """Whether it stands still at that height above home, within 5 cm and 5 cm/s."""
        high = abs(self.state.height_above_home_m - height_m) < 0.05
        return high and bool(np.linalg.norm(self.core.velocity_ned) < 0.05)

    # --- what can be seen --------------------------------------------------------------------------------------
    @property
    def armed(self) -> bool:
        """Whether the rotors may turn."""
        return self.state.armed

    @property
    def airborne(self) -> bool:
        """Whether the feet are off the ground in truth."""
        return self.core.clearance_m > AIRBORNE_ABOVE_M

    @property
    def sticks_now(self) -> tuple[float, float, float, float]:
        """Roll, pitch, yaw, throttle as `pilot_sticks` takes them."""
        return self.state.sticks.now

    @property
    def links(self) -> list[Link]:
        """The clients there are."""
        return self.voice.links

    # --- time --------------------------------------------------------------------------------------------------
    @property
    def time_us(self) -> int:
        """Simulated time since the beginning."""
        return self.core.time_us

    @property
    def next_instant_us(self) -> int:
        """The next instant at which logic runs, messages may be due or a fault has something to do."""
        now = self.core.time_us
        loop = self.streams.loop_period_us
        instant = min((now // loop + 1) * loop, (now // LOGIC_PERIOD_US + 1) * LOGIC_PERIOD_US)
        return self.faults.next_instant_us(instant)

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
        sent = self.faults.run()
        alone = bool(instant % LOGIC_PERIOD_US and instant % self.streams.loop_period_us)
        if alone or self.clock.uptime_us < 0:
            return sent  # an instant of the faults alone, or it is restarting
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
        self.clock.restart(self.whole_period_us(round(silent_s * 1e6)))
        self.core.reset_controllers()
        self.voice.forget()
        self.power_up(self.state.killed)
        for link in self.links:
            link.writer.sequence = 0
            link.traffic.clear()
            link.firmware_data = self.streams.open(link, self.clock.booted_us)

    def pilot_kill(self, killed: bool) -> None:
        """The pilot moves the kill switch: rotors stopped though armed."""
        self.state.killed = killed

    # --- links -------------------------------------------------------------------------------------------------
    def attach(self, link: Link) -> None:
        """Take a client on."""
        link.writer.system = SYSTEM_ID
        link.writer.component = COMPONENT_ID
        self.links.append(link)
        link.firmware_data = self.streams.open(link, self.time_us)
        self.faults.take_on(link)
        self.link_opened(link)

    def detach(self, link: Link) -> None:
        """Let a client go."""
        if link in self.links:
            self.links.remove(link)
            self.streams.close(link)
            self.faults.let_go(link)

    def handle(self, link: Link, message: Received) -> None:
        """A message of a client has come at the present instant: faults of the link may lose, delay or damage it."""
        link.last_heard_us = self.time_us
        self.faults.take_in(link, message)

    def take_in(self, link: Link, message: Received) -> None:
        """Take in one message of a client; while the firmware is starting nobody listens."""
        if self.clock.uptime_us < 0:
            return
        link.traffic.take(message)
        link.writer.version = message.mavlink_version
        handler = self.messages.get(message.name)
        if handler is None:
            return
        values = message.values
        if values.get("target_system", 0) not in (0, SYSTEM_ID):
            return
        if values.get("target_component", 0) not in (0, COMPONENT_ID):
            return
        handler(link, message)
        if self.parameters.changes != self._parameter_changes:
            self._parameter_changes = self.parameters.changes
            self.core.use_parameters(self.parameters)

    # --- time and the rest -------------------------------------------------------------------------------------
    def _timesync(self, link: Link, message: Received) -> None:
        if message.values["tc1"] == 0:
            link.send("TIMESYNC", tc1=self.clock.stamp_us * 1000, ts1=message.values["ts1"])

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
        self.state.heartbeats[(message.system, message.component)] = self.time_us

    def _mission_request_list(self, link: Link, message: Received) -> None:
        link.send(
            "MISSION_COUNT",
            target_system=message.system,
            target_component=message.component,
            count=0,
            mission_type=message.values.get("mission_type", 0),
        )
