"""Begins and ends faults on a running autopilot, at simulated times, and tells of it.

Everything happens at whole control periods of simulated time, so the same scenario, seed and client give the same bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sitl_stub.faults.fault import Effect, Site
from sitl_stub.faults.frames import FrameFaults
from sitl_stub.faults.scenario import ANCHORS, Entry, Scenario
from sitl_stub.firmware.common.mavlink_ids import Severity
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link

if TYPE_CHECKING:
    from sitl_stub.firmware.common.autopilot import Autopilot


@dataclass(slots=True)
class _Planned:
    entry: Entry
    site: Site
    begins_us: int | None = None
    """None while what it waits for has not happened."""
    effect: Effect | None = None


class FaultDirector:
    """The faults of one autopilot: those of a scenario, and those injected later."""

    def __init__(self, autopilot: Autopilot, scenario: Scenario | None = None, seed: int = 0) -> None:
        """`seed` where the scenario has none of its own."""
        scenario = scenario if scenario is not None else Scenario()
        self.autopilot = autopilot
        self.frames = FrameFaults(autopilot)
        self.announce = scenario.announce
        self.seed = seed if scenario.seed is None else scenario.seed
        self._since_us: dict[str, int] = {"start": 0}
        self._waiting: list[_Planned] = []
        self._running: list[_Planned] = []
        self._count = 0
        self._shared: dict[str, list[float]] = {}
        self._next_us: int | None = None
        autopilot.faults = self
        for link in autopilot.links:
            self.frames.take_on(link)
        for entry in scenario.entries:
            self.plan(entry)

    def plan(self, entry: Entry) -> int | None:
        """Take on a fault; returns when it begins (simulated µs), None while what it comes after has not happened."""
        self._count += 1
        site = Site(self.autopilot, self.frames, f"{self._count}/{entry.fault.kind}", self.seed, self._shared)
        planned = _Planned(entry, site)
        self._waiting.append(planned)
        self._look()
        return planned.begins_us

    def clear(self) -> None:
        """End every fault that runs and forget those to come; frames that are late arrive at once."""
        self._waiting.clear()
        running, self._running = self._running, []
        for planned in running:
            self._end(planned)
        self._look()

    @property
    def running(self) -> list[str]:
        """Kinds of the faults that act now."""
        return [planned.entry.fault.kind for planned in self._running]

    def next_instant_us(self, otherwise_us: int) -> int:
        """The next instant at which something happens here, or `otherwise_us` if that is earlier."""
        instant = otherwise_us
        for due in (self._next_us, self.frames.next_due_us):
            if due is not None and due < instant:
                instant = max(due, self.autopilot.core.time_us + self.autopilot.core.control_period_us)
        return min(instant, otherwise_us)

    def take_on(self, link: Link) -> None:
        """Stand between a client and its socket."""
        self.frames.take_on(link)

    def let_go(self, link: Link) -> None:
        """Forget a client and what is still on its way to or from it."""
        self.frames.let_go(link)

    def take_in(self, link: Link, message: Received) -> None:
        """A message of a client has come: what reaches the autopilot of it, and when."""
        self.frames.take_in(link, message)

    def run(self) -> int:
        """Do what is due at the present instant; returns how many messages went to clients."""
        now = self.autopilot.time_us
        sent = self.frames.deliver_due(now)
        self._look()
        for planned in list(self._running):
            if planned.site.ends_us is not None and planned.site.ends_us <= now:
                self._running.remove(planned)
                sent += self._end(planned)
        for planned in list(self._waiting):
            if planned.begins_us is not None and planned.begins_us <= now:
                self._waiting.remove(planned)
                sent += self._begin(planned)
        for planned in list(self._running):
            assert planned.effect is not None
            if planned.site.begun_us < now:
                next(planned.effect)
        self._look()
        return sent

    def _look(self) -> None:
        """See what has happened that faults come after, and when the next one begins or ends."""
        a = self.autopilot
        now = a.time_us
        if len(self._since_us) < len(ANCHORS):
            for name, holds in (
                ("armed", a.armed),
                ("airborne", a.airborne),
                ("offboard", a.takes_setpoints),
            ):
                if holds:
                    self._since_us.setdefault(name, now)
        for planned in self._waiting:
            since = self._since_us.get(planned.entry.after)
            if planned.begins_us is None and since is not None:
                due = a.whole_period_us(since + round(planned.entry.at_s * 1e6))
                planned.begins_us = max(due, a.next_period_us)
        times = [planned.begins_us for planned in self._waiting if planned.begins_us is not None]
        times += [planned.site.ends_us for planned in self._running if planned.site.ends_us is not None]
        self._next_us = min(times, default=None)

    def _begin(self, planned: _Planned) -> int:
        entry, site = planned.entry, planned.site
        site.begun_us = self.autopilot.time_us
        if entry.for_s is not None:
            duration = max(round(entry.for_s * 1e6), 1)
            site.ends_us = self.autopilot.whole_period_us(site.begun_us + duration)
        momentary = entry.fault.momentary
        sent = self._tell(f"fault: {entry.fault.kind}" + ("" if momentary else " on"))
        planned.effect = entry.fault.act(site)
        if momentary:
            for _ in planned.effect:
                raise AssertionError(f"{entry.fault.kind} is momentary and goes on")
        else:
            next(planned.effect)
            self._running.append(planned)
        return sent

    def _end(self, planned: _Planned) -> int:
        assert planned.effect is not None
        planned.effect.close()
        sent = self.frames.deliver_due(self.autopilot.time_us)
        return sent + self._tell(f"fault: {planned.entry.fault.kind} off")

    def _tell(self, text: str) -> int:
        """STATUSTEXT to every client at once: before a fault of the link begins, and after it has ended."""
        self.autopilot.voice.note(text)
        if not self.announce:
            return 0
        self.autopilot.voice.broadcast("STATUSTEXT", severity=Severity.NOTICE, text=text)
        return len(self.autopilot.links)
