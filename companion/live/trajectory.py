"""`--trajectory live:…`: a trajectory that other programs tell while it is flown.

Before tracking it stands at its start. From `begin` on it is what the follower makes of the points; `hear` takes in what
has arrived, a bounded share each time, and never waits. Everything follows from what was heard (`heard.py`) and the
times sampled, so a log that has both gives the same references again.
"""

from __future__ import annotations

import json
import math
import zlib
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from companion.config.errors import UserError
from companion.control.structs import Reference, Vector
from companion.live.follower import MOST_PIECES, Follower, Following
from companion.live.heard import BEFORE_TRACKING, Heard
from companion.live.json_points import Asked, Wish, parse
from companion.live.mavlink_points import MavlinkPoints, Surroundings
from companion.live.point import BadPoint, Point, PolynomialPiece
from companion.live.sources import LineSource, NoSource, Source, UdpSource
from companion.mavlink.endpoint import host_and_port
from companion.reference.registry import trajectory_from_text
from companion.reference.trajectory import Trajectory, resting, wrapped
from companion.reference.transit import TransitLimits

PREFIX = "live:"
HEAR_PERIOD_S = 0.004
DATAGRAMS_AT_ONCE = 2
"""In each HEAR_PERIOD_S: 500 a second, so that a flood of good points costs no more than a tenth of the time."""
RELEASE_S = 1.0
"""A client silent for so long may be followed by another."""
TELL_PERIOD_S = 1.0
"""Between two words on one kind of refusal."""
_KINDS = ("udp", "mavlink", "stdin")


@dataclass(frozen=True, slots=True)
class LiveAddress:
    """Where references are heard."""

    kind: str  # of _KINDS
    place: tuple[str, int] | None  # host, port; None for standard input


@dataclass(frozen=True, slots=True)
class Beginning:
    """What tracking begins with."""

    started_s: float  # the autopilot's time at own time 0
    now_s: float  # the first of the autopilot's time that can still be changed
    limits: TransitLimits  # of the ways to where points are
    silence_s: float  # without a point for so long a stream is brought to rest
    allowed: Callable[[Vector, Vector], str]
    """Why a position (3,) m in own axes may not be flown to with an acceleration (3,) m/s²; empty when it may."""


def trajectory_or_live(text: str) -> Trajectory:
    """What `--trajectory` stands for, live or of the catalogue. Raises UserError."""
    if not text.startswith(PREFIX):
        return trajectory_from_text(text)
    kind, colon, place = text.removeprefix(PREFIX).partition(":")
    if kind not in _KINDS or bool(colon) is (kind == "stdin"):
        raise UserError(
            f"trajectory {text!r}: use live:udp:[HOST:]PORT, live:mavlink:[HOST:]PORT or live:stdin"
            " (docs/live_references.md)"
        )
    return LiveTrajectory(LiveAddress(kind, host_and_port(place, f"trajectory {text}") if colon else None))


