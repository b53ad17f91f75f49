"""Which messages a client gets, how often, and when they are due.

Messages are sent at instants of a fixed loop (10 ms, or the shortest interval asked for), as autopilots do it; a
message whose interval is not a multiple keeps its mean rate. Within one instant those that say how the vehicle moves
(LEADING) go first, for in lockstep a client acts upon them while the rest is still being made; else the order on the wire
is that of the definitions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from sitl_stub.firmware.common.wire_values import Values
from sitl_stub.mavlink.codec import LAYOUTS, MessageLayout
from sitl_stub.mavlink.links import Link

LOOP_PERIOD_US = 10_000
LEADING = frozenset(("ODOMETRY", "LOCAL_POSITION_NED", "ATTITUDE", "ATTITUDE_QUATERNION"))

Builder = Callable[[Link], Values | None]
"""Values of a message in wire order, or None when there is nothing to say yet."""
StreamRow = tuple[str, Builder, Mapping[str, float]]
"""A message the firmware can send: name, builder, default rate by link role."""


@dataclass(frozen=True, slots=True)
class StreamDefinition:
    """A message the firmware can send."""

    layout: MessageLayout
    build: Builder
    default_hz: Mapping[str, float]
    """Rate by link role; a role that is missing gets the message only when it asks for it."""


@dataclass(slots=True)
class Stream:
    """A message on one link."""

    definition: StreamDefinition
    interval_us: float = 0.0
    """0: not sent."""
    next_us: float = 0.0


@dataclass(slots=True)
class LinkStreams:
    """All streams of one link."""

    streams: dict[int, Stream] = field(default_factory=dict)
    leading: list[Stream] = field(default_factory=list)
    """Those of LEADING that are on."""
    following: list[Stream] = field(default_factory=list)
    """The others that are on."""
    parameters_waiting: list[int] = field(default_factory=list)
    """Indices of parameters still to be sent for a list request, last one first."""

    def refresh(self) -> None:
        """Rebuild the lists of streams that are on."""
        active = [stream for stream in self.streams.values() if stream.interval_us > 0]
        self.leading = [stream for stream in active if stream.definition.layout.name in LEADING]
        self.following = [stream for stream in active if stream.definition.layout.name not in LEADING]

    def send_due(self, link: Link, time_us: int, streams: list[Stream]) -> int:
        """Send what of `streams` (`leading` or `following`) is due at `time_us`; returns the number of messages."""
        sent = 0
        for stream in streams:
            if stream.next_us > time_us:
                continue
            stream.next_us += stream.interval_us
            if stream.next_us <= time_us:
                stream.next_us = time_us + stream.interval_us
            values = stream.definition.build(link)
            if values is not None:
                link.send_frame(stream.definition.layout, values)
                sent += 1
        return sent

    @property
    def shortest_interval_us(self) -> float:
        """Shortest interval of any stream that is on."""
        return min((stream.interval_us for stream in self.leading + self.following), default=float("inf"))


class StreamTable:
    """The definitions of a firmware and the streams of every link."""

    def __init__(self, control_period_us: int) -> None:
        self.definitions: dict[int, StreamDefinition] = {}
        self.control_period_us = control_period_us
        self.loop_period_us = LOOP_PERIOD_US
        self.links: dict[int, LinkStreams] = {}

    def define(self, rows: Sequence[StreamRow]) -> None:
        """Take on what the firmware can send, in the order of sending."""
        for name, build, default_hz in rows:
            layout = LAYOUTS[name]
            self.definitions[layout.message_id] = StreamDefinition(layout, build, default_hz)

    def open(self, link: Link, time_us: int) -> LinkStreams:
        """Give a new link its default streams."""
        streams = LinkStreams()
        for message_id, definition in self.definitions.items():
            rate = definition.default_hz.get(link.role, 0.0)
            interval = 1e6 / rate if rate > 0 else 0.0
            streams.streams[message_id] = Stream(definition, interval, float(time_us))
        streams.refresh()
        self.links[id(link)] = streams
        self._choose_loop_period()
        return streams

    def close(self, link: Link) -> None:
        """Forget a link."""
        self.links.pop(id(link), None)
        self._choose_loop_period()

    def of(self, link: Link) -> LinkStreams:
        """Streams of a link."""
        return self.links[id(link)]

    def set_interval(self, link: Link, message_id: int, interval_us: float, time_us: int) -> bool:
        """Change one interval: −1 stops, 0 gives the default; False when there is no such message."""
        stream = self.of(link).streams.get(message_id)
        if stream is None:
            return False
        if interval_us < 0:
            stream.interval_us = 0.0
        elif interval_us == 0:
            rate = stream.definition.default_hz.get(link.role, 0.0)
            stream.interval_us = 1e6 / rate if rate > 0 else 0.0
        else:
            stream.interval_us = max(interval_us, self.control_period_us)
        if stream.interval_us > 0:
            # All streams count from boot, so that those with commensurate intervals come together.
            stream.next_us = (time_us // stream.interval_us + 1) * stream.interval_us
        self.of(link).refresh()
        self._choose_loop_period()
        return True

    def _choose_loop_period(self) -> None:
        shortest = min(
            (streams.shortest_interval_us for streams in self.links.values()), default=float("inf")
        )
        period = min(float(LOOP_PERIOD_US), shortest)
        self.loop_period_us = max(int(period) // self.control_period_us, 1) * self.control_period_us

    def send_now(self, link: Link, message_id: int) -> bool:
        """Send one message now, asked for or not; False when there is no such message."""
        definition = self.definitions.get(message_id)
        if definition is None:
            return False
        values = definition.build(link)
        if values is not None:
            link.send_frame(definition.layout, values)
        return True

    def send_named(self, link: Link, *names: str) -> None:
        """Send the messages of these names now."""
        for name in names:
            self.send_now(link, LAYOUTS[name].message_id)
