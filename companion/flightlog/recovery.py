"""Make a whole, indexed file of one that was cut. Reading does not need it; Foxglove and others do."""

from __future__ import annotations

import heapq
import itertools
import operator
import os
from dataclasses import dataclass
from pathlib import Path

from companion.config.errors import UserError
from companion.flightlog.mcap_file import McapFile
from companion.flightlog.reader import RawChannel, read_raw

CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Recovery:
    """What was saved."""

    output: Path
    messages: int
    seconds: float  # from the first record to the last
    cut: str  # what was wrong with the file, empty if nothing was


def recover(source: str | os.PathLike[str], output: str | os.PathLike[str] | None = None) -> Recovery:
    """Write all that `source` holds to `output` (default: `<name>.recovered.mcap`), messages by time.

    Raises UserError when `source` is no log or `output` exists or cannot be written.
    """
    raw = read_raw(source)
    target = Path(output) if output is not None else raw.path.with_suffix(".recovered.mcap")
    partial = target.with_name(
        target.name + ".part"
    )  # a second cut must not leave half a file that looks whole
    if target.exists():
        raise UserError(f"{target} exists already; name another file with -o")
    try:
        descriptor = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        try:
            file = McapFile(descriptor, profile=raw.profile, library=raw.library, level=3)
            for name, values in raw.metadata:
                file.add_metadata(name, values)
            for item in raw.attachments:
                file.add_attachment(item.name, item.media_type, item.data, item.log_time, item.create_time)
            messages = _copy_messages(file, raw.channels)
            if raw.cut:
                file.add_metadata("recovery", {"source": raw.path.name, "cut": raw.cut})
            file.finish()
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        os.replace(partial, target)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise UserError(
            f"cannot write {target}: {error.strerror or error}; name another file with -o"
        ) from error
    times = [time for item in raw.channels for time in item.log_times_ns]
    return Recovery(target, messages, (max(times) - min(times)) / 1e9 if times else 0.0, raw.cut)


def _copy_messages(file: McapFile, channels: list[RawChannel]) -> int:
    """Copy all messages by log time, those of one channel in their own order even where it is not that of time."""
    schemas: dict[tuple[str, str, bytes], int] = {}
    streams = []
    for item in channels:
        key = (item.schema_name, item.schema_encoding, item.schema_data)
        if key not in schemas:
            schemas[key] = file.add_schema(*key) if item.schema_name else 0
        channel_id = file.add_channel(item.topic, item.encoding, schemas[key], item.metadata)
        rank = itertools.accumulate(item.log_times_ns, max)
        streams.append(
            zip(
                rank,
                itertools.repeat(channel_id),
                item.log_times_ns,
                item.publish_times_ns,
                item.messages,
                strict=False,
            )
        )
    count = 0
    for _, channel_id, log_time, publish_time, message in heapq.merge(*streams, key=operator.itemgetter(0)):
        file.add_message(channel_id, log_time, message, publish_time)
        count += 1
        if file.pending_bytes > CHUNK_BYTES:
            file.flush()
    return count
