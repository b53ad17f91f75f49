"""The command protocol every firmware shares: COMMAND_LONG and COMMAND_INT as one thing, results, intervals of messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from sitl_stub.firmware.common.clock import Clock
from sitl_stub.firmware.common.streams import StreamTable
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link

LONGEST_INTERVAL_US = 2.0**31 - 1.0
"""What MESSAGE_INTERVAL can tell."""
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


class CommandProtocol:
    """Runs the handlers of one autopilot's table `handlers`, and acknowledges."""

    def __init__(
        self, clock: Clock, streams: StreamTable, unknown_interval: Result, unknown_request: Result
    ) -> None:
        """`unknown_...` answers SET_MESSAGE_INTERVAL, REQUEST_MESSAGE for a message that there is not."""
        self.handlers: dict[int, CommandHandler] = {}
        self._clock = clock
        self._streams = streams
        self._unknown_interval = unknown_interval
        self._unknown_request = unknown_request

    def acknowledge(self, link: Link, command: Command, result: Result) -> None:
        """Send COMMAND_ACK to whoever sent the command."""
        link.send(
            "COMMAND_ACK",
            command=command.number,
            result=int(result),
            target_system=command.sender_system,
            target_component=command.sender_component,
        )

    def _run(self, link: Link, command: Command) -> None:
        handler = self.handlers.get(command.number)
        result = Result.UNSUPPORTED if handler is None else handler(link, command)
        if result is not None:
            self.acknowledge(link, command, result)

    def take_long(self, link: Link, message: Received) -> None:
        """COMMAND_LONG."""
        v = message.values
        params = tuple(float(v[f"param{i}"]) for i in range(1, 8))
        self._run(link, Command(v["command"], params, message.system, message.component))

    def take_int(self, link: Link, message: Received) -> None:
        """COMMAND_INT."""
        v = message.values
        place = (v["x"] * 1e-7, v["y"] * 1e-7, float(v["z"]))
        params = (*(float(v[f"param{i}"]) for i in range(1, 5)), *place)
        self._run(link, Command(v["command"], params, message.system, message.component))

    def ignore(self, link: Link, command: Command) -> Result | None:
        """One that is accepted and does nothing."""
        return Result.ACCEPTED

    def set_message_interval(self, link: Link, command: Command) -> Result | None:
        """SET_MESSAGE_INTERVAL."""
        message_id, interval = self._message_id(command), min(command.params[1], LONGEST_INTERVAL_US)
        if (
            message_id is None
            or not math.isfinite(interval)
            or not self._streams.set_interval(link, message_id, interval, self._clock.time_us)
        ):
            return self._unknown_interval
        return Result.ACCEPTED

    @staticmethod
    def _message_id(command: Command) -> int | None:
        number = command.params[0]
        return int(number) if 0 <= number < 2**24 else None

    def get_message_interval(self, link: Link, command: Command) -> Result | None:
        """GET_MESSAGE_INTERVAL."""
        message_id = self._message_id(command)
        stream = None if message_id is None else self._streams.of(link).streams.get(message_id)
        interval = 0
        if stream is not None:
            interval = round(stream.interval_us) if stream.interval_us > 0 else -1
        link.send("MESSAGE_INTERVAL", message_id=(message_id or 0) & 0xFFFF, interval_us=interval)
        return Result.ACCEPTED

    def request_message(self, link: Link, command: Command) -> Result | None:
        """REQUEST_MESSAGE."""
        message_id = self._message_id(command)
        if message_id is None or not self._streams.send_now(link, message_id):
            return self._unknown_request
        return Result.ACCEPTED
