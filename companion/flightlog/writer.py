"""`FlightLog`: what the flight loop calls. It only puts bytes on a queue; a thread of its own writes them.

The control thread never waits and never sees an error of the disk: a call costs about a microsecond,
a full queue drops the record and counts it, and every loss is an event in the log and a number in
`health`. The writer thread empties the queue every 50 ms into one chunk of the file, so a SIGKILL
costs at most the records of about that time; a third thread asks the disk to keep what it has
(fdatasync) every half second, on its own because that can take as long as it likes.
"""

from __future__ import annotations

import contextlib
import math
import os
import struct
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.config.errors import UserError
from companion.flightlog import events, poses
from companion.flightlog.channels import CDR_HEADER, WALL_FIELDS_KEY, ChannelSpec
from companion.flightlog.health import LogHealth, free_bytes, open_for_writing
from companion.flightlog.mcap_file import McapFile

PROFILE = "companion"
LIBRARY = "dtlannc-companion"
FLUSH_INTERVAL_S = 0.05
SYNC_INTERVAL_S = 0.5
QUEUE_LIMIT = 200_000  # records: about a minute of a busy flight
MAXIMUM_CHUNK_BYTES = 1 << 20
POSE_INTERVAL_NS = 33_000_000  # 30 Hz is what an eye needs
MAVLINK_SCHEMA = (
    "float64 time_s  # [s] autopilot time since boot\nuint8[] frame  # one MAVLink frame as on the wire\n"
)
LIVE_TOPIC = "/live/in"
LIVE_SCHEMA_NAME = "companion/msg/LiveReference"
LIVE_NUMBERS = 15
LIVE_SCHEMA = (
    "float64 time_s  # [s] autopilot time since boot when it arrived\n"
    "float64[15] numbers  # what its meaning rests on: companion/live/heard.py\n"
    "uint8[] data  # as the client sent it\n"
)
MAVLINK_TOPICS = {"in": "/mavlink/in", "out": "/mavlink/out"}
MAVLINK_SCHEMA_NAME = "companion/msg/MavlinkFrame"

_Part = NDArray[np.float64] | NDArray[np.void] | np.void | float
_DOUBLE = struct.Struct("<d")
_FLOAT64 = np.dtype(np.float64)
_RECORD_HEAD = struct.Struct("<4sd")
_FRAME_HEAD = struct.Struct("<4sdI")
LIVE_HEAD = struct.Struct(f"<4sd{LIVE_NUMBERS}dI")


class Channel:
    """A numeric channel of an open log, as `FlightLog.define` returns it: hand it back to `record`."""

    __slots__ = ("channel_id", "frame", "next_pose_ns", "pose_ids", "pose_slices", "spec")

    def __init__(self, spec: ChannelSpec) -> None:
        """Resolve what the writer thread needs."""
        self.spec = spec
        self.channel_id = 0  # given by the writer thread
        self.frame = spec.topic.strip("/").replace("/", "_")
        self.pose_ids = (0, 0)
        self.next_pose_ns = -(1 << 63)
        self.pose_slices: tuple[slice, slice | None] | None = None
        if spec.pose is not None:
            position, quaternion = spec.pose
            self.pose_slices = (spec.slice_of(position), spec.slice_of(quaternion) if quaternion else None)


