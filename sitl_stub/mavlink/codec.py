"""MAVLink frames to values and back, MAVLink 1 and 2, without shared parse state between datagrams.

The message tables are pymavlink's, kept in `data/messages.json` because importing them takes longer than all else that a
stub does until it is ready; packing and splitting are done here because a lockstep flight at 20 times real time sends
some 10,000 frames a second and pymavlink's own message objects cost several times more. Messages newer than
pymavlink's tables (PX4 1.17 sends some) are added in `NEWER_MESSAGES`.
"""

from __future__ import annotations

import functools
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fastcrc.crc16 import mcrf4xx as _crc

MAVLINK1_MAGIC = 0xFE
MAVLINK2_MAGIC = 0xFD
SIGNED_FLAG = 0x01
SIGNATURE_BYTES = 13
BROADCAST = 0
_HEAD2 = struct.Struct("<BBBBBBHB")
"""Length, two kinds of flags, sequence, system, component, message number (low, high)."""
_BYTES = tuple(bytes((number,)) for number in range(256))

# name -> (message id, CRC extra, wire format, field names in wire order). The CRC extras were found from
# the checksums of frames in the PX4 1.17 capture.
NEWER_MESSAGES: dict[str, tuple[int, int, str, tuple[str, ...]]] = {
    "LINK_NODE_STATUS": (
        8,
        117,
        "<QIIIIIHHHBB",
        ("timestamp", "tx_rate", "rx_rate", "messages_sent", "messages_received", "messages_lost", "rx_parse_err",
         "tx_overflows", "rx_overflows", "tx_buf", "rx_buf"),
    ),
    "TIME_ESTIMATE_TO_TARGET": (
        380,
        232,
        "<iiiii",
        ("safe_return", "land", "mission_next_item", "mission_end", "commanded_action"),
    ),
    "EVENT": (
        410,
        160,
        "<IIHBBB40s",
        ("id", "event_time_boot_ms", "sequence", "destination_component", "destination_system", "log_levels",
         "arguments"),
    ),
    "CURRENT_EVENT_SEQUENCE": (411, 106, "<HB", ("sequence", "flags")),
    "CURRENT_MODE": (436, 193, "<IIB", ("custom_mode", "intended_custom_mode", "standard_mode")),
    "GNSS_INTEGRITY": (
        441,
        169,
        "<IHHBBBBBBBBB",
        ("system_errors", "raim_hfom", "raim_vfom", "id", "authentication_state", "jamming_state", "spoofing_state",
         "raim_state", "corrections_quality", "system_status_summary", "gnss_signal_quality",
         "post_processing_quality"),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class MessageLayout:
    """How one message lies on the wire."""

    name: str
    message_id: int
    crc_extra: int
    packer: struct.Struct
    fields: tuple[str, ...]
    """Field names in wire order."""
    array_lengths: tuple[int, ...]
    """Values each field takes from the unpacked tuple: 0 for a scalar, -1 for a string, else the count."""
    mavlink1_length: int
    """Payload length without MAVLink 2 extension fields, bytes."""

    @functools.cached_property
    def plain(self) -> bool:
        """Whether every field is one number."""
        return not any(self.array_lengths)


def _field(entry: str) -> tuple[str, int]:
    """Name and number of values of `name`, `name[4]` or, a string, `name[]`."""
    name, bracket, count = entry.rstrip("]").partition("[")
    return name, int(count or -1) if bracket else 0


def _build_layouts() -> tuple[dict[str, MessageLayout], dict[int, MessageLayout]]:
    table = (Path(__file__).parent / "data" / "messages.json").read_text(encoding="utf-8")
    by_name: dict[str, MessageLayout] = {}
    for name, (message_id, extra, wire_format, entries) in json.loads(table).items():
        packer = struct.Struct(wire_format)
        names, lengths = zip(*(_field(entry) for entry in entries.split()), strict=True)
        by_name[name] = MessageLayout(name, message_id, extra, packer, names, lengths, packer.size)
    for name, (message_id, extra, wire_format, names) in NEWER_MESSAGES.items():
        packer = struct.Struct(wire_format)
        lengths = tuple(-1 if field_name == "arguments" else 0 for field_name in names)
        by_name[name] = MessageLayout(name, message_id, extra, packer, names, lengths, packer.size)
    return by_name, {layout.message_id: layout for layout in by_name.values()}


LAYOUTS, LAYOUTS_BY_ID = _build_layouts()


@dataclass(slots=True)
class Received:
    """One message as it came off the wire."""

    name: str
    system: int
    component: int
    mavlink_version: int
    values: dict[str, Any]
    frame: bytes = b""
    """The whole frame as it came."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self.values[name]
        except KeyError:
            raise AttributeError(name) from None


@dataclass(slots=True)
class LinkCounters:
    """What arrived on a link and what had to be thrown away."""

    received: int = 0
    bad_checksum: int = 0
    truncated: int = 0
    unknown: int = 0
    garbage_bytes: int = 0
    sent: int = 0

    @property
    def dropped(self) -> int:
        """Frames that could not be used."""
        return self.bad_checksum + self.truncated + self.unknown


def unpack_payload(layout: MessageLayout, payload: bytes) -> dict[str, Any]:
    """Fields of a payload by name; MAVLink 2's cut trailing zeros are put back."""
    size = layout.packer.size
    if len(payload) < size:
        payload += bytes(size - len(payload))
    flat = layout.packer.unpack_from(payload)
    if layout.plain:
        return dict(zip(layout.fields, flat, strict=True))
    values: dict[str, Any] = {}
    at = 0
    for name, count in zip(layout.fields, layout.array_lengths, strict=True):
        if count > 0:
            values[name] = flat[at : at + count]
            at += count
        else:
            item = flat[at]
            values[name] = (
                item.split(b"\0", 1)[0].decode("ascii", "replace") if isinstance(item, bytes) else item
            )
            at += 1
    return values


@dataclass(slots=True)
class FrameReader:
    """Splits bytes into messages.

    For datagrams `read_datagram` keeps nothing from one call to the next, so that a truncated datagram cannot
    swallow the next one; for TCP `read_stream` keeps the unfinished tail.
    """

    counters: LinkCounters = field(default_factory=LinkCounters)
    tail: bytes = b""

    def read_datagram(self, data: bytes) -> list[Received]:
        """Messages of one UDP datagram; whatever is broken is counted and skipped."""
        messages, rest = self._split(data)
        if rest:
            self.counters.truncated += 1
        return messages

    def read_stream(self, data: bytes) -> list[Received]:
        """Messages completed by these bytes of a byte stream."""
        messages, self.tail = self._split(self.tail + data)
        return messages

    def _split(self, data: bytes) -> tuple[list[Received], bytes]:
        return list(self._frames(data)), self._rest

    _rest: bytes = b""

    def _frames(self, data: bytes) -> Iterator[Received]:
        at = 0
        end = len(data)
        counters = self.counters
        self._rest = b""
        while at < end:
            magic = data[at]
            if magic == MAVLINK2_MAGIC:
                header = 10
            elif magic == MAVLINK1_MAGIC:
                header = 6
            else:
                counters.garbage_bytes += 1
                at += 1
                continue
            if end - at < header:
                self._rest = data[at:]
                return
            length = data[at + 1]
            total = header + length + 2
            if magic == MAVLINK2_MAGIC:
                incompatible = data[at + 2]
                if incompatible & ~SIGNED_FLAG:
                    counters.garbage_bytes += 1
                    at += 1
                    continue
                if incompatible & SIGNED_FLAG:
                    total += SIGNATURE_BYTES
                message_id = data[at + 7] | data[at + 8] << 8 | data[at + 9] << 16
                system, component = data[at + 5], data[at + 6]
            else:
                message_id = data[at + 5]
                system, component = data[at + 3], data[at + 4]
            if end - at < total:
                self._rest = data[at:]
                return
            layout = LAYOUTS_BY_ID.get(message_id)
            if layout is None:
                counters.unknown += 1
                at += total
                continue
            body_end = at + header + length
            checksum = _crc(data[at + 1 : body_end] + _BYTES[layout.crc_extra])
            if checksum != data[body_end] | data[body_end + 1] << 8:
                # Resynchronise at the next byte: a false start inside garbage must not swallow a whole frame.
                counters.bad_checksum += 1
                at += 1
                continue
            counters.received += 1
            values = unpack_payload(layout, data[at + header : body_end])
            version = 2 if magic == MAVLINK2_MAGIC else 1
            yield Received(layout.name, system, component, version, values, data[at : at + total])
            at += total


@dataclass(slots=True)
class FrameWriter:
    """Builds frames from one system and component, with its own sequence number.

    `version` starts at 2 and becomes 1 only while the other side speaks MAVLink 1 (set by the link).
    """

    system: int = 1
    component: int = 1
    version: int = 2
    sequence: int = 0

    def frame(self, layout: MessageLayout, values: tuple[Any, ...]) -> bytes:
        """One frame of `values` in wire order (arrays flattened)."""
        return self.frame_of_payload(layout, layout.packer.pack(*values))

    def frame_of_payload(self, layout: MessageLayout, payload: bytes) -> bytes:
        """One frame of a payload already packed."""
        sequence, number = self.sequence, layout.message_id
        self.sequence = (sequence + 1) & 0xFF
        if self.version == 2:
            payload = payload.rstrip(b"\0") or b"\0"
            ids = (self.system, self.component, number & 0xFFFF, number >> 16)
            body = _HEAD2.pack(len(payload), 0, 0, sequence, *ids) + payload
            start = b"\xfd"
        else:
            payload = payload[: mavlink1_length(layout)]
            body = bytes((len(payload), sequence, self.system, self.component, number)) + payload
            start = b"\xfe"
        return start + body + _crc(body + _BYTES[layout.crc_extra]).to_bytes(2, "little")


def whole_frame(frame: bytes) -> tuple[int, MessageLayout] | None:
    """Sequence number and message of an unsigned frame, or None where it is cut or its checksum fails."""
    if len(frame) < 8 or frame[0] not in (MAVLINK1_MAGIC, MAVLINK2_MAGIC):
        return None
    second = frame[0] == MAVLINK2_MAGIC
    if len(frame) < 12 and second:
        return None
    number = frame[7] | frame[8] << 8 | frame[9] << 16 if second else frame[5]
    layout = LAYOUTS_BY_ID.get(number)
    if layout is None or len(frame) != frame[1] + (12 if second else 8):
        return None
    good = _crc(frame[1:-2] + bytes((layout.crc_extra,))) == frame[-2] | frame[-1] << 8
    return (frame[4] if second else frame[2], layout) if good else None


def renumbered(frame: bytes, sequence: int, crc_extra: int) -> bytes:
    """A whole, unsigned frame with another sequence number and the checksum that belongs to it."""
    at = 4 if frame[0] == MAVLINK2_MAGIC else 2
    body = frame[1:at] + bytes((sequence,)) + frame[at + 1 : -2]
    return frame[:1] + body + _crc(body + bytes((crc_extra,))).to_bytes(2, "little")


_MAVLINK1_LENGTHS: dict[str, int] = {
    # Messages with MAVLink 2 extension fields that the firmwares send: length of the base part, bytes.
    "ATTITUDE_QUATERNION": 32,
    "BATTERY_STATUS": 36,
    "COMMAND_ACK": 3,
    "GPS_RAW_INT": 30,
    "HIGHRES_IMU": 62,
    "HOME_POSITION": 52,
    "GPS_GLOBAL_ORIGIN": 12,
    "SERVO_OUTPUT_RAW": 21,
    "STATUSTEXT": 51,
    "SYS_STATUS": 31,
    "TIMESYNC": 16,
    "AUTOPILOT_VERSION": 60,
    "DISTANCE_SENSOR": 14,
    "SCALED_PRESSURE": 14,
    "MISSION_CURRENT": 2,
    "SIM_STATE": 84,
}


def mavlink1_length(layout: MessageLayout) -> int:
    """Payload bytes of a message in a MAVLink 1 frame: without its extension fields."""
    return _MAVLINK1_LENGTHS.get(layout.name, layout.mavlink1_length)


def pack_fields(layout: MessageLayout, fields: dict[str, Any]) -> tuple[Any, ...]:
    """Values in wire order from fields by name; a field left out is zero, a short array is filled with zeros."""
    values: list[Any] = []
    for name, count in zip(layout.fields, layout.array_lengths, strict=True):
        value = fields.get(name, b"" if count < 0 else 0)
        if count > 0:
            items = list(value) if value else []
            values.extend(items + [0] * (count - len(items)))
        elif isinstance(value, str):
            values.append(value.encode("ascii", "replace"))
        else:
            values.append(value)
    return tuple(values)
