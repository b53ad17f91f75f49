"""Poses and messages in wrong axes, over the wire: refused before arming, noticed in flight."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from link_flights import NoteTaker, companion, free_port, stub_behind
from pymavlink.dialects.v20 import all as mavlink
from wire_relay import Relay, UdpWire

from companion.config.settings import load_settings
from companion.flight.session import check
from companion.mavlink.connection import Connection
from companion.mavlink.endpoint import parse_endpoint
from companion.mavlink.frames import enu_from_ned, quaternion_enu_flu_from_ned_frd
from companion.mavlink.pose_datagram import OutsidePose, pack_pose

pytestmark = pytest.mark.flight
SETTINGS = ["flight.procedure.connect_timeout_s=120", "flight.control_rate_hz=100"]
ORIGIN_M = np.array([3.0, -2.0, 0.5])
PoseChange = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def right(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return position, quaternion


def ned(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return enu_from_ned(position), quaternion_enu_flu_from_ned_frd(quaternion)


def turned(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The world by 90° counter-clockwise."""
    (x, y, z), (w, i, j, k) = position, quaternion
    return np.array([-y, x, z]), np.sqrt(0.5) * np.array([w - k, i - j, j + i, k + w])


def upside_down(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return position, np.array([-quaternion[1], quaternion[0], quaternion[3], -quaternion[2]])


def millimetres(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return 1e3 * position, quaternion


def y_mirrored(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions alone; mirrored with the attitude it is told at rest."""
    return position * [1.0, -1.0, 1.0], quaternion


def z_down(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return position * [1.0, 1.0, -1.0], quaternion


class Camera:
    """Sees where the vehicle is from the autopilot's own messages, and tells it in `frame`; spoils ATTITUDE where told."""

    def __init__(self, pose_port: int) -> None:
        self.frame: PoseChange = right
        self.yaw_off_rad = 0.0
        self._to = ("127.0.0.1", pose_port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._codec = mavlink.MAVLink(None)
        self._codec.robust_parsing = True
        self._out = mavlink.MAVLink(None)
        self._position: np.ndarray | None = None

    def see(self, datagram: bytes) -> list[bytes]:
        frames = []
        for message in self._codec.parse_buffer(bytearray(datagram)) or []:
            if message.get_type() == "LOCAL_POSITION_NED":
                self._position = enu_from_ned((message.x, message.y, message.z))
            elif message.get_type() == "ATTITUDE_QUATERNION" and self._position is not None:
                q = quaternion_enu_flu_from_ned_frd((message.q1, message.q2, message.q3, message.q4))
                position, quaternion = self.frame(self._position + ORIGIN_M, q / np.linalg.norm(q))
                pose = OutsidePose(message.time_boot_ms * 1e-3, position, quaternion)
                self._socket.sendto(pack_pose(pose), self._to)
            elif message.get_type() == "ATTITUDE" and self.yaw_off_rad:
                message.yaw += self.yaw_off_rad
                self._out.srcSystem, self._out.srcComponent = message.get_srcSystem(), 1
                self._out.seq = message.get_seq()
                frames.append(bytes(message.pack(self._out)))
                continue
            frames.append(bytes(message.get_msgbuf()))
        return [b"".join(frames)] if frames else []

    def close(self) -> None:
        self._socket.close()


@contextmanager
def watched(*options: str) -> Iterator[tuple[Camera, str, int]]:
    """A stub whose vehicle a camera sees: the camera, the endpoint, the port of the poses."""
    port, pose_port = free_port(), free_port()
    camera = Camera(pose_port)
    try:
        with stub_behind(*options) as stub_port, Relay(stub_port, UdpWire(port), camera.see):
            yield camera, f"udpin:127.0.0.1:{port}", pose_port
    finally:
        camera.close()


def test_wrong_frames_are_refused_before_arming_with_what_they_look_like(tmp_path: Path) -> None:
    settings = load_settings("qball2", {"level": "attitude"}, SETTINGS)

    def found(endpoint: str, pose_port: int) -> dict[str, tuple[str, str, str]]:
        poses = ("127.0.0.1", pose_port)
        findings, _, _ = check(
            settings, Connection(parse_endpoint(endpoint)), NoteTaker(), outside_poses=poses
        )
        return {f.subject: (f.verdict.value, f.found, f.remedy) for f in findings}

    with watched("--param", "EKF2_EV_CTRL=15") as (camera, endpoint, pose_port):
        for frame, subject, remedy in (
            (ned, "heading of poses", "NED and FRD given as ENU and FLU: send (y, x, −z)"),
            (upside_down, "tilt of poses", "body axes forward, right, down: send"),
            (millimetres, "movement of poses", "positions in millimetres: send metres"),
        ):
            camera.frame = frame
            verdict, value, mend = found(endpoint, pose_port)[subject]
            assert verdict == "refusal", (frame, value)
            assert mend.startswith(remedy), (frame, value)
        camera.frame, camera.yaw_off_rad = right, np.pi / 2
        findings = found(endpoint, pose_port)
        assert {what: findings[what][0] for what in findings if "poses" in what} == dict.fromkeys(
            ("poses from outside", "tilt of poses", "heading of poses", "movement of poses"), "ok"
        )
        assert findings["tilt on the ground"][0] == "ok"
        apart = "ATTITUDE and ATTITUDE_QUATERNION are 90° apart"
        assert findings["attitude messages"][:2] == ("refusal", apart)
        camera.yaw_off_rad, camera.frame = 0.0, turned
        flown = companion(endpoint, tmp_path, outside_poses=("127.0.0.1", pose_port))
    assert flown.outcome == "refused", flown.text
    assert "heading of poses +90° from the autopilot's" in flown.text
    assert "its world is turned by +90°: turn positions and attitudes by -90°" in flown.text


@pytest.mark.parametrize("frame", [z_down, y_mirrored])
def test_what_cannot_be_told_at_rest_is_noticed_in_flight(tmp_path: Path, frame: PoseChange) -> None:
    with watched("--param", "EKF2_EV_CTRL=15") as (camera, endpoint, pose_port):
        camera.frame = frame
        flown = companion(
            endpoint, tmp_path, outside_poses=("127.0.0.1", pose_port), settings={"trajectory": "lemniscate"}
        )
    assert flown.outcome == "aborted", flown.text
    assert "pose_" in flown.text and "landed and disarmed" in flown.text