class FlightLog:
    """One flight's MCAP file. Use it from any thread; close it, or use it as a context manager.

    Times are the autopilot's, in seconds since its boot; `utc_offset_ns` (added to make `log_time`)
    stands in the metadata. Nothing but the constructor, `define` and `close` can raise.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        metadata: Mapping[str, str] | None = None,
        attachments: Mapping[str, str | bytes] | None = None,
        *,
        channels: Sequence[ChannelSpec] = (),
        utc_offset_ns: int | None = None,
        overwrite: bool = False,
        minimum_free_bytes: int = 64 << 20,
        queue_limit: int = QUEUE_LIMIT,
        flush_interval_s: float = FLUSH_INTERVAL_S,
    ) -> None:
        """Open the file and start writing.

        Args:
            path: the file to make; folders above it are made too.
            metadata: what describes the flight (controller, level, firmware, mass_ratio, seed, …).
            attachments: file name → content (settings.toml, profile.toml, …).
            channels: channels to define at once; see `define`.
            utc_offset_ns: UTC minus autopilot time. Default: now, as if the autopilot booted now.
            overwrite: replace an existing file.
            minimum_free_bytes: refuse to start with less room than this on the disk.
            queue_limit: records that may wait for the writer thread.
            flush_interval_s: how often the queue is emptied into the file; what a SIGKILL can cost.

        Raises:
            UserError: the file exists, its folder cannot be written, or the disk is full.
        """
        self.path = Path(path)
        self.utc_offset_ns = time.time_ns() if utc_offset_ns is None else utc_offset_ns
        self._queue: deque[tuple[Any, ...]] = deque()
        self._limit = queue_limit
        self._interval = flush_interval_s
        self._dropped = self._rejected = self._lost = self._written = 0
        self._reported = (0, 0, 0)
        self._unfit: str = ""
        self._trouble = ""
        self._last_time_s = math.nan  # of the record before: most share their instant with it
        self._last_time_ns = 0
        self._room = free_bytes(self.path)
        self._channels: dict[str, Channel] = {}
        self._by_topic: dict[str, int] = {}
        self._closed = False
        self._stop = threading.Event()
        self._descriptor = open_for_writing(self.path, overwrite, minimum_free_bytes)
        try:
            self._file = McapFile(self._descriptor, profile=PROFILE, library=LIBRARY)
            self._prepare()
        except OSError as error:
            os.close(self._descriptor)
            raise UserError(
                f"cannot write the log {self.path}: {error.strerror}; choose another --log"
            ) from error
        self.metadata("clock", {"utc_offset_ns": str(self.utc_offset_ns)})
        if metadata:
            self.metadata("flight", metadata)
        for name, content in (attachments or {}).items():
            self.attach(name, content)
        for spec in channels:
            self.define(spec)
        self._threads = [
            threading.Thread(target=self._write_until_stopped, name="flight log writer", daemon=True),
            threading.Thread(target=self._sync_until_stopped, name="flight log sync", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    # What the control thread calls -------------------------------------------------------------------

    def define(self, spec: ChannelSpec) -> Channel:
        """Add a numeric channel. Raises ValueError when the topic is taken by another layout."""
        known = self._channels.get(spec.topic)
        if known is not None:
            if known.spec != spec:
                raise ValueError(f"topic {spec.topic} is already defined with other fields")
            return known
        channel = self._channels[spec.topic] = Channel(spec)
        self._queue.append(("define", channel))
        return channel

    def record(self, channel: Channel, time_s: float, *parts: _Part) -> None:
        """Log one record: `parts` are the fields in order, as float64 arrays and floats, or one packed record.

        Never blocks, never raises: what does not fit the channel is counted as rejected. An array belongs to the log from
        now on and must not be changed: its numbers are read by the writer's thread, which has more time.
        """
        if len(self._queue) >= self._limit:
            self._dropped += 1
        else:
            self._queue.append(("record", channel, time_s, parts))

    def event(self, kind: str, time_s: float, **fields: Any) -> None:
        """Log an event (`events.KINDS` lists the usual ones). Fields may be anything; never raises."""
        self._put("event", kind, time_s, fields)

    def mavlink(self, direction: str, time_s: float, frame: bytes) -> None:
        """Log a raw MAVLink frame; `direction` is `in` or `out`."""
        self._put("mavlink", direction, time_s, frame)

    def live_reference(self, time_s: float, numbers: tuple[float, ...], data: bytes) -> None:
        """Log what another program sent as a reference, as it came, with the LIVE_NUMBERS that its meaning rests on."""
        self._put("live", time_s, numbers, data)

    def path_enu(self, name: str, time_s: float, points_enu: NDArray[np.float64]) -> None:
        """Log a path (N, 3) m for the 3D view, e.g. the whole reference when tracking starts."""
        self._put("path", name, time_s, np.array(points_enu, dtype=np.float64))

    def metadata(self, name: str, values: Mapping[str, object]) -> None:
        """Log name → text pairs: `flight`, `versions`, `parameters` … (`wall…`: not in the digest)."""
        self._put("metadata", name, {str(key): str(value) for key, value in values.items()})

    def attach(self, name: str, content: str | bytes, media_type: str = "") -> None:
        """Put a whole file into the log, e.g. `profile.toml`."""
        kinds = {".json": "application/json", ".toml": "application/toml", ".csv": "text/csv"}
        media_type = media_type or kinds.get(Path(name).suffix, "text/plain")
        self._put(
            "attach", name, media_type, content.encode() if isinstance(content, str) else bytes(content)
        )

    def _put(self, *item: Any) -> None:
        if len(self._queue) >= self._limit:
            self._dropped += 1
        else:
            self._queue.append(item)

    @property
    def waiting(self) -> int:
        """Records waiting for the writer thread."""
        return len(self._queue)

    @property
    def health(self) -> LogHealth:
        """How the log is doing. Its room is that of the last look, SYNC_INTERVAL_S ago at most: this asks no disk."""
        waits, room = len(self._queue), self._room
        return LogHealth(self._written, waits, self._dropped, self._rejected, self._lost, room, self._trouble)

    def close(self, timeout_s: float = 10.0) -> LogHealth:
        """Write what waits, the index and the footer. Safe to call twice. Returns the final health.

        Gives up after `timeout_s` on a disk that does not answer; the file is then a cut one.
        """
        if not self._closed:
            self._closed = True
            self._stop.set()
            for thread in self._threads:
                thread.join(timeout_s)
            if any(thread.is_alive() for thread in self._threads):
                self._trouble = f"the disk did not answer for {timeout_s:g} s: the log is cut"
            else:
                os.close(self._descriptor)
        return self.health

    def __enter__(self) -> FlightLog:
        """Return itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close."""
        self.close()

    # What the writer thread does ---------------------------------------------------------------------

    def _prepare(self) -> None:
        """Write the channels every log has."""
        file = self._file
        schema = file.add_schema(events.SCHEMA_NAME, "jsonschema", events.SCHEMA)
        self._by_topic["events"] = file.add_channel(events.TOPIC, "json", schema)
        schema = file.add_schema(MAVLINK_SCHEMA_NAME, "ros2msg", MAVLINK_SCHEMA.encode())
        for direction, topic in MAVLINK_TOPICS.items():
            self._by_topic[direction] = file.add_channel(topic, "cdr", schema)
        self._scene_schema, self._pose_schema, self._transform_schema = (
            file.add_schema(item.name, item.encoding, item.data)
            for item in (poses.SCENE_SCHEMA, poses.POSE_SCHEMA, poses.TRANSFORM_SCHEMA)
        )
        self._by_topic["path"] = file.add_channel(poses.PATH_TOPIC, "protobuf", self._scene_schema)
        self._by_topic["tf"] = file.add_channel(poses.TRANSFORM_TOPIC, "protobuf", self._transform_schema)

    def _write_until_stopped(self) -> None:
        while not self._stop.wait(self._interval):
            self._drain()
        self._drain()
        with contextlib.suppress(OSError):
            losses = {"dropped": self._dropped, "rejected": self._rejected, "lost": self._lost}
            values = {name: str(count) for name, count in losses.items()}
            self._guard(self._file.add_metadata, "log", values | {"trouble": self._trouble or self._unfit})
            self._guard(self._file.finish)
            os.fsync(self._descriptor)

    def _sync_until_stopped(self) -> None:
        while not self._stop.wait(SYNC_INTERVAL_S):
            self._room = free_bytes(self.path)
            try:
                os.fdatasync(self._descriptor)
            except OSError as error:
                self._trouble = f"the disk does not keep the log: {error.strerror}"

    def _drain(self) -> None:
        """Empty the queue into the file; whatever is wrong with one record stays with that record."""
        queue, file = self._queue, self._file
        for _ in range(len(queue)):
            item = queue.popleft()
            try:
                self._handle(item)
            except OSError as error:
                self._note_trouble(error)
                if item[0] in ("define", "metadata", "attach"):
                    queue.append(item)  # asked for once and needed: again when there is room
            except Exception as error:
                self._rejected += 1
                what = item[1].spec.topic if item[0] == "record" else item[0]
                self._unfit = f"{what}: {error}"
            if file.pending_bytes > MAXIMUM_CHUNK_BYTES:
                self._flush()
        self._report_losses()
        self._flush()

    def _guard(self, call: Any, *arguments: Any) -> None:
        """Call, and keep the account of what an OSError cost before passing it on."""
        try:
            call(*arguments)
        except OSError as error:
            self._note_trouble(error)
            raise

    def _note_trouble(self, error: OSError) -> None:
        self._trouble = f"cannot write the log {self.path}: {error.strerror}"

    def _flush(self) -> None:
        count = self._file.pending_messages
        try:
            self._guard(self._file.flush)
            self._written += count
        except OSError:
            self._lost += count

    def _report_losses(self) -> None:
        losses = (self._dropped, self._rejected, self._lost)
        if losses == self._reported or (self._trouble and not self._file.pending_messages):
            return  # on a full disk the report itself would be lost, and reported again
        self._reported = losses
        text = self._trouble or self._unfit or "the log's queue was full"
        fields = {"text": text, "dropped": losses[0], "rejected": losses[1], "lost": losses[2]}
        seconds = (self._last_time_ns - self.utc_offset_ns) / 1e9
        data = events.encode_event("log", seconds, fields)
        self._file.add_message(self._by_topic["events"], max(self._last_time_ns, 0), data)

    def _log_time(self, time_s: float) -> int:
        """Return autopilot time as log_time in ns. A time that is none is written as the last good one."""
        if time_s != self._last_time_s and math.isfinite(time_s):
            self._last_time_s = time_s
            self._last_time_ns = max(0, round(time_s * 1e9) + self.utc_offset_ns)
        return self._last_time_ns

    def _handle(self, item: tuple[Any, ...]) -> None:
        kind = item[0]
        if kind == "record":
            self._handle_record(*item[1:])
        elif kind == "mavlink":
            direction, time_s, frame = item[1:]
            data = _FRAME_HEAD.pack(CDR_HEADER, time_s, len(frame)) + frame
            self._file.add_message(self._by_topic[direction], self._log_time(time_s), data)
        elif kind == "live":
            if LIVE_TOPIC not in self._by_topic:
                schema = self._file.add_schema(LIVE_SCHEMA_NAME, "ros2msg", LIVE_SCHEMA.encode())
                self._by_topic[LIVE_TOPIC] = self._file.add_channel(LIVE_TOPIC, "cdr", schema)
            time_s, numbers, data = item[1:]
            body = LIVE_HEAD.pack(CDR_HEADER, time_s, *numbers, len(data)) + data
            self._file.add_message(self._by_topic[LIVE_TOPIC], self._log_time(time_s), body)
        elif kind == "event":
            name, time_s, fields = item[1:]
            data = events.encode_event(name, time_s, fields)
            self._file.add_message(self._by_topic["events"], self._log_time(time_s), data)
        elif kind == "define":
            self._handle_define(item[1])
        elif kind == "metadata":
            self._file.add_metadata(item[1], item[2])
        elif kind == "attach":
            self._file.add_attachment(item[1], item[2], item[3], self._last_time_ns)
        elif kind == "path":
            log_time = self._log_time(item[2])
            self._file.add_message(
                self._by_topic["path"], log_time, poses.encode_path(log_time, item[1], item[3])
            )

    def _handle_define(self, channel: Channel) -> None:
        spec, file = channel.spec, self._file
        schema = file.add_schema(spec.schema_name, "ros2msg", spec.definition().encode())
        if channel.pose_slices is not None:
            pose = file.add_channel(f"/pose/{channel.frame}", "protobuf", self._pose_schema)
            channel.pose_ids = (pose, self._by_topic["tf"])
        note = {"wall_clock": "true"} if spec.wall_clock else {}
        if spec.wall_fields:
            note[WALL_FIELDS_KEY] = ",".join(spec.wall_fields)
        channel.channel_id = file.add_channel(spec.topic, "cdr", schema, note)

    def _handle_record(self, channel: Channel, time_s: float, parts: tuple[_Part, ...]) -> None:
        spec = channel.spec
        body = b"".join(
            [  # the usual case without a call
                part.tobytes() if type(part) is np.ndarray and part.dtype is _FLOAT64 else _packed(part)
                for part in parts
            ]
        )
        if len(body) != 8 * spec.width:
            raise ValueError(f"takes {spec.width} numbers, was given {len(body) / 8:g}")
        if not channel.channel_id:
            self._lost += 1  # the disk refused the channel itself; it is tried again
            return
        log_time = self._log_time(time_s)
        self._file.add_message(channel.channel_id, log_time, _RECORD_HEAD.pack(CDR_HEADER, time_s) + body)
        if channel.pose_slices is not None and log_time >= channel.next_pose_ns:
            channel.next_pose_ns = log_time + POSE_INTERVAL_NS
            numbers = np.frombuffer(body)
            where, turn = channel.pose_slices
            quaternion = [1.0, 0.0, 0.0, 0.0] if turn is None else numbers[turn].tolist()
            encoded = poses.encode_pose(log_time, channel.frame, numbers[where].tolist(), quaternion)
            for channel_id, data in zip(channel.pose_ids, encoded, strict=True):
                self._file.add_message(channel_id, log_time, data)


def _packed(part: _Part) -> bytes:
    """Return the bytes of one field or of a whole record. The usual case first: this runs for every field."""
    if type(part) is float:
        return _DOUBLE.pack(part)
    if isinstance(part, (np.ndarray, np.void)):
        if part.dtype is _FLOAT64 or part.dtype.names or part.dtype == _FLOAT64:
            return part.tobytes()
        return np.asarray(part, dtype=np.float64).tobytes()
    return _DOUBLE.pack(part)
