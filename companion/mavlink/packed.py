"""Messages to frames without pymavlink's `pack`, which makes a header object and two checksums, 200 times a second."""

from __future__ import annotations

import struct
from operator import attrgetter
from typing import Any

from fastcrc.crc16 import mcrf4xx

from companion.mavlink.framing import MAGIC_V2
from companion.mavlink.layouts import LAYOUTS, Layout, mav

_HEAD = struct.Struct(
    "<BBBBBBHB"
)  # length, two kinds of flags, sequence, system, component, message (low, high)
_START = bytes((MAGIC_V2,))
_FIELDS = {number: attrgetter(*layout.names) for number, layout in LAYOUTS.items() if len(layout.names) > 1}


def packed(message: Any, codec: Any) -> bytes:
    """The MAVLink 2 frame of one of pymavlink's messages, as `message.pack(codec)` makes it, for `codec.seq`.

    Raises struct.error where a number does not fit its field.
    """
    layout = LAYOUTS[message.get_msgId()]
    if not layout.plain or codec.signing.sign_outgoing or layout.message_id not in _FIELDS:
        return bytes(message.pack(codec))
    payload: bytes = layout.pack(*_numbers(message, layout)).rstrip(b"\0") or b"\0"
    number = layout.message_id
    head = _HEAD.pack(
        len(payload), 0, 0, codec.seq, codec.srcSystem, codec.srcComponent, number & 0xFFFF, number >> 16
    )
    body = head + payload
    return _START + body + mcrf4xx(body + layout.crc_extra).to_bytes(2, "little")


def _numbers(message: mav.MAVLink_message, layout: Layout) -> list[Any] | tuple[Any, ...]:
    fields: tuple[Any, ...] = _FIELDS[layout.message_id](message)
    if layout.has_arrays:
        return [
            number
            for field, count in zip(fields, layout.counts, strict=True)
            for number in ((field,) if count == 1 else field)
        ]
    return fields
