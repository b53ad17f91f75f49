"""What others send over the same link, and what a serial bridge makes of its frames."""

from __future__ import annotations

import dataclasses
import random
from dataclasses import dataclass

from sitl_stub.faults.fault import Effect, Fault, Site, hold, names, number, whole
from sitl_stub.faults.frames import Direction, Parcel
from sitl_stub.mavlink.codec import LAYOUTS, FrameWriter, MessageLayout, pack_fields, whole_frame

# MAV_TYPE_GCS, _GIMBAL, _CAMERA, _ONBOARD_CONTROLLER, _QUADROTOR; MAV_AUTOPILOT_INVALID, _ARDUPILOTMEGA
_GCS, _GIMBAL, _CAMERA, _ONBOARD, _QUADROTOR = 6, 26, 30, 18, 2
_NO_AUTOPILOT, _ARDUPILOTMEGA = 8, 3
_OTHER_SYSTEM, _GROUND_STATION = 2, 255
_SENDERS = {
    "autopilot": (_OTHER_SYSTEM, 1, _QUADROTOR, _ARDUPILOTMEGA),
    "companion": (1, 192, _ONBOARD, _NO_AUTOPILOT),
    "ground_station": (_GROUND_STATION, 190, _GCS, _NO_AUTOPILOT),
    "gimbal": (1, 154, _GIMBAL, _NO_AUTOPILOT),
    "camera": (1, 100, _CAMERA, _NO_AUTOPILOT),
}
"""System (1 is the autopilot's), component, MAV_TYPE and MAV_AUTOPILOT of each."""
_DRAWN = [layout for name, layout in LAYOUTS.items() if name != "HEARTBEAT"]
"""What is drawn with any content. A HEARTBEAT says who somebody is, and so is always its sender's own."""
_HEARTBEAT_SHARE, _ALTERED_SHARE = 0.05, 0.4


@dataclass(frozen=True)
class OtherTraffic(Fault):
    """Others send over the same link: any message with any content, and the autopilot's own with other numbers."""

    kind = "other_traffic"
    probability: float = number(0.7, "", "of a foreign frame after each of the autopilot's", 0.0, 1.0)
    senders: tuple[str, ...] = names(
        ("companion", "ground_station", "gimbal", "camera"), tuple(_SENDERS), "senders"
    )

    def act(self, site: Site) -> Effect:
        """Stand beside the frames' way."""
        end = site.frames.begin(_Crowd(self), site.random)
        try:
            yield from hold()
        finally:
            end()


class _Crowd:
    """The others, each with sequence numbers of its own."""

    def __init__(self, fault: OtherTraffic) -> None:
        self._probability = fault.probability
        self._senders = []
        for name in fault.senders:
            system, component, vehicle, autopilot = _SENDERS[name]
            fields = {"type": vehicle, "autopilot": autopilot, "system_status": 4, "mavlink_version": 3}
            self._senders.append((FrameWriter(system, component), fields))

    def affects(self, direction: Direction, message: str) -> bool:
        """What goes to clients."""
        return direction == "to_client"

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """Itself, perhaps with somebody else's frame behind it."""
        if draw.random() >= self._probability:
            return [parcel]
        writer, heartbeat = draw.choice(self._senders)
        sort = draw.random()
        if sort < _HEARTBEAT_SHARE:
            layout = LAYOUTS["HEARTBEAT"]
            frame = writer.frame(layout, pack_fields(layout, heartbeat))
        elif sort < _HEARTBEAT_SHARE + _ALTERED_SHARE:
            frame = self._altered(parcel.frame, writer, draw)
        else:
            layout = draw.choice(_DRAWN)
            frame = writer.frame_of_payload(layout, _payload(layout, draw))
        return [parcel, dataclasses.replace(parcel, frame=frame)] if frame else [parcel]

    @staticmethod
    def _altered(frame: bytes, writer: FrameWriter, draw: random.Random) -> bytes:
        """The autopilot's own message with a few other bytes, which look as likely as its own; HEARTBEATs are left out."""
        known = whole_frame(frame)
        if known is None or known[1].name == "HEARTBEAT":
            return b""
        layout = known[1]
        body = frame[10:-2] if frame[0] == 0xFD else frame[6:-2]
        payload = bytearray(body.ljust(layout.packer.size, b"\0"))
        for _ in range(draw.randrange(4)):
            payload[draw.randrange(len(payload))] = draw.randrange(256)
        return writer.frame_of_payload(layout, bytes(payload))


def _payload(layout: MessageLayout, draw: random.Random) -> bytes:
    size, sort = layout.packer.size, draw.random()
    if sort < 0.7:
        return draw.randbytes(size)
    return bytes((draw.choice((0x00, 0x7F, 0x80, 0xFF)),)) * size


@dataclass(frozen=True)
class LinkPieces(Fault):
    """A serial bridge: the autopilot's frames arrive in datagrams of a few bytes, some of which are lost."""

    kind = "link_pieces"
    size: int = whole(64, "bytes of a datagram, at most", 8, 280)
    probability: float = number(0.0, "", "with which a datagram is lost", 0.0, 1.0)

    def affects(self, direction: Direction, message: str) -> bool:
        """What goes to clients."""
        return direction == "to_client"

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """Its pieces, but those that are lost."""
        pieces = [parcel.frame[at : at + self.size] for at in range(0, len(parcel.frame), self.size)]
        return [
            dataclasses.replace(parcel, frame=piece) for piece in pieces if draw.random() >= self.probability
        ]

    def act(self, site: Site) -> Effect:
        """Stand in the frames' way."""
        end = site.frames.begin(self, site.random)
        try:
            yield from hold()
        finally:
            end()
