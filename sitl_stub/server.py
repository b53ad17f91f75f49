"""Runs an autopilot against its sockets: in real time, n times real time, or in lockstep with its clients.

Lockstep: after each instant at which messages went out, every client that answers TIMESYNC gets a request (tc1 0, ts1
simulated ns), and simulated time waits, with a bound, until it is answered. A client that handles messages in order
has then finished with everything before it, so a flight repeats bit by bit and goes as fast as the machine allows. Time
stands at its start until the first answer. Which instants a client's messages take effect at is thereby fixed by the
client, not by the wall clock.
"""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from sitl_stub.mavlink.codec import LAYOUTS, Received
from sitl_stub.mavlink.links import MOST_AT_ONCE, Link, Port
from sitl_stub.mavlink.tcp import TcpLink
from sitl_stub.mavlink.udp import UdpLink

if TYPE_CHECKING:
    from sitl_stub.faults.control import ControlChannel
    from sitl_stub.firmware.common.autopilot import Autopilot

BARRIER_PATIENCE_S = 2.0
"""Wall time one answer is waited for."""
MISSES_TO_REAL_TIME = 3
START_PROBE_S = 0.1
"""How often the very first messages are repeated while nobody listens at a UDP address."""
START_REPEAT_S = 10.0
"""The same once somebody has the address open: no refusal came, so one probe is already waiting there."""
SILENCE_TO_REAL_TIME_S = 10.0
"""How long, from its first message on, the first answer of a client is waited for."""
LARGEST_LAG_S = 0.5
"""Real time: simulated time further behind than this is given up instead of being caught up."""
SILENT_CLIENT_US = 15_000_000
_TIMESYNC = LAYOUTS["TIMESYNC"]


class Barrier:
    """What lockstep knows of one link."""

    def __init__(self) -> None:
        self.takes_part = False
        """Has answered TIMESYNC."""
        self.waiting_for_ns = -1
        self.misses = 0


