"""What faults do to frames on their way: a pipeline of active faults and a queue of frames that are late.

A frame is the unit, whatever carries it. In lockstep the TIMESYNC questions and answers that simulated time waits for go
past all this: they are no part of the link. Frames keep their order, except those that a fault holds back. When the last
fault of the link ends, everything that is late arrives at once.
"""

from __future__ import annotations

import functools
import heapq
import random
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol

from sitl_stub.mavlink.codec import LAYOUTS, MessageLayout, Received, renumbered, whole_frame
from sitl_stub.mavlink.links import Link

if TYPE_CHECKING:
    from sitl_stub.firmware.common.autopilot import Autopilot

Direction = Literal["to_client", "from_client"]


@dataclass(frozen=True, slots=True)
class Parcel:
    """A frame on its way."""

    frame: bytes
    late_s: float = 0.0
    """How late it and, at the earliest, every frame after it arrive."""
    held_s: float = 0.0
    """How much later still, overtaken by others."""


class FrameFault(Protocol):
    """What a fault does with one frame."""

    def affects(self, direction: Direction, message: str) -> bool:
        """Whether it has to do with messages of that name on that way."""

    def passed(self, parcel: Parcel, draw: random.Random) -> list[Parcel]:
        """What becomes of a frame: nothing, itself, or several."""


@dataclass(slots=True)
class _Active:
    fault: FrameFault
    random_for: Callable[[str], random.Random]
    draws: dict[tuple[int, Direction], random.Random] = field(default_factory=dict)

    def draw(self, link_number: int, direction: Direction) -> random.Random:
        """Numbers for one link and direction, so that links do not disturb each other's."""
        key = (link_number, direction)
        if key not in self.draws:
            self.draws[key] = self.random_for(f"{link_number}/{direction}")
        return self.draws[key]


@dataclass(slots=True)
class _Numbers:
    """Sequence numbers of frames to one client, kept whole where lockstep's questions overtake late frames."""

    waiting: int = 0
    """Frames that are late."""
    shown: int = -1
    """Number of the frame that arrived last."""
    shift: int = 0
    """How many questions have overtaken frames: so much is added to a late frame's number."""


class FrameFaults:
    """Every fault of frames of one autopilot."""

    def __init__(self, autopilot: Autopilot) -> None:
        self.autopilot = autopilot
        self._active: list[_Active] = []
        self._queue: list[tuple[int, int, Link, Direction, bytes, Received | None]] = []
        self._muted: Counter[int] = Counter()
        self._order = 0
        self._numbers: dict[int, _Numbers] = {}
        self._link_numbers: dict[int, int] = {}
        self._last_due_us: dict[tuple[int, Direction], int] = {}

    def take_on(self, link: Link) -> None:
        """Stand between `link` and its socket."""
        self._link_numbers[id(link)] = len(self._link_numbers)
        self._numbers[id(link)] = _Numbers()
        link.muted = self._muted
        link.overtaking = functools.partial(self._overtake, link)
        link.outgoing = functools.partial(self._send, link)

    def let_go(self, link: Link) -> None:
        """Forget a link and what is still on its way."""
        link.outgoing, link.overtaking, link.muted = None, None, {}
        self._queue = [item for item in self._queue if item[2] is not link]
        heapq.heapify(self._queue)

    def begin(self, fault: FrameFault, random_for: Callable[[str], random.Random]) -> Callable[[], None]:
        """Let `fault` act on every frame from now on; returns what ends it."""
        active = _Active(fault, random_for)
        self._active.append(active)

        def end() -> None:
            self._active.remove(active)
            if not self._active:
                self._release()

        return end

    def _release(self) -> None:
        """The link is well again: what is still on its way arrives now, in its order."""
        now = self.autopilot.time_us
        waiting = sorted(self._queue, key=lambda item: item[:2])
        self._queue = [(now, order, *item[2:]) for order, item in enumerate(waiting)]
        self._order = len(waiting)
        self._last_due_us.clear()

    def mute(self, messages: Sequence[str]) -> Callable[[], None]:
        """Let the autopilot stop sending messages of these names, to every client; returns what ends it."""
        numbers = [LAYOUTS[name].message_id for name in set(messages)]
        self._muted.update(numbers)

        def end() -> None:
            self._muted.subtract(numbers)
            for number in numbers:
                if not self._muted[number]:
                    del self._muted[number]

        return end

    @property
    def next_due_us(self) -> int | None:
        """When the next late frame arrives."""
        return self._queue[0][0] if self._queue else None

    def deliver_due(self, now_us: int) -> int:
        """Let every late frame arrive that is due; returns how many were sent to clients."""
        sent = 0
        while self._queue and self._queue[0][0] <= now_us:
            _, _, link, direction, frame, message = heapq.heappop(self._queue)
            self._arrive(link, direction, frame, message)
            if direction == "to_client":
                sent += 1
                self._one_less(link)
        return sent

    def take_in(self, link: Link, message: Received) -> None:
        """A frame of a client has come: what reaches the autopilot of it, and when."""
        if not self._active and not self._queue:
            self.autopilot.take_in(link, message)
            return
        link.counters.received -= 1
        self._pass(link, "from_client", message.name, message.frame, message)

    def _send(self, link: Link, layout: MessageLayout, frame: bytes) -> None:
        if not self._active and not self._queue:
            link.send_bytes(frame)
        else:
            self._pass(link, "to_client", layout.name, frame, None)

    def _pass(
        self, link: Link, direction: Direction, name: str, frame: bytes, message: Received | None
    ) -> None:
        parcels = [Parcel(frame)]
        number = self._link_numbers[id(link)]
        for active in self._active:
            if active.fault.affects(direction, name):
                draw = active.draw(number, direction)
                parcels = [out for one in parcels for out in active.fault.passed(one, draw)]
        now = self.autopilot.time_us
        if direction == "to_client" and not self._numbers[id(link)].waiting:
            self._numbers[id(link)].shown = link.writer.sequence - 2 & 0xFF
        for parcel in parcels:
            key = (number, direction)
            in_order = max(now + round(parcel.late_s * 1e6), self._last_due_us.get(key, 0))
            self._last_due_us[key] = in_order
            due = self.autopilot.whole_period_us(in_order + round(parcel.held_s * 1e6))
            whole_message = message if parcel.frame is frame else None
            if due <= now:
                self._arrive(link, direction, parcel.frame, whole_message)
            else:
                self._order += 1
                if direction == "to_client":
                    self._numbers[id(link)].waiting += 1
                heapq.heappush(self._queue, (due, self._order, link, direction, parcel.frame, whole_message))

    def _overtake(self, link: Link, layout: MessageLayout, values: tuple[Any, ...]) -> None:
        """Send a message at once. It takes the number after the last that arrived, and those on their way move up."""
        numbers, writer = self._numbers[id(link)], link.writer
        if not numbers.waiting:
            link.send_bytes(writer.frame(layout, values))
            return
        own, writer.sequence = writer.sequence, (numbers.shown + 1) & 0xFF
        link.send_bytes(writer.frame(layout, values))
        numbers.shown, writer.sequence = writer.sequence - 1 & 0xFF, own
        numbers.shift += 1

    def _with_its_number(self, link: Link, frame: bytes) -> bytes:
        """A frame that arrives, renumbered where something has overtaken it; a damaged one stays as it is."""
        numbers = self._numbers[id(link)]
        header = whole_frame(frame)
        if header is None:
            return frame
        sequence, layout = header
        numbers.shown = (sequence + numbers.shift) & 0xFF
        return renumbered(frame, numbers.shown, layout.crc_extra) if numbers.shift else frame

    def _one_less(self, link: Link) -> None:
        """A late frame has arrived; after the last one the link counts on by itself."""
        numbers = self._numbers[id(link)]
        numbers.waiting -= 1
        if not numbers.waiting:
            link.writer.sequence = (link.writer.sequence + numbers.shift) & 0xFF
            numbers.shift = 0

    def _arrive(self, link: Link, direction: Direction, frame: bytes, message: Received | None) -> None:
        if direction == "to_client":
            link.send_apart(self._with_its_number(link, frame))
        elif message is not None:
            link.counters.received += 1
            self.autopilot.take_in(link, message)
        else:
            for damaged in link.reader.read_datagram(frame):
                self.autopilot.take_in(link, damaged)
