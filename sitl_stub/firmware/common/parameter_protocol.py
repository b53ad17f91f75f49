"""The parameter protocol as PX4 speaks it: the list with its hash first, reading, setting; integers as bit patterns.

ArduPilot's, which differs in all but the list, is in `ardupilot/protocol.py`.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from sitl_stub.firmware.common.parameters import INT32, ParameterError
from sitl_stub.firmware.common.streams import LinkStreams
from sitl_stub.mavlink.codec import LAYOUTS, Received
from sitl_stub.mavlink.links import Link

if TYPE_CHECKING:
    from sitl_stub.firmware.common.autopilot import Autopilot

PARAMETERS_PER_INSTANT = 10
UINT32 = 5


class ParameterProtocol:
    """Lets clients list, read and change one autopilot's parameters."""

    def __init__(self, autopilot: Autopilot) -> None:
        self.autopilot = autopilot

    def send(self, link: Link, name: str) -> None:
        """Send one PARAM_VALUE."""
        layout = LAYOUTS["PARAM_VALUE"]
        value = self.autopilot.parameters[name]
        kind = self.autopilot.parameters.kind(name)
        if isinstance(value, int) and self.autopilot.integers_as_bits:
            # Packed by hand: a bit pattern that is a signalling NaN must not pass through a Python float.
            frame_value = struct.pack("<i", value)
        else:
            frame_value = struct.pack("<f", value)
        payload = frame_value + struct.pack(
            "<HH16sB",
            len(self.autopilot.parameters),
            self.autopilot.parameters.index(name),
            name.encode(),
            kind,
        )
        link.send_payload(layout, payload)

    def send_waiting(self, link: Link, streams: LinkStreams) -> int:
        """The next few of a list that was asked for; returns how many."""
        count = min(PARAMETERS_PER_INSTANT, len(streams.parameters_waiting))
        for _ in range(count):
            name = self.autopilot.parameters.name_at(streams.parameters_waiting.pop())
            if name is not None:
                self.send(link, name)
        return count

    def request_list(self, link: Link, message: Received) -> None:
        """PARAM_REQUEST_LIST."""
        streams: LinkStreams = link.firmware_data
        if self.autopilot.hash_leads_list:
            self._send_hash(link)
        streams.parameters_waiting = list(range(len(self.autopilot.parameters) - 1, -1, -1))

    def _send_hash(self, link: Link) -> None:
        name = b"_HASH_CHECK"
        payload = struct.pack(
            "<IHH16sB", self.autopilot.parameters.hash(), len(self.autopilot.parameters), 0xFFFF, name, UINT32
        )
        link.send_payload(LAYOUTS["PARAM_VALUE"], payload)

    def request_read(self, link: Link, message: Received) -> None:
        """PARAM_REQUEST_READ, by index or by name."""
        index = message.values["param_index"]
        name = message.values["param_id"] if index < 0 else self.autopilot.parameters.name_at(index)
        if name == "_HASH_CHECK":
            self._send_hash(link)
        elif name is not None and name in self.autopilot.parameters:
            self.send(link, name)

    def take(self, link: Link, message: Received) -> None:
        """PARAM_SET: everybody is told the value that holds from now on."""
        name = message.values["param_id"]
        if name == "_HASH_CHECK":
            streams: LinkStreams = link.firmware_data
            streams.parameters_waiting = []
            return
        if name not in self.autopilot.parameters:
            return
        value = float(message.values["param_value"])
        if self.autopilot.parameters.kind(name) == INT32 and self.autopilot.integers_as_bits:
            value = float(struct.unpack("<i", struct.pack("<f", value))[0])
        elif self.autopilot.parameters.kind(name) == INT32:
            value = float(round(value)) if value == value and abs(value) < 2**31 else value
        try:
            self.autopilot.parameters.set(name, value)
        except ParameterError as error:
            self.autopilot.on_text(str(error))
        for other in self.autopilot.links:
            self.send(other, name)
