"""Raw MAVLink out of a log, as the `.tlog` that Mission Planner, QGroundControl and pymavlink read."""

from __future__ import annotations

import heapq
import os
import struct
from collections.abc import Collection
from pathlib import Path

from companion.config.errors import UserError
from companion.flightlog.reader import FlightRecord

_STAMP = struct.Struct(">Q")


def export_tlog(
    record: FlightRecord, path: str | os.PathLike[str], directions: Collection[str] = ("in", "out")
) -> int:
    """Write the frames of `directions` in order of time: 8 bytes big-endian µs of UTC, then the frame.

    Returns how many. Raises UserError when the log has none or the file cannot be written.
    """
    streams = [
        [(int(time), rank, frame) for time, frame in zip(*record.mavlink[name], strict=True)]
        for rank, name in enumerate(("in", "out"))
        if name in directions and name in record.mavlink
    ]
    frames = list(heapq.merge(*streams, key=lambda row: row[:2]))
    if not frames:
        raise UserError(f"{record.path} holds no raw MAVLink")
    try:
        with Path(path).open("wb") as file:
            for time_ns, _, frame in frames:
                file.write(_STAMP.pack(time_ns // 1000))
                file.write(frame)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}") from error
    return len(frames)
