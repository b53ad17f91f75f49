"""What the client asks for, as the forwarder tells it: a stream of points, or setpoints that are its own business."""

from __future__ import annotations

import math
import socket
from collections import deque
from collections.abc import Callable

import numpy as np

from companion.control.structs import Reference, Vector
from companion.live.follower import FIT_POINTS, Follower
from companion.live.mavlink_points import MavlinkPoints, Surroundings
from companion.live.point import BadPoint, Point
from companion.mavlink.framing import message_id
from companion.mavlink.received import read
from companion.serve.forwarder import LAPSED, LET_GO, TAKE
from companion.serve.law_wire import received
from companion.serve.setpoint_switch import ATTITUDE_SETPOINTS, OWN_BUSINESS_S, POSITION_SETPOINTS

STREAM_OF = 4
STREAM_WITHIN_S = 1.0
"""So many points in so long are a stream that can be followed."""
FRESH_S = 0.3
LOST_S = 0.5
"""Without a point that can be flown for so long, the autopilot has the client's last word again."""
FRAMES_AT_ONCE = 16
"""Looked at between two messages of the autopilot."""


class ClientSetpoints:
    """See the module. Times are the autopilot's; so is the frame of reference, as ENU."""

    def __init__(self, control: socket.socket, surroundings: Callable[[], Surroundings]) -> None:
        """Listen on `control`; `surroundings`: as for `MavlinkPoints`."""
        control.setblocking(False)
        self._control = control
        self._points = MavlinkPoints(surroundings)
        self._arrivals: deque[tuple[float, Point]] = deque(maxlen=FIT_POINTS[0])
        self._follower: Follower | None = None
        self._own_business_s = -math.inf
        self.allowed: Callable[[Vector], str] = lambda position: ""
        """Why a position (3,) m may not be flown to; empty when it may."""
        self.on_heard: Callable[[float, bytes], None] = lambda time_s, frame: None
        """Called with every frame and when it came, before it is looked into."""
        self.refusal = ""
        """Why the newest point cannot be flown; empty when it can."""
        self.has_lapsed = False
        """The forwarder has heard nothing of us, and passes setpoints on."""
        self.streams_changed = False
        """A client has asked for other rates; for who looks at it to take back."""

    def hold_back(self, system: int) -> None:
        """From here on the autopilot `system` gets none of the points."""
        self._control.send(TAKE.pack(b"T", system))
        self.has_lapsed = False

    def follow(self, follower: Follower) -> None:
        """From here on `follower` gets the points; first those that came last."""
        self._follower = follower
        for arrived_s, point in self._arrivals:
            self._follow(point, arrived_s)

    def newest(self, otherwise: Reference) -> Reference:
        """The newest point at rest or as it moves; what it leaves open is as in `otherwise`."""
        point, still = self._arrivals[-1][1], np.zeros(3)
        position = np.where(np.isnan(point.position), otherwise.position_enu, point.position)
        open_speed = otherwise.velocity_enu if np.isnan(point.position).any() else still
        velocity = np.where(np.isnan(point.velocity), open_speed, point.velocity)
        yaw_rad = otherwise.yaw_rad if math.isnan(point.yaw_rad) else point.yaw_rad
        return Reference(position, velocity, still, still, still, yaw_rad, 0.0, 0.0)

    def let_go(self) -> None:
        """From here on the autopilot gets the points itself."""
        self._follower = None
        try:
            self._control.send(LET_GO)
        except OSError:
            return  # there is nobody left who would hold them back

    def hear(self, now_s: float) -> None:
        """Take in what has been told. Raises LinkLost when the forwarder is gone."""
        for _ in range(FRAMES_AT_ONCE):
            frame = received(self._control)
            if frame is None:
                return
            if frame == LAPSED:
                self.has_lapsed = True
                continue
            self.on_heard(now_s, frame)
            kind = message_id(frame)
            if kind in ATTITUDE_SETPOINTS:
                self._own_business_s = now_s
            elif kind in POSITION_SETPOINTS:
                self._take(frame, now_s)
            else:
                self.streams_changed = True

    def _take(self, frame: bytes, now_s: float) -> None:
        message = read(frame)
        assert message is not None  # the forwarder has read it
        try:
            point = self._points.asked(message)
            assert isinstance(point, Point)
            point.require_sane()
            if why := self.allowed(point.position):
                raise BadPoint(why)
        except BadPoint as bad:
            self.refusal = str(bad)
            return
        if self._follow(point, now_s):
            self.refusal = ""
            if self._arrivals and now_s < self._arrivals[-1][0]:
                self._arrivals.clear()  # the autopilot's clock has started again
            self._arrivals.append((now_s, point))

    def _follow(self, point: Point, arrived_s: float) -> bool:
        if self._follower is None:
            return True
        try:
            self._follower.take(point, arrived_s)
        except BadPoint as bad:
            self.refusal = str(bad)
            return False
        return True

    def is_own_business(self, now_s: float) -> bool:
        """Whether a client flies the attitude itself."""
        return now_s - self._own_business_s < OWN_BUSINESS_S

    def silent_s(self, now_s: float) -> float:
        """How long no point has come that can be flown; infinite before the first."""
        return now_s - self._arrivals[-1][0] if self._arrivals else math.inf

    def is_stream(self, now_s: float) -> bool:
        """Whether points come that can be followed."""
        if len(self._arrivals) < STREAM_OF or not 0.0 <= self.silent_s(now_s) <= FRESH_S:
            return False
        return now_s - self._arrivals[-STREAM_OF][0] <= STREAM_WITHIN_S
