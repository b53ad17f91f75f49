"""An MCAP file that is whole at every flush: chunks, indexes and summary, written straight to the file.

Why not one of the two libraries (scripts/bench/log_writer.py measures them): with a flush every 200 records,
one record costs 1.9 µs here, 3.3 µs in foxglove-sdk's writer, 10.7 µs in the mcap package's, under a GIL that
the control thread needs too. And neither says what a full disk took: here a failed write cuts the file back
to its last whole chunk, so that it stays readable, is continued when there is room again, and the loss is
counted. The rare records are laid out by `mcap.records`.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Mapping

import zstandard
from mcap import records as layout
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, record length, channel, sequence, log time, publish time
_MESSAGE_FIXED = 22  # bytes of a message record after its length, before its data


def _bytes_of(record: layout.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


class McapFile:
    """Writes one MCAP file through an open file descriptor. Not thread-safe: one thread owns it.

    `descriptor` must be seekable and empty; it is not closed here. Every method that writes raises
    OSError when the file cannot take the bytes; the file then ends at its last whole record, and the
    messages of that chunk are lost (`flush` says how many).
    """

    def __init__(self, descriptor: int, *, profile: str = "", library: str = "", level: int = 1) -> None:
        """Write magic and header. `level` is zstd's, 1 being the quickest."""
        self._descriptor = descriptor
        self._offset = 0
        self._compress = zstandard.ZstdCompressor(level=level).compress
        self._schemas: dict[int, layout.Schema] = {}
        self._channels: dict[int, layout.Channel] = {}
        self._counts: dict[int, int] = {}
        self._sequence: dict[int, int] = {}
        self._chunk_indexes: list[layout.ChunkIndex] = []
        self._attachment_indexes: list[layout.AttachmentIndex] = []
        self._metadata_indexes: list[layout.MetadataIndex] = []
        self._start_chunk()
        self._write(MAGIC + _bytes_of(layout.Header(profile=profile, library=library)))

    def _start_chunk(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0
        self._messages = 0
        self._index: dict[int, list[int]] = {}  # of each channel: log time and offset, in turn
        self._first = 1 << 63
        self._last = 0

    def _write(self, data: bytes) -> int:
        """Append `data` whole or not at all. Returns the offset it starts at."""
        start, view = self._offset, memoryview(data)
        try:
            while view:
                view = view[os.write(self._descriptor, view) :]
        except OSError:
            os.ftruncate(self._descriptor, start)
            os.lseek(self._descriptor, start, os.SEEK_SET)
            raise
        self._offset = start + len(data)
        return start

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Write a schema, at once and outside chunks: no failed chunk takes it along. Returns its id."""
        record = layout.Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data)
        self._write(_bytes_of(record))
        self._schemas[record.id] = record
        return record.id

    def add_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: Mapping[str, str] | None = None
    ) -> int:
        """Write a channel, at once. Returns its id."""
        record = layout.Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=message_encoding,
            schema_id=schema_id,
            metadata=dict(metadata or {}),
        )
        self._write(_bytes_of(record))
        self._channels[record.id] = record
        self._counts[record.id] = self._sequence[record.id] = 0
        return record.id

    def add_message(
        self, channel_id: int, log_time_ns: int, data: bytes, publish_time_ns: int | None = None
    ) -> None:
        """Put a message into the chunk in hand. Touches no file."""
        sequence = self._sequence[channel_id]
        self._sequence[channel_id] = sequence + 1
        length = len(data) + _MESSAGE_FIXED
        publish = log_time_ns if publish_time_ns is None else publish_time_ns
        head = _MESSAGE.pack(5, length, channel_id, sequence & 0xFFFFFFFF, log_time_ns, publish)
        self._parts += (head, data)
        entries = self._index.get(channel_id)
        if entries is None:
            entries = self._index[channel_id] = []
        entries += (log_time_ns, self._size)
        self._size += length + 9
        self._messages += 1
        if log_time_ns < self._first:
            self._first = log_time_ns
        if log_time_ns > self._last:
            self._last = log_time_ns

    @property
    def pending_bytes(self) -> int:
        """Uncompressed size of the chunk in hand."""
        return self._size

    @property
    def pending_messages(self) -> int:
        """Messages in the chunk in hand: what a failing `flush` loses."""
        return self._messages

    def flush(self) -> None:
        """Write the chunk in hand with its message indexes. Whatever happens, a new one is begun."""
        if not self._messages:
            return
        raw = b"".join(self._parts)
        index, first, last = self._index, self._first, self._last
        self._start_chunk()
        packed = self._compress(raw)
        chunk = _bytes_of(
            layout.Chunk(
                compression="zstd",
                data=packed,
                message_start_time=first,
                message_end_time=last,
                uncompressed_crc=zlib.crc32(raw),
                uncompressed_size=len(raw),
            )
        )
        offsets, tail, position = {}, [], self._offset + len(chunk)
        for channel_id, entries in index.items():
            size = 8 * len(entries)
            record = struct.pack(
                f"<BQHI{len(entries)}Q", Opcode.MESSAGE_INDEX, 6 + size, channel_id, size, *entries
            )
            offsets[channel_id] = position
            position += len(record)
            tail.append(record)
        start = self._write(chunk + b"".join(tail))
        for channel_id, entries in index.items():
            self._counts[channel_id] += len(entries) // 2
        self._chunk_indexes.append(
            layout.ChunkIndex(
                chunk_length=len(chunk),
                chunk_start_offset=start,
                compression="zstd",
                compressed_size=len(packed),
                message_end_time=last,
                message_index_length=position - start - len(chunk),
                message_index_offsets=offsets,
                message_start_time=first,
                uncompressed_size=len(raw),
            )
        )

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write name → text pairs, at once."""
        data = _bytes_of(layout.Metadata(name=name, metadata=dict(values)))
        start = self._write(data)
        self._metadata_indexes.append(layout.MetadataIndex(offset=start, length=len(data), name=name))

    def add_attachment(
        self, name: str, media_type: str, data: bytes, log_time_ns: int = 0, create_time_ns: int = 0
    ) -> None:
        """Write a file into the file, at once."""
        record = layout.Attachment(
            create_time=create_time_ns, log_time=log_time_ns, name=name, media_type=media_type, data=data
        )
        packed = _bytes_of(record)
        start = self._write(packed)
        self._attachment_indexes.append(
            layout.AttachmentIndex(
                offset=start,
                length=len(packed),
                create_time=create_time_ns,
                log_time=log_time_ns,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def finish(self) -> None:
        """Write the chunk in hand, the summary and the footer: from now on the file is whole and indexed."""
        self.flush()
        groups: list[tuple[int, list[bytes]]] = [
            (Opcode.SCHEMA, [_bytes_of(item) for item in self._schemas.values()]),
            (Opcode.CHANNEL, [_bytes_of(item) for item in self._channels.values()]),
            (Opcode.STATISTICS, [_bytes_of(self._statistics())]),
            (Opcode.CHUNK_INDEX, [_bytes_of(item) for item in self._chunk_indexes]),
            (Opcode.ATTACHMENT_INDEX, [_bytes_of(item) for item in self._attachment_indexes]),
            (Opcode.METADATA_INDEX, [_bytes_of(item) for item in self._metadata_indexes]),
        ]
        data_end = _bytes_of(layout.DataEnd(data_section_crc=0))
        summary_start = self._offset + len(data_end)
        summary, offsets = b"", b""
        for opcode, items in groups:
            if items:
                body = b"".join(items)
                offsets += _bytes_of(
                    layout.SummaryOffset(
                        group_opcode=opcode, group_start=summary_start + len(summary), group_length=len(body)
                    )
                )
                summary += body
        offset_start = summary_start + len(summary)
        opening = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offset_start)
        crc = zlib.crc32(summary + offsets + opening)
        self._write(data_end + summary + offsets + opening + struct.pack("<I", crc) + MAGIC)

    def _statistics(self) -> layout.Statistics:
        return layout.Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunk_indexes),
            message_count=sum(self._counts.values()),
            message_end_time=max((item.message_end_time for item in self._chunk_indexes), default=0),
            message_start_time=min((item.message_start_time for item in self._chunk_indexes), default=0),
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )
