"""MAVLink's conversations: commands with their acknowledgement, parameters, stream rates.

Each is a small state object that is fed every message; who waits, and for how long, is decided by the caller.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from companion.mavlink.link import Link, Message, mav

RESULT_WORDS = {
    mav.MAV_RESULT_ACCEPTED: "accepted",
    mav.MAV_RESULT_TEMPORARILY_REJECTED: "temporarily rejected",
    mav.MAV_RESULT_DENIED: "denied",
    mav.MAV_RESULT_UNSUPPORTED: "unsupported",
    mav.MAV_RESULT_FAILED: "failed",
    mav.MAV_RESULT_IN_PROGRESS: "in progress",
    6: "cancelled",  # MAV_RESULT_CANCELLED, which the dialect does not name
}

_INTEGER_TYPES = {
    mav.MAV_PARAM_TYPE_UINT8: "<B3x",
    mav.MAV_PARAM_TYPE_INT8: "<b3x",
    mav.MAV_PARAM_TYPE_UINT16: "<H2x",
    mav.MAV_PARAM_TYPE_INT16: "<h2x",
    mav.MAV_PARAM_TYPE_UINT32: "<I",
    mav.MAV_PARAM_TYPE_INT32: "<i",
}


@dataclass(frozen=True, slots=True)
class Command:
    """One COMMAND_LONG: the MAV_CMD number and its seven parameters (missing ones are 0)."""

    number: int
    parameters: tuple[float, ...] = ()
    name: str = "command"


class CommandClient:
    """Sends one command at a time and remembers the answer. PX4 may acknowledge a command twice."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._waiting: int | None = None
        self._confirmation = 0
        self.result: int | None = None

    def send(self, command: Command, again: bool = False) -> None:
        """Send `command` (COMMAND_LONG) and forget earlier answers; `again` marks it as a repetition."""
        self._confirmation = self._confirmation + 1 if again else 0
        self._waiting, self.result = command.number, None
        parameters = (*command.parameters, *(0.0,) * (7 - len(command.parameters)))
        self._link.send(
            mav.MAVLink_command_long_message(
                self._link.target_system or 1,
                mav.MAV_COMP_ID_AUTOPILOT1,
                command.number,
                min(self._confirmation, 255),
                *parameters,
            )
        )

    def take(self, message: Message) -> None:
        """Take a COMMAND_ACK; anything else is ignored."""
        if (
            message.get_msgId() == mav.MAVLINK_MSG_ID_COMMAND_ACK
            and message.command == self._waiting
            and message.result != mav.MAV_RESULT_IN_PROGRESS
        ):
            self.result = message.result


class ParameterClient:
    """Reads and sets parameters. `bytewise` says how integers are encoded: PX4 puts their bits into the float
    field, ArduPilot their value (AUTOPILOT_VERSION's capabilities tell).
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self.bytewise = False
        self.values: dict[str, float] = {}
        self._types: dict[str, int] = {}

    def request(self, name: str) -> None:
        """Ask for one parameter by name (PARAM_REQUEST_READ)."""
        self._link.send(
            mav.MAVLink_param_request_read_message(
                self._link.target_system or 1, mav.MAV_COMP_ID_AUTOPILOT1, name.encode(), -1
            )
        )

    def set(self, name: str, value: float) -> None:
        """Set one parameter that has been read before (PARAM_SET); its echo updates `values`."""
        kind = self._types[name]
        if self.bytewise and kind in _INTEGER_TYPES:
            encoded = struct.unpack("<f", struct.pack(_INTEGER_TYPES[kind], round(value)))[0]
        else:
            encoded = float(value)
        self._link.send(
            mav.MAVLink_param_set_message(
                self._link.target_system or 1, mav.MAV_COMP_ID_AUTOPILOT1, name.encode(), encoded, kind
            )
        )

    def take(self, message: Message) -> None:
        """Take a PARAM_VALUE; anything else is ignored."""
        if message.get_msgId() != mav.MAVLINK_MSG_ID_PARAM_VALUE:
            return
        name, kind, value = str(message.param_id), int(message.param_type), float(message.param_value)
        if self.bytewise and kind in _INTEGER_TYPES:
            value = float(struct.unpack(_INTEGER_TYPES[kind], struct.pack("<f", message.param_value))[0])
        self._types[name] = kind
        self.values[name] = value


def message_interval(message_id: int, rate_hz: float) -> Command:
    """MAV_CMD_SET_MESSAGE_INTERVAL for a stream at `rate_hz`.

    Rounded to whole milliseconds, since that is all ArduPilot takes (a finer interval is refused there).
    """
    interval_us = max(1, round(1000.0 / rate_hz)) * 1000.0
    return Command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, (float(message_id), interval_us), f"stream {message_id}")


def request_message(message_id: int) -> Command:
    """MAV_CMD_REQUEST_MESSAGE: send one message once."""
    return Command(mav.MAV_CMD_REQUEST_MESSAGE, (float(message_id),), f"message {message_id}")
