"""MAVLink's conversations: commands with their acknowledgement, parameters, stream rates.

Each is a small state object that is fed every message; who waits, and for how long, is decided by the caller.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
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
    """Sends one command at a time and remembers the answer.

    A COMMAND_ACK names the command's number, and that only: the late answer to an earlier command of the same number
    (another stream's interval, disarming instead of arming) looks like the answer to this one. So where answers are
    still owed, a refusal is believed once it comes a second time, and the caller asks again when it does not.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._waiting: int | None = None
        self._confirmation = 0
        self._owed: Counter[int] = Counter()  # answers that never came, by the command's number
        self._doubted: int | None = None  # a refusal that may belong to an earlier command
        self.result: int | None = None
        self.in_progress = 0
        """How often the autopilot has said that it is still at it."""

    def send(self, command: Command, again: bool = False) -> None:
        """Send `command` (COMMAND_LONG) and forget earlier answers; `again` marks it as a repetition."""
        self._confirmation = self._confirmation + 1 if again else 0
        if not again:
            self._doubted = None
        if self._waiting is not None and self.result is None:
            self._owed[self._waiting] += 1
        self._waiting, self.result, self.in_progress = command.number, None, 0
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
        """Take a COMMAND_ACK to us, or to nobody (MAVLink 1 has no addressee); anything else is ignored."""
        if message.get_msgId() != mav.MAVLINK_MSG_ID_COMMAND_ACK or not self._link.is_for_us(message):
            return
        number, result = message.command, message.result
        if number != self._waiting or self.result is not None:
            if self._owed[number] > 0:
                self._owed[number] -= 1
        elif result == mav.MAV_RESULT_IN_PROGRESS:
            self.in_progress += 1
        elif result == mav.MAV_RESULT_ACCEPTED or self._owed[number] == 0 or result == self._doubted:
            self.result = result
        else:
            self._owed[number] -= 1
            self._doubted = result


class ParameterClient:
    """Reads and sets parameters. `bytewise` says how integers are encoded: PX4 puts their bits into the float
    field, ArduPilot their value (AUTOPILOT_VERSION's capabilities tell). PARAM_VALUE has no addressee: what another
    station reads or sets comes here, too, and counts for names that we have asked for.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self.bytewise = False
        self.values: dict[str, float] = {}
        self._types: dict[str, int] = {}
        self._asked: set[str] = set()

    def request(self, name: str) -> None:
        """Ask for one parameter by name (PARAM_REQUEST_READ)."""
        self._asked.add(name)
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
        if name not in self._asked or not math.isfinite(value):
            return
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