class Server:
    """One autopilot and its ports."""

    def __init__(
        self,
        ports: Sequence[Port],
        speed: float = 1.0,
        lockstep: bool = False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.ports = list(ports)
        self.speed = speed
        self.lockstep = lockstep
        self.say = say
        self.stopping = False
        self.duration_us: int | None = None
        self.exit_on_disarm = False
        self.flown = False
        self.free_running = False
        """Lockstep given up for now because answers stopped."""
        self.control: ControlChannel | None = None
        """Where faults are injected from outside, if anywhere."""
        self._autopilot: Autopilot | None = None
        self._barriers: dict[int, Barrier] = {}
        self._held: list[tuple[Link, Received]] = []
        """Lockstep: messages of clients that had answered for the instant already."""
        self._selector = selectors.DefaultSelector()
        self._registered: dict[int, Port | ControlChannel] = {}
        self.wall_start = 0.0

    # --- setting up --------------------------------------------------------------------------------------------
    def run(self, autopilot: Autopilot) -> None:
        """Serve until told to stop, the duration is over, or (if asked) the vehicle has disarmed after a flight."""
        self._autopilot = autopilot
        autopilot.clock.lockstep = self.lockstep
        self.wall_start = time.monotonic()
        self._refresh()
        if self.lockstep:
            self._run_lockstep(autopilot)
        else:
            self._run_clocked(autopilot, lambda: False)

    def stop(self) -> None:
        """Leave `run` at the next instant (safe from a signal handler)."""
        self.stopping = True

    def close(self) -> None:
        """Close every socket."""
        self._selector.close()
        for port in self.ports:
            port.close()

    def _refresh(self) -> None:
        """Bring sockets and links up to date with what the ports have."""
        autopilot = self._autopilot
        assert autopilot is not None
        wanted: dict[int, tuple[Any, Port | ControlChannel]] = {}
        if self.control is not None and self.control.open:
            wanted[self.control.fileno()] = (self.control, self.control)
        present: list[Link] = []
        for port in self.ports:
            for one in port.sockets():
                wanted[one.fileno()] = (one, port)
            present.extend(port.links)
        for number in list(self._registered):
            if number not in wanted:
                del self._registered[number]
        for key in list(self._selector.get_map().values()):
            if key.fd not in wanted or wanted[key.fd][0] is not key.fileobj:
                self._selector.unregister(key.fileobj)
        known = {key.fd for key in self._selector.get_map().values()}
        for number, (one, owner) in wanted.items():
            self._registered[number] = owner
            if number not in known:
                self._selector.register(one, selectors.EVENT_READ, owner)
        for link in list(autopilot.links):
            if link not in present:
                autopilot.detach(link)
                self._barriers.pop(id(link), None)
                self.say(f"{link.name} gone")
        for link in present:
            if link not in autopilot.links:
                self._barriers[id(link)] = Barrier()
                autopilot.attach(link)
                if link.heard:
                    self.say(f"{link.name} connected")

    # --- taking in ---------------------------------------------------------------------------------------------
    def _receive(
        self, timeout_s: float, obey: bool = True, most: int = MOST_AT_ONCE
    ) -> list[tuple[Link, Received]]:
        """Messages that arrive within `timeout_s`, in order of arrival on each link; `most` reads of each socket.

        What came over the control channel is taken up only when no message is waiting and `obey` says so: in lockstep
        that is while time stands, so that an injected fault begins at the same instant however fast it came.
        """
        arrived: list[tuple[Link, Received]] = []
        changed = False
        commanded = False
        for key, _ in self._selector.select(timeout_s):
            if key.data is self.control:
                commanded = True
                continue
            port: Port = key.data
            before = len(port.links)
            was_open = all(link.open for link in port.links)
            for link, messages in port.receive(key.fileobj, most):  # type: ignore[arg-type]
                arrived.extend((link, message) for message in messages)
            changed |= len(port.links) != before or not was_open
        if commanded and obey and not arrived and self.control is not None:
            self.control.read()
            changed |= not self.control.open
        if changed or any(link.firmware_data is None for link, _ in arrived):
            self._refresh()
        return arrived

    def _handle(self, arrived: list[tuple[Link, Received]]) -> None:
        autopilot = self._autopilot
        assert autopilot is not None
        for link, message in arrived:
            if self._is_ahead(link):
                self._held.append((link, message))
            elif message.name == "TIMESYNC" and message.values["tc1"] != 0:
                link.traffic.pass_over(message)
                self._answered(link, message.values["ts1"])
            elif link in autopilot.links:
                autopilot.handle(link, message)

    def _is_ahead(self, link: Link) -> bool:
        """Whether `link` has answered for this instant already: what it says now belongs to the next one.

        Without this, whether a message counts for this instant or the next would hang on how fast it came.
        """
        barrier = self._barriers.get(id(link))
        in_step = self.lockstep and not self.free_running
        return in_step and barrier is not None and barrier.takes_part and barrier.waiting_for_ns < 0

    def _answered(self, link: Link, ts1: int) -> None:
        barrier = self._barriers.get(id(link))
        if barrier is None:
            return
        barrier.takes_part = True
        barrier.misses = 0
        self.free_running = False
        if barrier.waiting_for_ns == ts1:
            barrier.waiting_for_ns = -1

    # --- real time ---------------------------------------------------------------------------------------------
    def _run_clocked(self, autopilot: Autopilot, until: Callable[[], bool]) -> None:
        """Simulated time follows the wall clock times `speed` until stopped or `until()`."""
        wall_zero = time.monotonic()
        zero_us = autopilot.time_us
        while not self._finished(autopilot) and not until():
            due_s = (autopilot.next_instant_us - zero_us) * 1e-6 / self.speed
            wait = wall_zero + due_s - time.monotonic()
            if wait < -LARGEST_LAG_S:
                wall_zero -= wait
                wait = 0.0
            arrived = self._receive(max(wait, 0.0))
            now_us = zero_us + int((time.monotonic() - wall_zero) * 1e6 * self.speed)
            if arrived:
                autopilot.advance_to(min(now_us, autopilot.next_instant_us - 1))
                self._handle(arrived)
            if now_us >= autopilot.next_instant_us:
                autopilot.step()
                if self.lockstep:
                    self._request_answers(autopilot)
            self._drop_silent(autopilot)

    def _drop_silent(self, autopilot: Autopilot) -> None:
        for port in self.ports:
            drop = getattr(port, "drop", None)
            if drop is None:
                continue
            for link in list(port.links):
                own = getattr(port, "remote", None)
                silent = autopilot.time_us - link.last_heard_us > SILENT_CLIENT_US
                if isinstance(link, UdpLink) and link.heard and link.address != own and silent:
                    drop(link)
                    self._refresh()

    def _finished(self, autopilot: Autopilot) -> bool:
        if self.stopping:
            return True
        if self.duration_us is not None and autopilot.time_us >= self.duration_us:
            return True
        if self.exit_on_disarm:
            armed = autopilot.armed
            self.flown |= armed
            return self.flown and not armed
        return False

    # --- lockstep ----------------------------------------------------------------------------------------------
    def _run_lockstep(self, autopilot: Autopilot) -> None:
        self._wait_for_first_answer(autopilot)
        while not self._finished(autopilot):
            if not self.free_running and self._step(autopilot):
                self._wait_for_answers(autopilot)
            else:
                self._handle(self._receive(0.0, obey=False))
            if self.free_running:
                self.say("no TIMESYNC answers: going on in real time until they return")
                held, self._held = self._held, []
                self._handle(held)
                self._run_clocked(autopilot, lambda: not self.free_running)
                if not self._finished(autopilot):
                    self.say("TIMESYNC answers are back: lockstep again")
            if autopilot.time_us % 1_000_000 == 0:
                self._drop_silent(autopilot)

    def _step(self, autopilot: Autopilot) -> int:
        """One instant, its messages and questions; returns the number of messages.

        What a controller acts upon goes out with the question, and the rest while the client is at it. What the client
        says about the rest comes after its answer, and so belongs to the next instant, however fast it was.
        """
        links = list(autopilot.links)
        asked = False

        def ask() -> None:
            nonlocal asked
            asked = True
            self._request_answers(autopilot)
            for link in links:
                link.send_gathered()

        for link in links:
            link.gathers = True
        sent = autopilot.step(ask)
        if sent and not asked:
            self._request_answers(autopilot)
        for link in links:
            link.send_gathered()
            link.gathers = False
        return sent

    def _wait_for_first_answer(self, autopilot: Autopilot) -> None:
        """Repeat HEARTBEAT and TIMESYNC at the first instant until a client answers; time stands still."""
        next_probe = 0.0
        heard_at: float | None = None
        probed: set[int] = set()
        while not self._finished(autopilot):
            now = time.monotonic()
            fresh = [link for link in autopilot.links if id(link) not in probed]
            if now >= next_probe or fresh:
                links = autopilot.links if now >= next_probe else fresh
                next_probe = now + START_REPEAT_S
                for link in links:
                    autopilot.streams.send_named(link, "HEARTBEAT")
                    self._request_answer(link, self._barriers[id(link)], autopilot.clock.stamp_us)
                    probed.add(id(link))
                self._handle(self._receive(0.002))
                if any(isinstance(link, UdpLink) and link.refused for link in autopilot.links):
                    next_probe = now + START_PROBE_S
            self._handle(self._receive(max(min(next_probe - time.monotonic(), 0.1), 0.0)))
            if heard_at is None and any(link.heard and link.role != "gcs" for link in autopilot.links):
                heard_at = time.monotonic()
            if heard_at is not None and time.monotonic() - heard_at > SILENCE_TO_REAL_TIME_S:
                self.free_running = True  # a client that speaks but never answers TIMESYNC (MAVSDK does not)
                return
            if any(
                self._barriers[id(link)].takes_part for link in autopilot.links if id(link) in self._barriers
            ):
                for barrier in self._barriers.values():
                    barrier.waiting_for_ns = -1
                for link in autopilot.links:
                    link.traffic.clear()  # how long time stood still is no matter of the flight
                return

    def _request_answer(self, link: Link, barrier: Barrier, clock_us: int) -> None:
        barrier.waiting_for_ns = clock_us * 1000
        link.send_past_faults(_TIMESYNC, (0, clock_us * 1000))

    def _request_answers(self, autopilot: Autopilot) -> None:
        for link in autopilot.links:
            barrier = self._barriers[id(link)]
            if barrier.takes_part:
                self._request_answer(link, barrier, autopilot.clock.stamp_us)
            elif not autopilot.time_us % 1_000_000:
                # a client that has not answered yet may begin to
                link.send_past_faults(_TIMESYNC, (0, autopilot.clock.stamp_us * 1000))

    def _wait_for_answers(self, autopilot: Autopilot) -> None:
        deadline = time.monotonic() + BARRIER_PATIENCE_S
        held, self._held = self._held, []
        self._handle(held)
        while not self.stopping:
            waiting = [link for link in autopilot.links if self._barriers[id(link)].waiting_for_ns >= 0]
            if not waiting:
                return
            gone = [link for link in waiting if self._gone(link)]
            left = deadline - time.monotonic()
            if left <= 0 or len(gone) == len(waiting):
                for link in waiting:
                    barrier = self._barriers[id(link)]
                    barrier.waiting_for_ns = -1
                    barrier.misses += MISSES_TO_REAL_TIME if link in gone else 1
                if any(self._barriers[id(link)].misses >= MISSES_TO_REAL_TIME for link in waiting):
                    self._give_up(waiting)
                return
            self._handle(self._receive(min(left, 0.1), most=1))

    def _give_up(self, waiting: list[Link]) -> None:
        for link in waiting:
            barrier = self._barriers.get(id(link))
            if barrier is not None and barrier.misses >= MISSES_TO_REAL_TIME:
                barrier.takes_part = False
        if not any(barrier.takes_part for barrier in self._barriers.values()):
            self.free_running = True

    @staticmethod
    def _gone(link: Link) -> bool:
        """Whether nobody is there any more: refused datagrams or a closed connection."""
        if isinstance(link, TcpLink):
            return not link.open
        return isinstance(link, UdpLink) and link.refused
