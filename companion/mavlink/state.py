"""From messages to `VehicleState`: one moment, one frame, only numbers that can be true.

ATTITUDE_QUATERNION gives attitude and body rate and sets the moment; LOCAL_POSITION_NED gives position and
velocity and is carried to that moment by its velocity. Both autopilots send both; what differs is how
often. A state is made each time an attitude arrives and a position is young enough.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from companion.control.structs import Vector, VehicleState
from companion.mavlink.frames import enu_from_ned, flu_from_frd, quaternion_enu_flu_from_ned_frd
from companion.mavlink.link import Message, mav

POSITION_TOO_OLD_S = 0.5  # an older position is not carried forward
JUMP_M = 0.3  # a position this far from where the velocity leads is an estimator reset, not flight
FARTHEST_M = 1e5
FASTEST_M_S = 200.0
FASTEST_RATE_RAD_S = 100.0


class StateAssembler:
    """Collects the newest attitude and position. `counters` says what was refused and why."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self.attitude_time_s = -math.inf
        self.position_time_s = -math.inf
        self._position_enu: Vector | None = None
        self._velocity_enu: Vector = np.zeros(3)
        self._jump_enu: Vector = np.zeros(3)

    @property
    def velocity_enu(self) -> Vector:
        """(3,) m/s, of the newest position message; zeros before the first."""
        return self._velocity_enu

    def take(self, message: Message) -> VehicleState | None:
        """Take one message; return the state when it completes one."""
        kind = message.get_msgId()
        if kind == mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            self._take_position(message)
            return None
        if kind == mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
            return self._take_attitude(message)
        return None

    def take_jump(self) -> Vector:
        """(3,) m ENU by which the estimate jumped since last asked: a reset of the estimator, not a movement."""
        jump, self._jump_enu = self._jump_enu, np.zeros(3)
        return jump

    def _take_position(self, message: Message) -> None:
        time_s = message.time_boot_ms * 1e-3
        numbers = (message.x, message.y, message.z, message.vx, message.vy, message.vz)
        if not _bounded(numbers[:3], FARTHEST_M) or not _bounded(numbers[3:], FASTEST_M_S):
            self.counters["impossible positions"] += 1
            return
        if not self._newer(time_s, self.position_time_s, "position"):
            return
        position, velocity = enu_from_ned(numbers[:3]), enu_from_ned(numbers[3:])
        elapsed = time_s - self.position_time_s
        if self._position_enu is not None and 0.0 < elapsed < POSITION_TOO_OLD_S:
            unexplained = position - self._position_enu - 0.5 * elapsed * (velocity + self._velocity_enu)
            if float(np.linalg.norm(unexplained)) > JUMP_M:
                self.counters["position jumps"] += 1
                self._jump_enu = self._jump_enu + unexplained
        self._position_enu, self._velocity_enu, self.position_time_s = position, velocity, time_s

    def _take_attitude(self, message: Message) -> VehicleState | None:
        time_s = message.time_boot_ms * 1e-3
        quaternion = (message.q1, message.q2, message.q3, message.q4)
        rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        if not _bounded(quaternion, 1.1) or not _bounded(rates, FASTEST_RATE_RAD_S):
            self.counters["impossible attitudes"] += 1
            return None
        norm = math.sqrt(sum(q * q for q in quaternion))
        if abs(norm - 1.0) > 0.05:
            self.counters["impossible attitudes"] += 1
            return None
        if not self._newer(time_s, self.attitude_time_s, "attitude"):
            return None
        self.attitude_time_s = time_s
        ahead_s = time_s - self.position_time_s
        if self._position_enu is None or abs(ahead_s) > POSITION_TOO_OLD_S:
            self.counters["attitudes without position"] += 1
            return None
        return VehicleState(
            time_s=time_s,
            position_enu=self._position_enu + ahead_s * self._velocity_enu,
            velocity_enu=self._velocity_enu,
            quaternion_wxyz=quaternion_enu_flu_from_ned_frd(np.array(quaternion) / norm),
            body_rate_flu=flu_from_frd(rates),
        )

    def _newer(self, time_s: float, before_s: float, what: str) -> bool:
        """Refuse repeated and out-of-order messages, but not a clock that started again (a reboot)."""
        if before_s - 5.0 < time_s <= before_s:
            self.counters[f"repeated or late {what}s"] += 1
            return False
        return True


def _bounded(numbers: Sequence[float], limit: float) -> bool:
    return all(math.isfinite(number) and abs(number) <= limit for number in numbers)