class LiveTrajectory:
    """See the module. A `Trajectory` in the autopilot's local frame for MAVLink, in the axes of `--frame` otherwise."""

    duration_s = math.inf
    told_in_flight = True

    def __init__(self, address: LiveAddress) -> None:
        self._address = address
        self._source: Source = NoSource()
        self._follower: Follower | None = None
        self._start = resting(np.zeros(3), 0.0)
        self._started_s = 0.0
        self._heard_at_s = -math.inf
        self._waiting: deque[PolynomialPiece] = deque(maxlen=MOST_PIECES)
        self._has_client = address.place is None
        self._following = Following.WAITING
        self._told_s: dict[str, float] = {}
        self._early: Counter[str] = Counter()
        self._around = Surroundings(None, 0.0, None, 0.0, None)  # of what is being taken in
        self._mavlink = MavlinkPoints(self._surroundings)
        self._samples = 0
        self.is_mavlink = address.kind == "mavlink"
        """Whether points say themselves where they lie: in the autopilot's frames, whatever `--frame` is."""
        self.latest_s = 0.0
        """The latest own time sampled: what comes after it can still be changed."""
        self.ended = False
        """The client has said that it is over."""
        self.on_heard: Callable[[Heard], None] = lambda heard: None
        """Called with all that a client sends, before it is looked into."""
        self.on_sampled: Callable[[float, int], None] = lambda time_s, checksum: None
        """Called with every own time sampled since the beginning of tracking, and a checksum of what it gave."""
        self.notices: deque[str] = deque(maxlen=32)

    @property
    def start(self) -> Reference:
        """Where the first point is waited for, in own axes."""
        return self._start

    def open(self) -> None:
        """Begin to listen. Raises UserError."""
        place = self._address.place
        name = f"trajectory {PREFIX}{self._address.kind}"
        self._source = LineSource() if place is None else UdpSource(place, f"{name}:{place[0]}:{place[1]}")

    def close(self) -> None:
        """Listen no more."""
        self._source.close()

    def stand_at(self, position: Vector, yaw_rad: float) -> None:
        """Where to wait for the first point: own axes, (3,) m."""
        self._start = resting(position, yaw_rad)

    def begin(self, with_: Beginning) -> None:
        """Follow from now on."""
        self._started_s = with_.started_s
        self._follower = Follower(self._start, with_.now_s, with_.limits, with_.silence_s, with_.allowed)
        while self._waiting:
            self._follow(self._waiting.popleft(), with_.now_s)

    def sample(self, time_s: float) -> Reference:
        """See `Trajectory`."""
        if self._follower is None:
            if math.isnan(time_s):
                raise ValueError("trajectory sampled at time NaN")
            return resting(self._start.position_enu, self._start.yaw_rad)
        self.latest_s = max(self.latest_s, time_s)
        reference = self._follower.sample(self._started_s + time_s)
        self._samples += 1
        self.on_sampled(time_s, checksum(reference))
        return reference

    @property
    def counters(self) -> Counter[str]:
        """What was followed, and what was refused by its reason."""
        total = Counter(self._early)
        if self._follower is not None:
            total.update(self._follower.counters)
        if self._source.dropped:
            total["dropped unread (strangers, or too many)"] = self._source.dropped
        return total

    def silent_s(self, now_s: float) -> float:
        """How long the client we had has said nothing worth following; 0 where there never was one."""
        follower = self._follower
        if follower is None or not follower.counters["followed"]:
            return 0.0
        return max(0.0, now_s - follower.heard_s)

    def is_over(self, now_s: float) -> bool:
        """Whether the client has ended it, and the pieces it sent before are flown."""
        return self.ended and (self._follower is None or now_s >= self._follower.heard_s)

    # What comes in ------------------------------------------------------------------------------------------

    def hear(self, now_s: float, surroundings: Callable[[], tuple[Surroundings, Vector, float]]) -> None:
        """Take in what has arrived, at the autopilot's time `now_s`.

        `surroundings` tells what of the vehicle a message may count from, and by how much the estimator has moved and
        turned its frame, (3,) m and rad.
        """
        if self.ended or 0.0 <= now_s - self._heard_at_s < HEAR_PERIOD_S:
            return
        self._heard_at_s = now_s
        for _ in range(DATAGRAMS_AT_ONCE):
            if self._address.place is None and (self._follower is None or self._follower.is_full):
                break  # a file or a pipe waits for us
            data = self._source.take()
            if data is None:
                break
            samples = BEFORE_TRACKING if self._follower is None else self._samples
            heard = Heard(now_s, data, samples, *surroundings())
            self.on_heard(heard)
            self.take(heard)
            if self.ended:
                break
        if self._has_client and self._address.place is not None and self.silent_s(now_s) > RELEASE_S:
            self._let_go("silent")
        self._tell_following()

    def take(self, heard: Heard) -> None:
        """Do what a datagram asks for, or refuse it in words."""
        self._around = heard.around
        if self._follower is not None and self.silent_s(heard.time_s) > RELEASE_S:
            self._follower.forget_client()
        try:
            asked = self._mavlink.parse(heard.data) if self.is_mavlink else [parse(heard.data)]
        except BadPoint as bad:
            self._early[str(bad).partition(":")[0]] += 1
            self._refuse(str(bad), heard.time_s)
            return
        for each in asked:
            if isinstance(each, Wish):
                self._grant(each, heard.time_s)
            elif why := self._follow(_before_resets(each, heard), heard.time_s):
                self._refuse(why, heard.time_s)
            elif self._follower is not None:
                self._source.believe()
                self._has_client = True

    def _grant(self, wish: Wish, now_s: float) -> None:
        if not self._has_client and not self._waiting:
            self._early["of nobody we follow"] += 1
            self._refuse("of nobody we follow: send a point first", now_s)
        elif wish is Wish.END:
            self.ended = True
            self.notices.append("references: the client says that it is over")
        else:
            if self._follower is not None:
                self._follower.forget_client()
            self._let_go("let go")

    def _follow(self, asked: Asked, now_s: float) -> str:
        """Follow it, or keep it; says why it was refused, empty where it was not."""
        assert not isinstance(asked, Wish)
        try:
            if self._follower is not None:
                self._follower.take(asked, now_s)
            elif isinstance(asked, PolynomialPiece) and math.isnan(asked.time_s):
                asked.require_sane()
                self._waiting.append(asked)
            else:
                self._early["before tracking"] += 1
                return "before tracking: the vehicle is on its way to the start"
        except BadPoint as bad:
            return str(bad)
        return ""

    def _let_go(self, why: str) -> None:
        if self._has_client:
            self._has_client = False
            self._source.let_go()
            self.notices.append(f"references: the client is {why}; another may take its place")

    def _refuse(self, why: str, now_s: float) -> None:
        """Tell the client, and the pilot, each kind of refusal once in a while."""
        kind = why.partition(":")[0]
        if 0.0 <= now_s - self._told_s.get(kind, -math.inf) < TELL_PERIOD_S:
            return
        first = kind not in self._told_s
        self._told_s[kind] = now_s
        if not self.is_mavlink:
            self._source.answer(json.dumps({"refused": why}).encode())
        if first and kind != "before tracking":
            self.notices.append(f"references: refused, {why}")

    def _tell_following(self) -> None:
        if self._follower is not None and self._follower.following is not self._following:
            self._following = self._follower.following
            self.notices.append(f"references: {self._following.value}")

    def _surroundings(self) -> Surroundings:
        return self._around


def checksum(reference: Reference) -> int:
    """Of all bits of a reference."""
    r = reference
    parts = (r.position_enu, r.velocity_enu, r.acceleration_enu, r.jerk_enu, r.snap_enu)
    turning = np.array((r.yaw_rad, r.yaw_rate_rad_s, r.yaw_acceleration_rad_s2))
    return zlib.crc32(b"".join(part.tobytes() for part in (*parts, turning)))


def _before_resets(asked: Point | PolynomialPiece, heard: Heard) -> Point | PolynomialPiece:
    """`asked` in the frame in which the plan was laid out: it goes along with resets of the estimator, and so will this."""
    if not heard.turned_rad and not heard.moved_enu.any():
        return asked
    if isinstance(asked, Point):
        yaw_rad = wrapped(asked.yaw_rad - heard.turned_rad) if math.isfinite(asked.yaw_rad) else asked.yaw_rad
        return replace(asked, position=asked.position - heard.moved_enu, yaw_rad=yaw_rad)
    coefficients = np.array(asked.coefficients, dtype=np.float64)
    coefficients[:, 0] -= (*heard.moved_enu, heard.turned_rad)
    return replace(asked, coefficients=coefficients)
