"""A program that streams references to a flight in lockstep: over a real socket, timed by the autopilot's clock.

A flight of the stub in lockstep runs faster than a wall clock, so a client that paces itself by one would be late. This one
is called before the companion looks for datagrams (`LiveTrajectory.hear`), and sends what is due by then; loopback
delivers at once.
"""

from __future__ import annotations

import heapq
import json
import math
import random
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from companion.control.structs import Reference, Vector
from companion.flightlog.reader import FlightRecord
from companion.live.trajectory import LiveTrajectory
from companion.mavlink.frames import ned_from_enu, yaw_ned_from_enu
from companion.mavlink.link import mav
from companion.reference.lemniscate import Lemniscate
from companion.reference.trajectory import Trajectory, placed

P, V, A, YAW, RATE = 0x7, 0x38, 0x1C0, 0x400, 0x800
LEMNISCATE = Lemniscate()
LEAD_IN_S = 6.0
"""Until the lemniscate has been reached and its start is forgotten; its height is settled by then, too."""


def as_json(what: str) -> Callable[[float, Reference], bytes]:
    """Messages of the kind `what`, one letter each for position, velocity, acceleration, jerk, yaw and time."""
    names = {"p": "position", "v": "velocity", "a": "acceleration", "j": "jerk"}

    def message(t: float, r: Reference) -> bytes:
        fields: dict[str, object] = {
            names[c]: getattr(r, f"{names[c]}_enu").tolist() for c in what if c in names
        }
        if "y" in what:
            fields["yaw"] = r.yaw_rad
        if "t" in what:
            fields["time"] = t
        return json.dumps(fields).encode()

    return message


def as_mavlink(what: str) -> Callable[[float, Reference], bytes]:
    """SET_POSITION_TARGET_LOCAL_NED with what is given; `what` as for `as_json`."""
    codec = mav.MAVLink(None, srcSystem=255, srcComponent=190)
    mask = sum(bits for c, bits in (("p", P), ("v", V), ("a", A), ("y", YAW)) if c not in what) | RATE

    def message(t: float, r: Reference) -> bytes:
        vectors = (ned_from_enu(x).tolist() for x in (r.position_enu, r.velocity_enu, r.acceleration_enu))
        numbers = [number for vector in vectors for number in vector]
        stamp_ms = round(t * 1e3) + 1 if "t" in what else 0
        target = mav.MAVLink_set_position_target_local_ned_message(
            stamp_ms, 0, 0, mav.MAV_FRAME_LOCAL_NED, mask, *numbers, yaw_ned_from_enu(r.yaw_rad), 0.0
        )
        packed = bytes(target.pack(codec))
        codec.seq = (codec.seq + 1) % 256
        return packed

    return message


class Streamer:
    """Streams the report's lemniscate from the beginning of tracking on."""

    def __init__(
        self,
        port: int,
        message: Callable[[float, Reference], bytes],
        rate_hz: float = 50.0,
        loss: float = 0.0,
        jitter_s: float = 0.0,
        changed: Callable[[float, bytes], bytes | None] = lambda t, data: data,
    ) -> None:
        """`changed` may give another datagram for the one of time t, or None for none. Loss and jitter are drawn."""
        self._port = port
        self._message = message
        self._period_s = 1.0 / rate_hz
        self._loss, self._jitter_s = loss, jitter_s
        self._changed = changed
        self._draw = random.Random(1)
        self._next = 0
        self._under_way: list[tuple[float, int, bytes]] = []
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.started_s = math.nan
        """The autopilot's time at the lemniscate's zero."""
        self.path: Trajectory = LEMNISCATE  # in the axes of what is sent
        self.sent = 0

    def errors_m(self, record: FlightRecord, from_s: float, to_s: float = math.inf) -> Vector:
        """(n,) distances of the true position from what was asked for, between two times of the lemniscate's."""
        truth, (layout, *_) = record.channels["/truth"], record.events_of("layout")
        ended_s = record.events_of("tracking")[-1].time_s
        origin_enu, heading_rad = np.array(layout.fields["origin_enu"]), layout.fields["heading_rad"]
        where = placed(self.path, origin_enu, heading_rad)
        times = truth.time_s - self.started_s
        chosen = (times > from_s) & (times < min(to_s, ended_s - self.started_s))
        asked = np.array([where.sample(float(t)).position_enu for t in times[chosen]])
        found: Vector = np.linalg.norm(truth["position_enu"][chosen] - asked, axis=1)
        return found

    def pump(self, now_s: float, live: LiveTrajectory) -> None:
        """Send what is due."""
        if live._follower is None:
            return
        if math.isnan(self.started_s):
            self.started_s = now_s
            if live.is_mavlink:  # in the autopilot's frame
                ground_enu = live.start.position_enu - np.array([0.0, 0.0, 1.0])
                self.path = placed(LEMNISCATE, ground_enu, live.start.yaw_rad)
        while (t := self._next * self._period_s) <= now_s - self.started_s:
            self._next += 1
            data = self._changed(t, self._message(t, self.path.sample(t)))
            if data is not None and self._draw.random() >= self._loss:
                due_s = self.started_s + t + self._draw.random() * self._jitter_s
                heapq.heappush(self._under_way, (due_s, self._next, data))
        while self._under_way and self._under_way[0][0] <= now_s:
            self.socket.sendto(heapq.heappop(self._under_way)[2], ("127.0.0.1", self._port))
            self.sent += 1


@contextmanager
def streaming(pump: Callable[[float, LiveTrajectory], None]) -> Iterator[None]:
    """Let `pump` send whenever the flight is about to look for references."""
    plain = LiveTrajectory.hear

    def hear(live: LiveTrajectory, now_s: float, *rest: object) -> None:
        pump(now_s, live)
        plain(live, now_s, *rest)  # type: ignore[arg-type]

    LiveTrajectory.hear = hear  # type: ignore[method-assign, assignment]
    try:
        yield
    finally:
        LiveTrajectory.hear = plain  # type: ignore[method-assign]
