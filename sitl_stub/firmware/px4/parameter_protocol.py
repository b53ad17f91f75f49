"""The parameter protocol as PX4 speaks it: the hash leads the list, integers travel as bit patterns inside the float."""

from __future__ import annotations

import struct

from sitl_stub.firmware.common.parameter_protocol import NO_INDEX, ParameterProtocol
from sitl_stub.firmware.common.parameters import INT32, ParameterError
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link

UINT32 = 5  # MAV_PARAM_TYPE_UINT32
HASH = "_HASH_CHECK"


class Px4ParameterProtocol(ParameterProtocol):
    """Lets clients list, read and change one PX4's parameters."""

    def packed(self, value: float) -> bytes:
        """A value as the four bytes of `param_value`."""
        return struct.pack("<i", value) if isinstance(value, int) else super().packed(value)

    def request_list(self, link: Link, message: Received) -> None:
        """PARAM_REQUEST_LIST; the hash comes first, so that a ground station with the same list can stop it."""
        self._send_hash(link)
        super().request_list(link, message)

    def _send_hash(self, link: Link) -> None:
        self.send_raw(link, HASH, struct.pack("<I", self.parameters.hash()), NO_INDEX, UINT32)

    def request_read(self, link: Link, message: Received) -> None:
        """PARAM_REQUEST_READ; an unknown name or index gets no answer."""
        name = self.asked_for(message)
        if name == HASH:
            self._send_hash(link)
        elif name in self.parameters:
            self.send(link, name)

    def take(self, link: Link, message: Received) -> None:
        """PARAM_SET: everybody is told the value that holds from now on."""
        name = message.values["param_id"]
        if name == HASH:
            link.firmware_data.parameters_waiting = []
            return
        if name not in self.parameters:
            return
        value = float(message.values["param_value"])
        if self.parameters.kind(name) == INT32:
            value = float(struct.unpack("<i", struct.pack("<f", value))[0])
        try:
            self.parameters.set(name, value)
        except ParameterError as error:
            self.voice.note(str(error))
        for other in self.voice.links:
            self.send(other, name)
