"""The parameter protocol as ArduPilot speaks it: greetings before the list, answers by name without an index."""

from __future__ import annotations

from sitl_stub.firmware.ardupilot.voice import ArduPilotVoice
from sitl_stub.firmware.common.mavlink_ids import Severity
from sitl_stub.firmware.common.parameter_protocol import NO_INDEX, ParameterProtocol
from sitl_stub.firmware.common.parameters import ParameterError
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link

GREETINGS = ("ArduCopter V4.7.0-dev (2598e9d4)", "3d1219c7c4c5404aaa1f6d2a48adfda4", "Frame: QUAD/PLUS")


class ArduPilotParameterProtocol(ParameterProtocol):
    """Lets clients list, read and change one ArduCopter's parameters."""

    voice: ArduPilotVoice

    def request_list(self, link: Link, message: Received) -> None:
        """PARAM_REQUEST_LIST."""
        for text in GREETINGS:
            self.voice.say_to(link, Severity.INFO, text)
        super().request_list(link, message)

    def request_read(self, link: Link, message: Received) -> None:
        """PARAM_REQUEST_READ: by name the answer carries no index; an unknown name or index gets no answer."""
        name = self.asked_for(message)
        if name in self.parameters:
            self.send(link, name, NO_INDEX if message.values["param_index"] < 0 else None)

    def take(self, link: Link, message: Received) -> None:
        """PARAM_SET: the value that was taken is told to everybody; an unknown name gets no answer."""
        name = message.values["param_id"]
        if name not in self.parameters:
            return
        try:
            self.parameters.set(name, float(message.values["param_value"]))
        except ParameterError as error:
            self.voice.note(str(error))
            return
        self.announce(name)

    def announce(self, name: str) -> None:
        """PARAM_VALUE to everybody, without its index."""
        for link in self.voice.links:
            self.send(link, name, NO_INDEX)
