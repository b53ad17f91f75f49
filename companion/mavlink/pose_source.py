"""A stand-in for a motion-capture system: true poses of a simulator, or a drawn circle, as pose datagrams over UDP.

The simulator's truth is HIL_STATE_QUATERNION (115), heard on a link of its own (PX4 SITL: the ground station's, or SIH's
display port). The first position heard becomes the origin, as if the capture volume had been laid out around the vehicle.
"""

from __future__ import annotations

import math
import socket
import time
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from companion.config.errors import UserError
from companion.mavlink.frames import enu_from_global, enu_from_ned, quaternion_enu_flu_from_ned_frd
from companion.mavlink.framing import Framer
from companion.mavlink.link import mav
from companion.mavlink.pose_datagram import OutsidePose, pack_pose
from companion.mavlink.protocol import message_interval
from companion.mavlink.received import read
from companion.mavlink.transport import Transport, resolve

_ASK_AGAIN_S = 2.0
_OUR_COMPONENT = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY


@dataclass(frozen=True, slots=True)
class Imperfection:
    """What a real system adds to the truth."""

    position_sd_m: float = 0.0
    attitude_sd_rad: float = 0.0
    velocity_sd_m_s: float = 0.0
    latency_s: float = 0.0  # from the moment of the pose until its datagram leaves
    drop_ratio: float = 0.0  # of datagrams that never leave


class PoseSender:
    """Sends poses to `target` (host, port), spoilt as `imperfection` says. `counters`: sent, dropped."""

    def __init__(
        self, target: tuple[str, int], imperfection: Imperfection, seed: int = 0, binary: bool = True
    ) -> None:
        try:
            family, self._target = resolve(*target, socket.SOCK_DGRAM, False)
        except OSError as error:
            raise UserError(f"--to {target[0]}:{target[1]}: {error.strerror or error}") from None
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._imperfection = imperfection
        self._random = np.random.default_rng(seed)
        self._binary = binary
        self._waiting: deque[tuple[float, bytes]] = deque()
        self.counters: Counter[str] = Counter()

    def add(self, pose: OutsidePose, now_s: float) -> None:
        """Take a true pose at `now_s`; it leaves with `flush` once its latency is over."""
        flaw = self._imperfection
        if flaw.drop_ratio and self._random.random() < flaw.drop_ratio:
            self.counters["dropped"] += 1
            return
        position = pose.position_enu + flaw.position_sd_m * self._random.standard_normal(3)
        turn = 0.5 * flaw.attitude_sd_rad * self._random.standard_normal(3)
        velocity = pose.velocity_enu
        if velocity is not None:
            velocity = velocity + flaw.velocity_sd_m_s * self._random.standard_normal(3)
        attitude = _turned(pose.quaternion_wxyz, turn)
        spoilt = OutsidePose(pose.time_s, position, attitude, velocity_enu=velocity)
        self._waiting.append((now_s + flaw.latency_s, pack_pose(spoilt, self._binary)))

    def flush(self, now_s: float) -> None:
        """Send what is due."""
        while self._waiting and self._waiting[0][0] <= now_s:
            data = self._waiting.popleft()[1]
            try:
                self._socket.sendto(data, self._target)
                self.counters["sent"] += 1
            except OSError:
                self.counters["not sent"] += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def true_poses(
    transport: Transport, rate_hz: float, poll_s: float = 0.005, system: int | None = None
) -> Iterator[OutsidePose | None]:
    """Poses out of a simulator's HIL_STATE_QUATERNION, for ever; None whenever there is none yet.

    Stamped with our monotonic clock at arrival, for the message's own time is not filled in everywhere.

    Raises:
        UserError: two simulators tell their truth here, and no `system` is given.
    """
    wanted = system
    framer = Framer(mav.mavlink_map, stream=not transport.datagrams)
    codec = mav.MAVLink(None, srcSystem=1, srcComponent=_OUR_COMPONENT)
    asked_s = -math.inf
    system = None
    origin: tuple[float, float, float] | None = None
    while True:
        now_s = time.monotonic()
        if now_s - asked_s > _ASK_AGAIN_S:
            asked_s = now_s
            _ask(transport, codec, system or 1, rate_hz)
        if transport.wait(poll_s):
            for chunk in transport.receive():
                framer.feed(chunk, transport.sender)
        while (frame := framer.next_frame()) is not None:
            message = read(frame)
            if message is None:
                framer.reject()
                continue
            if message.get_srcComponent() != mav.MAV_COMP_ID_AUTOPILOT1:
                continue
            if system is None and wanted in (None, message.get_srcSystem()):
                system, asked_s = message.get_srcSystem(), -math.inf
                transport.believe_sender()
            if message.get_msgId() != mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION:
                continue
            if message.get_srcSystem() != system:
                if wanted is None:
                    raise UserError(
                        f"simulators with system {system} and {message.get_srcSystem()} are heard: give --system N"
                    )
                continue
            place = (message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3)
            origin = origin or place
            quaternion = np.array(message.attitude_quaternion, dtype=np.float64)
            quaternion /= np.linalg.norm(quaternion)
            yield OutsidePose(
                time.monotonic(),
                enu_from_global(*place, origin),
                quaternion_enu_flu_from_ned_frd(quaternion),
                velocity_enu=enu_from_ned((0.01 * message.vx, 0.01 * message.vy, 0.01 * message.vz)),
            )
        yield None


def circle_poses(
    rate_hz: float, radius_m: float = 1.0, period_s: float = 10.0
) -> Iterator[OutsidePose | None]:
    """A level circle at 1 m height, nose along the path, at `rate_hz` of our monotonic clock, for ever."""
    begun_s = time.monotonic()
    count = 0
    while True:
        due_s = begun_s + count / rate_hz
        left_s = due_s - time.monotonic()
        if left_s > 0.0:
            time.sleep(min(left_s, 0.005))
            yield None
            continue
        count += 1
        angle = 2.0 * math.pi * (due_s - begun_s) / period_s
        yaw = angle + math.pi / 2.0
        yield OutsidePose(
            due_s,
            np.array([radius_m * math.cos(angle), radius_m * math.sin(angle), 1.0]),
            np.array([math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)]),
        )


def _ask(transport: Transport, codec: mav.MAVLink, system: int, rate_hz: float) -> None:
    command = message_interval(mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, rate_hz)
    parameters = (*command.parameters, *(0.0,) * (7 - len(command.parameters)))
    message = mav.MAVLink_command_long_message(
        system, mav.MAV_COMP_ID_AUTOPILOT1, command.number, 0, *parameters
    )
    transport.send(message.pack(codec))
    codec.seq = (codec.seq + 1) % 256


def _turned(quaternion_wxyz: np.ndarray, half_turn: np.ndarray) -> np.ndarray:
    """(4,) a quaternion turned by a small rotation about the body's axes (3,), half angles in rad."""
    w, v = quaternion_wxyz[0], quaternion_wxyz[1:]
    turned = np.array([w - v @ half_turn, *(v + w * half_turn + np.cross(v, half_turn))])
    return np.asarray(turned / np.linalg.norm(turned))
