"""The parameter protocol: PARAM_VALUE, and the list, a few at a time. What differs between brands is in their wings."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from sitl_stub.firmware.common.commands import MessageHandler
from sitl_stub.firmware.common.parameters import ParameterTable
from sitl_stub.firmware.common.streams import LinkStreams
from sitl_stub.firmware.common.voice import Voice
from sitl_stub.mavlink.codec import LAYOUTS, Received
from sitl_stub.mavlink.links import Link

PARAMETERS_PER_INSTANT = 10
NO_INDEX = 0xFFFF


class ParameterProtocol:
    """Lets clients list, read and change one autopilot's parameters."""

    def __init__(self, parameters: ParameterTable, voice: Voice) -> None:
        self.parameters = parameters
        self.voice = voice

    def messages(self) -> Mapping[str, MessageHandler]:
        """Message name to handler."""
        return {
            "PARAM_REQUEST_LIST": self.request_list,
            "PARAM_REQUEST_READ": self.request_read,
            "PARAM_SET": self.take,
        }

    def packed(self, value: float) -> bytes:
        """A value as the four bytes of `param_value`."""
        return struct.pack("<f", value)

    def send(self, link: Link, name: str, index: int | None = None) -> None:
        """Send one PARAM_VALUE, with its place in the list unless another `index` is given."""
        index = self.parameters.index(name) if index is None else index
        self.send_raw(link, name, self.packed(self.parameters[name]), index, self.parameters.kind(name))

    def send_raw(self, link: Link, name: str, value: bytes, index: int, kind: int) -> None:
        """PARAM_VALUE; packed by hand: a bit pattern that is a signalling NaN must not pass through a Python float."""
        payload = value + struct.pack("<HH16sB", len(self.parameters), index, name.encode(), kind)
        link.send_payload(LAYOUTS["PARAM_VALUE"], payload)

    def send_waiting(self, link: Link, streams: LinkStreams) -> int:
        """The next few of a list that was asked for; returns how many."""
        count = min(PARAMETERS_PER_INSTANT, len(streams.parameters_waiting))
        for _ in range(count):
            name = self.parameters.name_at(streams.parameters_waiting.pop())
            if name is not None:
                self.send(link, name)
        return count

    def request_list(self, link: Link, message: Received) -> None:
        """PARAM_REQUEST_LIST."""
        link.firmware_data.parameters_waiting = list(range(len(self.parameters) - 1, -1, -1))

    def asked_for(self, message: Received) -> str:
        """Name that a PARAM_REQUEST_READ asks for, by index or by name; it need not exist."""
        index = message.values["param_index"]
        return str(message.values["param_id"]) if index < 0 else self.parameters.name_at(index) or ""

    def request_read(self, link: Link, message: Received) -> None:
        """PARAM_REQUEST_READ."""
        raise NotImplementedError

    def take(self, link: Link, message: Received) -> None:
        """PARAM_SET."""
        raise NotImplementedError
