"""What a flight log holds: the numeric channels, field by field, with units and shapes.

Every numeric channel is a fixed-size record of float64 (or int64), written as CDR (ROS 2's wire format:
four bytes of header, then the numbers) under a `ros2msg` schema that stands in the file itself. So one
record costs a copy of its bytes to write, a whole channel is one `numpy.frombuffer` to read, and
Foxglove, PlotJuggler and `mcap` read it without this package.

The first field of every channel is `time_s`, put there by the writer: the autopilot's time since
boot at which the record holds, bit for bit as it was given (`log_time` is the same rounded to ns).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

TIME_FIELD = "time_s"
WALL_FIELDS_KEY = "wall_fields"  # in the channel's metadata: comma-separated
CDR_HEADER = b"\x00\x01\x00\x00"  # plain CDR, little endian
_FIELD_NAME = re.compile(r"[a-z](?:[a-z0-9]|_(?!_))*")  # what ROS 2 allows in a message definition
_TOPIC = re.compile(r"(?:/[a-z0-9_]+)+")


@dataclass(frozen=True, slots=True)
class FieldSpec:
    """One field: `width` numbers of 8 bytes, laid out row by row when `shape` has two numbers."""

    name: str
    width: int = 1
    unit: str = ""
    note: str = ""
    shape: tuple[int, ...] = ()
    kind: str = "float64"  # or int64

    def __post_init__(self) -> None:
        """Refuse what would not survive in the file. Raises ValueError."""
        if not _FIELD_NAME.fullmatch(self.name):
            raise ValueError(
                f"field name {self.name!r} is not lower-case letters, digits and single underscores"
            )
        if self.width < 1:
            raise ValueError(f"field {self.name!r} has width {self.width}, needs at least 1")
        if self.kind not in ("float64", "int64"):
            raise ValueError(f"field {self.name!r} is of {self.kind}: only float64 and int64 are written")
        if self.shape and math.prod(self.shape) != self.width:
            raise ValueError(f"field {self.name!r}: shape {self.shape} does not hold {self.width} numbers")

    def definition(self) -> str:
        """Return the line of the message definition: type, name, and unit, shape and note as a comment."""
        kind = self.kind if self.width == 1 and not self.shape else f"{self.kind}[{self.width}]"
        shape = f"shape {'x'.join(map(str, self.shape))}" if self.shape else ""
        comment = "; ".join(
            part for part in (f"[{self.unit}]" if self.unit else "", shape, self.note) if part
        )
        return f"{kind} {self.name}" + (f"  # {comment}" if comment else "")


@dataclass(frozen=True, slots=True)
class ChannelSpec:
    """One numeric channel. `pose` names its position and its quaternion field (or None) for 3D views."""

    topic: str
    fields: tuple[FieldSpec, ...]
    pose: tuple[str, str | None] | None = None
    wall_clock: bool = False  # differs between two runs of one seed: left out of the digest
    wall_fields: tuple[str, ...] = ()  # the same for single fields
    width: int = field(init=False)  # doubles given to record(), without time_s
    byte_length: int = field(init=False)  # of one message: header, time_s, the fields

    def __post_init__(self) -> None:
        """Check names and fix the layout. Raises ValueError."""
        object.__setattr__(self, "fields", tuple(self.fields))
        if not _TOPIC.fullmatch(self.topic):
            raise ValueError(f"topic {self.topic!r} is not like /weights/position")
        names = [TIME_FIELD, *(item.name for item in self.fields)]
        if len(set(names)) != len(names):
            raise ValueError(f"topic {self.topic}: a field name comes twice, or is {TIME_FIELD}: {names[1:]}")
        for name, wanted in zip(self.pose or (), (3, 4), strict=False):
            if name is not None and self.slice_of(name).stop - self.slice_of(name).start != wanted:
                raise ValueError(f"topic {self.topic}: pose field {name!r} needs {wanted} numbers")
        for name in self.wall_fields:
            self.slice_of(name)
        object.__setattr__(self, "width", sum(item.width for item in self.fields))
        object.__setattr__(self, "byte_length", len(CDR_HEADER) + 8 * (1 + self.width))

    def slice_of(self, name: str) -> slice:
        """Return where a field lies among the doubles given to `record()`. Raises KeyError."""
        start = 0
        for item in self.fields:
            if item.name == name:
                return slice(start, start + item.width)
            start += item.width
        raise KeyError(f"topic {self.topic} has no field {name!r}")

    @property
    def schema_name(self) -> str:
        """ROS 2 type name, e.g. `companion/msg/WeightsPosition`."""
        words = re.split(r"[/_]", self.topic.strip("/"))
        return "companion/msg/" + "".join(word.capitalize() for word in words)

    def definition(self) -> str:
        """Return the message definition (ros2msg) that goes into the file."""
        time = FieldSpec(TIME_FIELD, 1, "s", "autopilot time since boot at which this record holds")
        return "\n".join(item.definition() for item in (time, *self.fields)) + "\n"


_DEFINITION_LINE = re.compile(r"(float64|int64)(?:\[(\d+)\])?\s+(\w+)\s*(?:#\s*(.*))?")


def parse_definition(text: str) -> tuple[FieldSpec, ...]:
    """Read a message definition back into fields, `time_s` included.

    Raises ValueError for a definition that is not made of float64, int64 and fixed arrays of them.
    """
    fields = []
    for line in text.splitlines():
        if not (line := line.strip()) or line.startswith("#"):
            continue
        match = _DEFINITION_LINE.fullmatch(line)
        if match is None:
            raise ValueError(f"not a record of float64 and int64: {line!r}")
        kind, width, name, comment = match.group(1, 2, 3, 4)
        comment = comment or ""
        unit = re.match(r"\[([^\]]*)\]", comment)
        shape = re.search(r"(?:^|; )shape (\d+(?:x\d+)*)", comment)
        sizes = tuple(int(part) for part in shape.group(1).split("x")) if shape else ()
        fields.append(FieldSpec(name, int(width or 1), unit.group(1) if unit else "", "", sizes, kind))
    return tuple(fields)


STATE = ChannelSpec(
    "/state",
    (
        FieldSpec("position_enu", 3, "m"),
        FieldSpec("velocity_enu", 3, "m/s"),
        FieldSpec("quaternion_wxyz", 4, "1", "Hamilton, body FLU to world ENU"),
        FieldSpec("body_rate_flu", 3, "rad/s"),
        FieldSpec("position_age_s", 1, "s", "age of the position message when the step ran, autopilot time"),
    ),
    pose=("position_enu", "quaternion_wxyz"),
)
"""The state the control law was given (after extrapolation by the delay)."""

LIVE_SAMPLED = ChannelSpec(
    "/live/sampled",
    (
        FieldSpec(
            "own_time_s", 1, "s", "since the beginning of tracking, at which a reference was asked for"
        ),
        FieldSpec("checksum", 1, "1", "CRC-32 of the reference it gave, in the trajectory's own axes"),
    ),
)
"""References from another program as they were made of what came in (/live/in): a replay makes them again."""

REFERENCE = ChannelSpec(
    "/reference",
    (
        FieldSpec("position_enu", 3, "m"),
        FieldSpec("velocity_enu", 3, "m/s"),
        FieldSpec("acceleration_enu", 3, "m/s^2"),
        FieldSpec("jerk_enu", 3, "m/s^3"),
        FieldSpec("snap_enu", 3, "m/s^4"),
        FieldSpec("yaw_rad", 1, "rad"),
        FieldSpec("yaw_rate_rad_s", 1, "rad/s"),
        FieldSpec("yaw_acceleration_rad_s2", 1, "rad/s^2"),
        FieldSpec("tracking_time_s", 1, "s", "since tracking started; NaN while not tracking"),
    ),
    pose=("position_enu", None),
)
"""Where the vehicle should be at the record's own time (not the time it was computed)."""

