"""From messages to `VehicleState`: one moment, one frame, only numbers that can be true.

ATTITUDE_QUATERNION gives attitude and body rate and sets the moment; LOCAL_POSITION_NED gives position and
velocity and is carried to that moment by its velocity. Both autopilots send both; what differs is how
often. A state is made each time an attitude arrives and a position is young enough; an attitude without one is enough to
keep a vehicle level (`lone_attitude`).
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from companion.control.structs import Vector, VehicleState
from companion.mavlink.frames import enu_from_ned, flu_from_frd, quaternion_enu_flu_from_ned_frd
from companion.mavlink.link import Message, mav

POSITION_TOO_OLD_S = 0.5  # an older position is not carried forward
JUMP_M = 0.3  # a position this far from where the velocity leads is an estimator reset, not flight
FARTHEST_M = 1e5
FASTEST_M_S = 200.0
FASTEST_RATE_RAD_S = 100.0
_POSITION: int = mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED
_ATTITUDE: int = mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
STATE_MESSAGES = frozenset((_POSITION, _ATTITUDE))
_Triple = tuple[float, float, float]
_UNKNOWN: Vector = np.full(3, np.nan)


class StateAssembler:
    """Collects the newest attitude and position. `counters` says what was refused and why."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self.attitude_time_s = -math.inf
        self.position_time_s = -math.inf
        self._motion_ned: tuple[_Triple, _Triple] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        """Position and velocity as they came."""
        self._position_enu: Vector | None = None
        self._velocity_enu: Vector = np.zeros(3)
        self._jump_enu: Vector | None = None
        self.lone_attitude: VehicleState | None = None
        """Of the message taken last, where its attitude had no position: position and velocity are not numbers."""

    @property
    def velocity_enu(self) -> Vector:
        """(3,) m/s, of the newest position message; zeros before the first."""
        return self._velocity_enu

    def take(self, message: Message) -> VehicleState | None:
        """Take one message; return the state when it completes one."""
        kind = message.get_msgId()
        self.lone_attitude = None
        if kind == _POSITION:
            self._take_position(message)
            return None
        return self._take_attitude(message) if kind == _ATTITUDE else None

    def take_jump(self) -> Vector | None:
        """(3,) m ENU by which the estimate jumped since last asked, None where it did not.

        A reset of the estimator, not a movement.
        """
        jump, self._jump_enu = self._jump_enu, None
        return jump

    def _take_position(self, message: Message) -> None:
        time_s = message.time_boot_ms * 1e-3
        place = (message.x, message.y, message.z)
        speed = (message.vx, message.vy, message.vz)
        if not _bounded(*place, FARTHEST_M) or not _bounded(*speed, FASTEST_M_S):
            self.counters["impossible positions"] += 1
            return
        if not self._newer(time_s, self.position_time_s, "position"):
            return
        elapsed_s = time_s - self.position_time_s
        if 0.0 < elapsed_s < POSITION_TOO_OLD_S:
            self._note_jump(place, speed, elapsed_s)
        self._motion_ned, self.position_time_s = (place, speed), time_s
        self._position_enu, self._velocity_enu = enu_from_ned(place), enu_from_ned(speed)

    def _note_jump(self, place: _Triple, speed: _Triple, elapsed_s: float) -> None:
        """Compare a position with where the one before it leads to, both NED."""
        (x, y, z), (vx, vy, vz), half_s = *self._motion_ned, 0.5 * elapsed_s
        unexplained = (
            place[0] - x - half_s * (speed[0] + vx),
            place[1] - y - half_s * (speed[1] + vy),
            place[2] - z - half_s * (speed[2] + vz),
        )
        if math.hypot(*unexplained) > JUMP_M:
            self.counters["position jumps"] += 1
            jump = enu_from_ned(unexplained)
            self._jump_enu = jump if self._jump_enu is None else self._jump_enu + jump

    def _take_attitude(self, message: Message) -> VehicleState | None:
        time_s = message.time_boot_ms * 1e-3
        w, x, y, z = message.q1, message.q2, message.q3, message.q4
        rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        if not abs(norm - 1.0) <= 0.05 or not _bounded(*rates, FASTEST_RATE_RAD_S):
            self.counters["impossible attitudes"] += 1
            return None
        if not self._newer(time_s, self.attitude_time_s, "attitude"):
            return None
        self.attitude_time_s = time_s
        quaternion = quaternion_enu_flu_from_ned_frd((w / norm, x / norm, y / norm, z / norm))
        ahead_s = time_s - self.position_time_s
        if self._position_enu is None or abs(ahead_s) > POSITION_TOO_OLD_S:
            self.counters["attitudes without position"] += 1
            self.lone_attitude = VehicleState(time_s, _UNKNOWN, _UNKNOWN, quaternion, flu_from_frd(rates))
            return None
        return VehicleState(
            time_s=time_s,
            position_enu=self._position_enu + ahead_s * self._velocity_enu,
            velocity_enu=self._velocity_enu,
            quaternion_wxyz=quaternion,
            body_rate_flu=flu_from_frd(rates),
        )

    def _newer(self, time_s: float, before_s: float, what: str) -> bool:
        """Refuse repeated and out-of-order messages, but not a clock that started again (a reboot)."""
        if before_s - 5.0 < time_s <= before_s:
            self.counters[f"repeated or late {what}s"] += 1
            return False
        return True


def _bounded(a: float, b: float, c: float, limit: float) -> bool:
    return -limit <= a <= limit and -limit <= b <= limit and -limit <= c <= limit  # false with NaN
