"""Poses from outside (motion capture, visual odometry): heard over UDP, checked, forwarded to the autopilot as ODOMETRY.

Time. The source stamps with a clock of its own. The quickest datagram of the last seconds tells how that clock stands to
ours (all others were only later), so jitter of the network does not get into the time stamps; its least delay does, and
is for the autopilot's parameter (PX4: EKF2_EV_DELAY, ArduPilot: VISO_DELAY_MS). ODOMETRY goes out with time_usec on the
clock with which we answer the autopilot's TIMESYNC questions (`Link.answering_clock_ns`): PX4 maps it to its own by them,
ArduPilot by a filter of its own. Both filters are slow to follow a drift, so that clock keeps step with the autopilot's.

Frames. PX4 takes MAV_FRAME_LOCAL_NED, so that yaw is a heading; ArduPilot takes MAV_FRAME_LOCAL_FRD only and drops all
else without a word. The numbers are the same: north-east-down of the source's origin.
"""

from __future__ import annotations

import math
import socket
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable

import numpy as np

from companion.config.errors import UserError
from companion.mavlink.frames import (
    Vector,
    frd_from_flu,
    ned_from_enu,
    quaternion_ned_frd_from_enu_flu,
)
from companion.mavlink.link import Message, mav
from companion.mavlink.pose_datagram import (
    BadPose,
    OutsidePose,
    full_covariance,
    parse_pose,
    upper_triangle,
)
from companion.mavlink.transport import resolve

DEFAULT_RATE_HZ = 50.0  # PX4 advises 30 to 50
DATAGRAMS_PER_POLL = 64
CLOCK_WINDOW_S = 5.0  # of datagrams that the source's clock is judged by
CLOCK_TURN_S = 0.1  # one least difference is kept of each such time, and the clocks' drift fitted over them
LEAST_TURNS = 4
FASTEST_DRIFT = 0.02
LATE_S = 0.2  # behind the quickest datagram: the pose is history
SILENT_S = 0.5
SHORTEST_STEP_S = 1e-4  # from pose to pose; closer ones give differences that are no velocities
FASTEST_M_S = 20.0
JUMP_M = 0.3  # a pose farther than this and than FASTEST_M_S allows is one bad fit, …
JUMPS_BELIEVED = 5  # … unless so many in a row agree: then the source's origin has moved (reset_counter)
_NOTICE_EVERY_S = 10.0


