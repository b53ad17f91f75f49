"""`read_log`: a whole flight as arrays, from a whole file or from one that was cut.

The file is read from front to back, never through its index, so that one that ends in the middle needs
no special step: what stands before the cut is read, and the record says that it was cut and when.
"""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap import records as layout
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from numpy.typing import NDArray

from companion.config.errors import UserError
from companion.config.foreign_files import kind_of_file
from companion.flightlog import events
from companion.flightlog.channels import CDR_HEADER, TIME_FIELD, FieldSpec, parse_definition
from companion.flightlog.mcap_file import MAGIC
from companion.flightlog.writer import LIVE_HEAD, LIVE_TOPIC

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_LARGEST_RECORD = 1 << 31  # more than this is not a record but noise
_LARGEST_CHUNK = 1 << 28


@dataclass(frozen=True, slots=True)
class RawChannel:
    """One channel as it stands in the file."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema_data: bytes
    metadata: dict[str, str]
    log_times_ns: list[int] = field(default_factory=list)
    publish_times_ns: list[int] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class RawLog:
    """A file's records, undecoded. `cut` says what is wrong with its end, empty when nothing is."""

    path: Path
    profile: str
    library: str
    channels: list[RawChannel]
    metadata: list[tuple[str, dict[str, str]]]
    attachments: list[layout.Attachment]
    cut: str


@dataclass(frozen=True, slots=True)
class NumericChannel:
    """One numeric channel as one table; `channel["position_enu"]` is an (n, 3) view, a scalar field (n,)."""

    topic: str
    fields: tuple[FieldSpec, ...]
    time_s: NDArray[np.float64]  # (n,) autopilot time
    values: NDArray[np.float64]  # (n, width) without time_s, the bits as they were logged
    wall_clock: bool

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return one field: (n,), (n, width) or (n, rows, columns). Raises KeyError naming what there is."""
        start = 0
        for item in self.fields:
            if item.name == name:
                part = self.values[:, start : start + item.width]
                if item.kind == "int64":
                    part = part.view(np.int64)
                if item.shape:
                    return part.reshape(len(part), *item.shape)
                return part[:, 0] if item.width == 1 else part
            start += item.width
        raise KeyError(f"{self.topic} has no field {name!r}, only {[item.name for item in self.fields]}")

    def __contains__(self, name: object) -> bool:
        """Whether there is a field of that name."""
        return any(item.name == name for item in self.fields)

    def __len__(self) -> int:
        """Return how many records there are."""
        return len(self.time_s)


@dataclass(frozen=True, slots=True)
class Event:
    """One event; `fields` holds what else was logged with it."""

    kind: str
    time_s: float
    fields: dict[str, Any]


@dataclass(frozen=True, slots=True)
class FlightRecord:
    """A flight as it was logged."""

    path: Path
    channels: dict[str, NumericChannel]  # by topic; only those with records
    events: list[Event]
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    mavlink: dict[str, tuple[NDArray[np.int64], list[bytes]]]  # in/out → (log times in ns, frames)
    utc_offset_ns: int
    cut: str  # what is wrong with the end of the file, empty when it is whole
    end_time_s: float  # autopilot time of the last record; NaN in a log without any
    live: list[tuple[float, tuple[float, ...], bytes]] = field(default_factory=list)
    """What other programs sent as references: when, autopilot's time; numbers (`companion/live/heard.py`); the bytes."""

    def channel(self, topic: str) -> NumericChannel | None:
        """Return a channel, or None when the log has no record of it."""
        return self.channels.get(topic)

    @property
    def flight(self) -> dict[str, str]:
        """The metadata that describes the flight: controller, level, seed, …"""
        return self.metadata.get("flight", {})

    def events_of(self, kind: str) -> list[Event]:
        """Return the events of one kind, in order."""
        return [item for item in self.events if item.kind == kind]