SETPOINT = ChannelSpec(
    "/setpoint",
    (
        FieldSpec("level", 1, "", "0 attitude, 1 body_rate, 2 actuator"),
        FieldSpec("thrust_newton", 1, "N"),
        FieldSpec("thrust_normalised", 1, "1", "as sent, 0..1"),
        FieldSpec("quaternion_wxyz", 4, "1", "desired attitude, body FLU to world ENU, as sent"),
        FieldSpec("body_rate_flu", 3, "rad/s"),
        FieldSpec("torque_flu", 3, "N m"),
    ),
)
"""What was asked of the autopilot."""

TRUTH = ChannelSpec(
    "/truth",
    (
        FieldSpec("position_enu", 3, "m"),
        FieldSpec("velocity_enu", 3, "m/s"),
        FieldSpec("quaternion_wxyz", 4, "1", "Hamilton, body FLU to world ENU"),
        FieldSpec("body_rate_flu", 3, "rad/s"),
    ),
    pose=("position_enu", "quaternion_wxyz"),
)
"""The simulator's true state, in the same local frame as /state, at the time it was true."""

TIMING = ChannelSpec(
    "/timing",
    (
        FieldSpec("period_s", 1, "s", "wall clock between the starts of two control steps"),
        FieldSpec("compute_s", 1, "s", "wall clock from message received to setpoint sent"),
        FieldSpec("law_s", 1, "s", "wall clock of the control law alone"),
        FieldSpec("log_queue", 1, "", "records waiting for the log's writer thread"),
    ),
    wall_clock=True,
)
"""How long things took. Its own channel because it alone differs between two runs of one seed."""