class OutsidePoses:
    """A UDP listener whose `poll` returns the ODOMETRY messages that are due. `counters` says what was dropped, and why."""

    def __init__(
        self,
        address: tuple[str, int],
        rate_hz: float = DEFAULT_RATE_HZ,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Listen on `address` (host, port).

        Raises:
            UserError: the address cannot be listened on.
        """
        try:
            family, place = resolve(*address, socket.SOCK_DGRAM, True)
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            self._socket.bind(place)
        except OSError as error:
            raise UserError(
                f"--outside-poses {address[0]}:{address[1]}: {error.strerror}; "
                "is another program listening there? 0.0.0.0 listens on all addresses"
            ) from None
        self._period_s = 1.0 / rate_hz
        self._now_ns = now_ns
        self._delays: deque[tuple[float, float]] = (
            deque()
        )  # (our time, our time − source's), the least of each CLOCK_TURN_S
        self._turn_s = -math.inf
        self._drift = 0.0  # by how much the source's clock is slower than ours
        self._last: OutsidePose | None = None
        self._due_s = -math.inf  # on the source's clock
        self._last_true_s = -math.inf  # on ours
        self._jumps = 0
        self._resets = 0
        self._source_resets = 0
        self._heard_s: float | None = None
        self._silent = False
        self._told_s: dict[str, float] = {}
        self.local_ned = True
        """Whether the autopilot takes MAV_FRAME_LOCAL_NED (PX4) or MAV_FRAME_LOCAL_FRD only (ArduPilot)."""
        self.stamped_ns: Callable[[int], int] = lambda our_ns: our_ns
        """What the clock says that the autopilot knows from our TIMESYNC answers, at a moment of ours."""
        self.on_pose: Callable[[OutsidePose], None] = lambda _: None
        """Called with every pose that is readable, new and not late, before jumps and the rate are looked at."""
        self.counters: Counter[str] = Counter()
        self.notices: deque[str] = deque(maxlen=32)

    @property
    def address(self) -> tuple[str, int]:
        """Where we listen."""
        host, port, *_ = self._socket.getsockname()
        return str(host), int(port)

    def fileno(self) -> int:
        """Descriptor to wait on."""
        return self._socket.fileno()

    def poll(self) -> list[Message]:
        """Take what has arrived; return the messages to send now. Never blocks."""
        messages = []
        for _ in range(DATAGRAMS_PER_POLL):
            try:
                data = self._socket.recv(2048)
            except BlockingIOError:
                break
            except OSError:
                continue
            message = self.take(data)
            if message is not None:
                messages.append(message)
        self._watch_silence(self._now_ns() * 1e-9)
        return messages

    def take(self, data: bytes) -> Message | None:
        """Take one datagram that arrived now; return the ODOMETRY it becomes, None when it is dropped (and counted)."""
        arrived_s = self._now_ns() * 1e-9
        try:
            pose = parse_pose(data)
        except BadPose as bad:
            return self._drop(f"pose {bad}", arrived_s)
        if self._last is not None and pose.time_s < self._last.time_s + SHORTEST_STEP_S:
            if pose.time_s > self._last.time_s - 5.0:
                return self._drop("pose repeated or out of order", arrived_s)
            self._start_again()  # the source was started again: its clock, perhaps its origin, is another
        true_s = self._our_time(pose.time_s, arrived_s)
        if arrived_s - true_s > LATE_S:
            return self._drop("pose too late", arrived_s)
        self.on_pose(pose)
        if self._is_jump(pose):
            return self._drop("pose jumped", arrived_s)
        velocity_enu = self._velocity(pose)
        if pose.reset_counter != self._source_resets:
            self._source_resets = pose.reset_counter
            self._resets += 1
        self._last = pose
        self._back_again(arrived_s)
        # Judged on a raster, so that 120 poses a second become 50 and not 40; and our time must never stand or go back
        # while it settles, or the autopilot would take a pose for an old one.
        too_soon = pose.time_s < self._due_s - 0.1 * self._period_s
        if too_soon or true_s < self._last_true_s + 0.5 * self._period_s:
            self.counters["pose above the rate"] += 1
            return None
        since_due_s = pose.time_s - self._due_s
        self._due_s = (self._due_s if since_due_s < self._period_s else pose.time_s) + self._period_s
        self._last_true_s = true_s
        self.counters["forwarded"] += 1
        return self.odometry(pose, true_s, velocity_enu)

    def odometry(self, pose: OutsidePose, our_time_s: float, velocity_enu: Vector) -> Message:
        """ODOMETRY (331) of a pose that was true at `our_time_s` of our clock.

        Without a velocity from the source, PX4 gets none (NaN), as a difference of poses would count them twice;
        ArduPilot reads it without asking whether it is a number, so it gets the difference.
        """
        position = ned_from_enu(pose.position_enu)
        quaternion = quaternion_ned_frd_from_enu_flu(pose.quaternion_wxyz)
        if pose.velocity_enu is not None:
            velocity_enu = pose.velocity_enu
        if self.local_ned and pose.velocity_enu is None:
            velocity_frd = np.full(3, math.nan)
        else:
            velocity_frd = frd_from_flu(_to_body(pose.quaternion_wxyz, velocity_enu))
        covariance = [math.nan] * 21
        if pose.covariance is not None:
            covariance = upper_triangle(_covariance_ned_frd(full_covariance(pose.covariance))).tolist()
        return mav.MAVLink_odometry_message(
            round(self.stamped_ns(round(our_time_s * 1e9)) * 1e-3),
            mav.MAV_FRAME_LOCAL_NED if self.local_ned else mav.MAV_FRAME_LOCAL_FRD,
            mav.MAV_FRAME_BODY_FRD,
            *position.tolist(),
            quaternion.tolist(),
            *velocity_frd.tolist(),
            *([math.nan] * 3),
            covariance,
            [math.nan] * 21,
            self._resets % 256,
            mav.MAV_ESTIMATOR_TYPE_VISION,  # PX4's EKF2 never sees what comes as …_MOCAP
            100,
        )

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    # Time -----------------------------------------------------------------------------------------------

    def _our_time(self, source_s: float, arrived_s: float) -> float:
        """When, on our clock, a pose was true: by the least difference of the clocks within the window."""
        delays, delay = self._delays, arrived_s - source_s
        if not delays or arrived_s - self._turn_s > CLOCK_TURN_S:
            self._turn_s = arrived_s
            while delays and delays[0][0] < arrived_s - CLOCK_WINDOW_S:
                delays.popleft()
            self._drift = _slope(list(delays))
            delays.append((arrived_s, delay))
        elif delay <= delays[-1][1] + self._drift * (arrived_s - delays[-1][0]):
            delays[-1] = arrived_s, delay
        return source_s + min(least + self._drift * (arrived_s - then) for then, least in delays)

    def _start_again(self) -> None:
        self._delays.clear()
        self._last = None
        self._due_s = -math.inf
        self._jumps = 0
        self._resets += 1
        self.counters["source restarts"] += 1
        self.notices.append("poses from outside: the source's clock went back; starting again with it")

    # Judging --------------------------------------------------------------------------------------------

    def _is_jump(self, pose: OutsidePose) -> bool:
        if self._last is None:
            return False
        elapsed_s = pose.time_s - self._last.time_s
        away_m = float(np.linalg.norm(pose.position_enu - self._last.position_enu))
        announced = pose.reset_counter != self._source_resets
        if away_m <= max(JUMP_M, FASTEST_M_S * elapsed_s) or announced:
            self._jumps = 0
            return False
        self._jumps += 1
        if self._jumps < JUMPS_BELIEVED:
            return True
        self._jumps = 0
        self._resets += 1
        self._last = None
        self.notices.append(
            f"poses from outside: the origin jumped by {away_m:.2f} m; told the autopilot (reset_counter)"
        )
        return False

    def _velocity(self, pose: OutsidePose) -> Vector:
        if self._last is None:
            return np.zeros(3)
        velocity = (pose.position_enu - self._last.position_enu) / (pose.time_s - self._last.time_s)
        return np.asarray(velocity, dtype=np.float64)

    def _drop(self, why: str, now_s: float) -> None:
        self.counters[why] += 1
        if now_s - self._told_s.get(why, -math.inf) > _NOTICE_EVERY_S:
            self._told_s[why] = now_s
            self.notices.append(f"poses from outside: {why}; dropped ({self.counters[why]} so far)")

    def _watch_silence(self, now_s: float) -> None:
        if self._heard_s is not None and not self._silent and now_s - self._heard_s > SILENT_S:
            self._silent = True
            self.notices.append(f"poses from outside: none for {SILENT_S:g} s; is the vehicle in view?")

    def _back_again(self, now_s: float) -> None:
        if self._heard_s is None:
            self.notices.append("poses from outside: the first one arrived")
        elif self._silent:
            self.notices.append(f"poses from outside: back after {now_s - self._heard_s:.1f} s")
        self._heard_s, self._silent = now_s, False


def _slope(points: list[tuple[float, float]]) -> float:
    """Median slope of all pairs of points (Theil and Sen); 0 where there are too few, at most FASTEST_DRIFT."""
    if len(points) < LEAST_TURNS:
        return 0.0
    slopes = [(d - c) / (b - a) for n, (a, c) in enumerate(points) for b, d in points[n + 1 :] if b > a]
    return min(max(statistics.median(slopes), -FASTEST_DRIFT), FASTEST_DRIFT) if slopes else 0.0


def _to_body(quaternion_wxyz: Vector, vector: Vector) -> Vector:
    """(3,) a world vector in the body's axes: q⁻¹ v q."""
    w, axis = quaternion_wxyz[0], -quaternion_wxyz[1:]
    turned = 2.0 * np.cross(axis, vector)
    return np.asarray(vector + w * turned + np.cross(axis, turned), dtype=np.float64)


def _covariance_ned_frd(matrix: Vector) -> Vector:
    """(6, 6) of (ENU, rotations about FLU) → (NED, rotations about FRD): J C Jᵀ, J made of the frames' own maps."""
    change = np.zeros((6, 6))
    for column, unit in enumerate(np.eye(3)):
        change[:3, column] = ned_from_enu(unit)
        change[3:, 3 + column] = frd_from_flu(unit)
    return np.asarray(change @ matrix @ change.T, dtype=np.float64)