def read_log(path: str | os.PathLike[str]) -> FlightRecord:
    """Read a flight log, whole or cut. Raises UserError when it is missing or no flight log."""
    raw = read_raw(path)
    metadata: dict[str, dict[str, str]] = {}
    for name, values in raw.metadata:
        metadata.setdefault(name, {}).update(values)
    try:
        offset = int(metadata.get("clock", {}).get("utc_offset_ns", "0"))
    except ValueError as error:
        raise UserError(
            f"{raw.path}: metadata clock.utc_offset_ns is not a number; not a flight log?"
        ) from error
    channels: dict[str, NumericChannel] = {}
    found: list[Event] = []
    mavlink: dict[str, tuple[NDArray[np.int64], list[bytes]]] = {}
    live: list[tuple[float, tuple[float, ...], bytes]] = []
    last = -1
    for item in raw.channels:
        if not item.messages:
            continue
        newest = max(item.log_times_ns)
        last = max(last, newest)
        if item.topic == events.TOPIC:
            found.extend(_decode_events(item))
        elif item.topic.startswith("/mavlink/"):
            frames = [
                message[16 : 16 + int.from_bytes(message[12:16], "little")] for message in item.messages
            ]
            mavlink[item.topic.removeprefix("/mavlink/")] = (np.array(item.log_times_ns, np.int64), frames)
        elif item.topic == LIVE_TOPIC:
            live = [_live_reference(message) for message in item.messages]
        elif (decoded := _decode_numeric(item)) is not None:
            channels[item.topic] = decoded
    end = (last - offset) / 1e9 if last >= 0 else float("nan")
    attachments = {item.name: item.data for item in raw.attachments}
    return FlightRecord(raw.path, channels, found, metadata, attachments, mavlink, offset, raw.cut, end, live)


def _live_reference(message: bytes) -> tuple[float, tuple[float, ...], bytes]:
    _, time_s, *numbers, length = LIVE_HEAD.unpack_from(message)
    return time_s, tuple(numbers), message[LIVE_HEAD.size : LIVE_HEAD.size + length]


def _decode_events(item: RawChannel) -> Iterator[Event]:
    for message in item.messages:
        try:
            body = json.loads(message)
            time_s = body.pop("time_s", None)
            yield Event(str(body.pop("kind")), float("nan") if time_s is None else float(time_s), body)
        except (ValueError, KeyError, AttributeError, TypeError):
            continue  # another program's event on our topic: not ours to judge


def _decode_numeric(item: RawChannel) -> NumericChannel | None:
    """Return the table, or None for a channel that is none (poses, other programs')."""
    if item.encoding != "cdr" or item.schema_encoding != "ros2msg":
        return None
    try:
        fields = parse_definition(item.schema_data.decode("utf-8", "replace"))
    except ValueError:
        return None
    length = len(CDR_HEADER) + 8 * sum(part.width for part in fields)
    if not fields or fields[0].name != TIME_FIELD or any(len(message) != length for message in item.messages):
        return None
    table = np.frombuffer(b"".join(item.messages), np.uint8).reshape(len(item.messages), length)
    numbers = np.ascontiguousarray(table[:, len(CDR_HEADER) :]).view(np.float64)
    wall_clock = item.metadata.get("wall_clock") == "true"
    return NumericChannel(item.topic, fields[1:], numbers[:, 0].copy(), numbers[:, 1:], wall_clock)


def read_raw(path: str | os.PathLike[str]) -> RawLog:
    """Read all records of an MCAP file, whole or cut. Raises UserError when it is missing or no MCAP file."""
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read the log {path}: {error.strerror or error}") from error
    if not data.startswith(MAGIC):
        if MAGIC.startswith(data):  # cut within its first bytes
            raise UserError(f"{path} is empty: the flight ended before anything was logged")
        raise UserError(f"{path} is not a flight log: {kind_of_file(path, data)}")
    reader = _RawReader()
    cut = reader.read_records(memoryview(data)[len(MAGIC) :])
    if not reader.saw_header:
        raise UserError(f"{path} holds nothing: it was cut right after it was opened")
    return RawLog(
        path,
        reader.profile,
        reader.library,
        list(reader.channels.values()),
        reader.metadata,
        reader.attachments,
        cut,
    )


