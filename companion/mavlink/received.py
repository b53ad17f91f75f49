"""Frames whose checksum holds, read only as far as somebody asks.

An autopilot sends some 700 frames in a second of flight, and the flight looks into half of them. pymavlink's `decode`
makes an object of each with all its fields, several times the work of what is needed of it. Here a frame is accepted and
refused exactly as there (tests/unit/test_mavlink_received.py compares the two), from pymavlink's own tables, but only
its header is read at once; the fields follow at the first look at one of them. Messages with text in them come rarely,
and pymavlink reads those.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any

from fastcrc.crc16 import mcrf4xx

from companion.mavlink.framing import MAGIC_V1, MAGIC_V2, SIGNED_FLAG
from companion.mavlink.layouts import LAYOUTS, Layout, mav

SIGNATURE_BYTES = 13
_HEAD_V1 = struct.Struct("<xBBBBB")  # length, sequence, system, component, message
_HEAD_V2 = struct.Struct("<xBBxBBBHB")  # length, flags, sequence, system, component, message (low, high)


class Received:
    """One frame. A message's fields are attributes, under their names in MAVLink, as pymavlink has them; what begins
    with `msg_` is of its header, and no field of the dialect has such a name.

    Raises AttributeError for a field that the message has not; an `unknown` one has none.
    """

    __slots__ = (
        "__dict__",
        "_head",
        "_layout",
        "_length",
        "msg_component",
        "msg_frame",
        "msg_id",
        "msg_sequence",
        "msg_system",
    )

    def __init__(
        self,
        frame: bytes,
        layout: Layout | None,
        head: int,
        length: int,
        message_id: int,
        sequence: int,
        system: int,
        component: int,
    ) -> None:
        """`head`, `length`: bytes of header and payload."""
        self.msg_frame = frame
        self._layout = layout
        self._head = head
        self._length = length
        self.msg_id = message_id
        self.msg_sequence = sequence
        self.msg_system = system
        self.msg_component = component

    @property
    def unknown(self) -> bool:
        """Whether the dialect does not have this message: nobody can say that its checksum is right."""
        return self._layout is None

    @property
    def boot_ms(self) -> int | None:
        """The message's `time_boot_ms`, None where it has none."""
        layout = self._layout
        return None if layout is None or layout.stamp_at < 0 else self._integer(layout.stamp_at, 4)

    @property
    def time_us(self) -> int | None:
        """The message's `time_usec`, None where it has none; of which clock differs between messages."""
        layout = self._layout
        return None if layout is None or layout.stamp_us_at < 0 else self._integer(layout.stamp_us_at, 8)

    @property
    def msg_payload(self) -> bytes:
        """As it came: without the zeros at its end, and with what a newer dialect has put behind the fields."""
        return self.msg_frame[self._head : self._head + self._length]

    def _integer(self, place: int, size: int) -> int:
        start, end = self._head + place, self._head + self._length
        part = self.msg_frame[start : min(start + size, end)]  # zeros at the end are not sent
        return int.from_bytes(part, "little")

    def get_msgId(self) -> int:
        """As pymavlink's."""
        return self.msg_id

    def get_type(self) -> str:
        """As pymavlink's: the message's name."""
        return self._layout.name if self._layout is not None else f"UNKNOWN_{self.msg_id}"

    def get_seq(self) -> int:
        """As pymavlink's."""
        return self.msg_sequence

    def get_srcSystem(self) -> int:
        """As pymavlink's."""
        return self.msg_system

    def get_srcComponent(self) -> int:
        """As pymavlink's."""
        return self.msg_component

    def __getattr__(self, name: str) -> Any:
        layout = self._layout
        if layout is None or name not in layout.names:
            raise AttributeError(f"{self.get_type()} has no field {name}")
        fields = self.__dict__
        fields.update(self._fields(layout))
        return fields[name]

    def _fields(self, layout: Layout) -> Iterable[tuple[str, Any]]:
        if not layout.plain:
            message = mav.MAVLink(None).decode(bytearray(self.msg_frame))
            return [(name, getattr(message, name)) for name in layout.names]
        payload = self.msg_payload
        if len(payload) < layout.size:
            payload += bytes(layout.size - len(payload))
        numbers = layout.unpack(payload)
        if not layout.has_arrays:
            return zip(layout.names, numbers, strict=True)
        fields, place = [], 0
        for name, count in zip(layout.names, layout.counts, strict=True):
            fields.append((name, numbers[place] if count == 1 else list(numbers[place : place + count])))
            place += count
        return fields


def read(frame: bytes) -> Received | None:
    """The message in a whole frame; None where pymavlink's `decode` would refuse it (length or checksum wrong).

    Signatures are not judged here.
    """
    signature = 0
    if len(frame) >= 12 and frame[0] == MAGIC_V2:
        head = 10
        length, flags, sequence, system, component, low, high = _HEAD_V2.unpack_from(frame)
        message_id = low | high << 16
        if flags & SIGNED_FLAG:
            signature = SIGNATURE_BYTES
    elif len(frame) >= 8 and frame[0] == MAGIC_V1:
        head = 6
        length, sequence, system, component, message_id = _HEAD_V1.unpack_from(frame)
    else:
        return None
    end = head + length
    if len(frame) != end + 2 + signature:
        return None
    layout = LAYOUTS.get(message_id)
    if layout is not None:
        checksum = mcrf4xx(frame[1:end] + layout.crc_extra)
        if checksum != frame[end] | frame[end + 1] << 8:
            return None
    return Received(frame, layout, head, length, message_id, sequence, system, component)