ESTIMATES = ChannelSpec(
    "/estimates",
    (
        FieldSpec("hover_thrust", 1, "1", "normalised thrust that holds the weight"),
        FieldSpec("clock_offset_s", 1, "s", "autopilot time minus the companion's"),
        FieldSpec("round_trip_s", 1, "s", "of TIMESYNC"),
        FieldSpec("state_delay_s", 1, "s", "by which the state was extrapolated"),
        FieldSpec("battery_volt", 1, "V"),
    ),
    wall_fields=("clock_offset_s", "round_trip_s"),
)
"""Slow estimates; NaN where there is none."""

STREAMS = ChannelSpec(
    "/streams",
    (
        FieldSpec("message_id", 1, "", "MAVLink's number of the message"),
        FieldSpec("rate_hz", 1, "Hz", "by the messages' time stamps, over 2 s"),
        FieldSpec("jitter_s", 1, "s", "mean difference of the way's duration from message to message"),
        FieldSpec("age_s", 1, "s", "at arrival, by TIMESYNC, median"),
        FieldSpec("age_95_s", 1, "s", "at arrival, 95 % are younger"),
    ),
    wall_clock=True,
)
"""How the autopilot's streams arrive, a record each and second; NaN where its clock does not run like ours."""


def terms_channel(layout: Iterable[tuple[str, int, str]], topic: str = "/terms") -> ChannelSpec:
    """Return the channel for packed terms, from their layout of (name, width, unit); names as `packed_channel`."""
    return ChannelSpec(topic, tuple(FieldSpec(_label(name), width, unit) for name, width, unit in layout))


def packed_channel(
    topic: str, dtype: np.dtype[np.void], units: Mapping[str, str] | None = None
) -> ChannelSpec:
    """Return the channel for a packed record of 8-byte numbers, such as `companion.control.packing.TERMS`.

    Nested records are flattened, `position.U_error` becoming `position_u_error` (ROS 2 wants lower case).
    `units` gives a unit by that name. Log it with `record(channel, time_s, values)`, values being the record.
    Raises ValueError where the record has padding or other types.
    """
    fields: list[FieldSpec] = []
    _flatten(dtype, "", units or {}, fields)
    if 8 * sum(item.width for item in fields) != dtype.itemsize:
        raise ValueError(f"the record for {topic} has padding: {dtype.itemsize} bytes")
    return ChannelSpec(topic, tuple(fields))


def _flatten(dtype: np.dtype[np.void], prefix: str, units: Mapping[str, str], into: list[FieldSpec]) -> None:
    for name in dtype.names or ():
        inner = dtype[name]
        label = _label(prefix + name)
        if inner.names:
            _flatten(inner, f"{label}_", units, into)
            continue
        shape = inner.shape
        width = math.prod(shape) if shape else 1
        into.append(
            FieldSpec(
                label, width, units.get(label, ""), "", shape if len(shape) > 1 else (), inner.base.name
            )
        )


def _label(name: str) -> str:
    """Return a name as ROS 2 allows it: lower case, single underscores for dots and the like."""
    return re.sub("[^a-z0-9]+", "_", name.lower()).strip("_")


def weights_channel(loop: str, neurons: int) -> ChannelSpec:
    """Return the channel of one network's output weights Ŵ (L, 3); `loop` is `position` or `attitude`."""
    shape = (neurons, 3)
    return ChannelSpec(f"/weights/{loop}", (FieldSpec("output_weights", 3 * neurons, "", "W", shape),))