class _RawReader:
    """Takes a file apart record by record; never raises on what it holds."""

    def __init__(self) -> None:
        self.profile = self.library = ""
        self.saw_header = False
        self.schemas: dict[int, layout.Schema] = {}
        self.channels: dict[int, RawChannel] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.attachments: list[layout.Attachment] = []
        self._decompress = zstandard.ZstdDecompressor()

    def read_records(self, data: memoryview) -> str:
        """Read up to the footer. Returns what was wrong with the end, empty when nothing was."""
        position, total = 0, len(data)
        while True:
            if total - position < _HEAD.size:
                return "the file ends without its index"
            opcode, length = _HEAD.unpack_from(data, position)
            start = position + _HEAD.size
            if length > _LARGEST_RECORD:
                return f"no record at byte {len(MAGIC) + position}"
            if start + length > total:
                return "the file ends within a record"
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                whole = bytes(data[-len(MAGIC) :]) == MAGIC
                return "" if whole else "the file ends within its index"
            try:
                self._take(opcode, data[start : start + length])
            except Exception as error:  # whatever noise does to a parser, the records before it are good
                return f"damaged at byte {len(MAGIC) + position}: {error}"
            position = start + length

    def _take(self, opcode: int, body: memoryview) -> None:
        if opcode == Opcode.MESSAGE:
            self._take_message(body)
        elif opcode == Opcode.CHUNK:
            self._take_chunk(body)
        elif opcode == Opcode.HEADER:
            header = layout.Header.read(_stream(body))
            self.profile, self.library, self.saw_header = header.profile, header.library, True
        elif opcode == Opcode.SCHEMA:
            schema = layout.Schema.read(_stream(body))
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            self._take_channel(layout.Channel.read(_stream(body)))
        elif opcode == Opcode.METADATA:
            metadata = layout.Metadata.read(_stream(body))
            self.metadata.append((metadata.name, metadata.metadata))
        elif opcode == Opcode.ATTACHMENT:
            attachment = layout.Attachment.read(_stream(body))
            given = int.from_bytes(body[-4:], "little")
            if given and zlib.crc32(body[:-4]) != given:  # MCAP: 0 where the writer made none
                raise ValueError(f"checksum of attachment {attachment.name}")
            self.attachments.append(attachment)

    def _take_channel(self, channel: layout.Channel) -> None:
        if channel.id in self.channels:
            return
        schema = self.schemas.get(channel.schema_id)
        name, encoding, data = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
        self.channels[channel.id] = RawChannel(
            channel.topic, channel.message_encoding, name, encoding, data, channel.metadata
        )

    def _take_message(self, body: memoryview) -> None:
        channel_id, _, log_time, publish_time = _MESSAGE.unpack_from(body)
        channel = self.channels[channel_id]
        channel.log_times_ns.append(log_time)
        channel.publish_times_ns.append(publish_time)
        channel.messages.append(bytes(body[_MESSAGE.size :]))

    def _take_chunk(self, body: memoryview) -> None:
        chunk = layout.Chunk.read(_stream(body))
        if chunk.uncompressed_size > _LARGEST_CHUNK:
            raise ValueError(f"chunk of {chunk.uncompressed_size} bytes")
        if chunk.compression == "zstd":
            raw = self._decompress.decompress(chunk.data, max_output_size=chunk.uncompressed_size)
        elif chunk.compression == "lz4":
            import lz4.frame  # only other programs' files need it

            raw = lz4.frame.decompress(chunk.data)
        elif not chunk.compression:
            raw = chunk.data
        else:
            raise ValueError(f"compression {chunk.compression!r}")
        if chunk.uncompressed_crc and zlib.crc32(raw) != chunk.uncompressed_crc:
            raise ValueError("checksum of a chunk")
        view, position, total = memoryview(raw), 0, len(raw)
        while position + _HEAD.size <= total:
            opcode, length = _HEAD.unpack_from(view, position)
            start = position + _HEAD.size
            self._take(opcode, view[start : start + length])
            position = start + length


def _stream(body: memoryview) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))
