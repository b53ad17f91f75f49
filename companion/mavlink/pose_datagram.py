"""The datagram a source of poses sends: one UDP packet a pose, JSON for people or binary for machines.

JSON, an object with

    time_s           when the pose was true, seconds of the source's own steady clock, any zero
    position_enu     [x, y, z], m, east, north, up of the source's fixed origin
    quaternion_wxyz  [w, x, y, z], turns body forward-left-up into east-north-up
    covariance       optional, 21 numbers: upper triangle, row by row, of the 6×6 covariance of
                     (x, y, z ENU in m², rotations about forward, left, up in rad²)
    velocity_enu     optional, [x, y, z], m/s, where the source knows it better than by differences of its poses
    reset_counter    optional, 0..255: one more each time the source's origin has jumped

Binary, little-endian: the 4 bytes `POS1`, then 8 float64 (time_s, position_enu, quaternion_wxyz), 68 bytes in all; with
covariance 21 float32 more, 152 bytes in all. `POS2` has 11 float64, the last three velocity_enu: 92 or 176 bytes.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass

import numpy as np

from companion.mavlink.frames import Vector

_FLOATS = {b"POS1": 8, b"POS2": 11}
COVARIANCE_NUMBERS = 21
_COVARIANCE = struct.Struct(f"<{COVARIANCE_NUMBERS}f")
FASTEST_M_S = 100.0
NORM_TOLERANCE = 0.05  # of the quaternion's length; more is not a rotation badly rounded
FARTHEST_M = 1e4
LATEST_S = 1e11  # of any clock; beyond it a float64 tells no two poses of a flight apart
LARGEST_COVARIANCE = 1e8  # m² or rad²; MAVLink carries float32, and more is no measurement


class BadPose(ValueError):
    """A datagram that holds no pose; `str()` says what is wrong with it, in few words."""


@dataclass(frozen=True, slots=True)
class OutsidePose:
    """Where somebody outside saw the vehicle."""

    time_s: float  # of the source's clock
    position_enu: Vector  # (3,) m
    quaternion_wxyz: Vector  # (4,) unit, body FLU → ENU
    covariance: Vector | None = None  # (21,) see the module
    reset_counter: int = 0  # 0..255
    velocity_enu: Vector | None = None  # (3,) m/s


def parse_pose(data: bytes) -> OutsidePose:
    """Read one datagram, in either form.

    Raises:
        BadPose: it is neither form, or its numbers cannot be true.
    """
    covariance: list[float] | tuple[float, ...] | None = None
    velocity: list[float] | tuple[float, ...] | None = None
    resets = 0
    count = _FLOATS.get(data[:4])
    if count is not None:
        end = 4 + 8 * count
        if len(data) not in (end, end + _COVARIANCE.size):
            raise BadPose("wrong length")
        numbers = struct.unpack(f"<{count}d", data[4:end])
        time_s, position, quaternion = numbers[0], numbers[1:4], numbers[4:8]
        velocity = numbers[8:] or None
        covariance = _COVARIANCE.unpack(data[end:]) if len(data) > end else None
    else:
        try:
            fields = json.loads(data)
            time_s = float(fields["time_s"])
            position = [float(v) for v in fields["position_enu"]]
            quaternion = [float(v) for v in fields["quaternion_wxyz"]]
            if fields.get("covariance") is not None:
                covariance = [float(v) for v in fields["covariance"]]
            if fields.get("velocity_enu") is not None:
                velocity = [float(v) for v in fields["velocity_enu"]]
            resets = int(fields.get("reset_counter", 0)) % 256
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            raise BadPose("not readable") from None
        if len(position) != 3 or len(quaternion) != 4 or (velocity is not None and len(velocity) != 3):
            raise BadPose("wrong length")
    return _checked(time_s, position, quaternion, velocity, covariance, resets)


def _checked(
    time_s: float,
    position: tuple[float, ...] | list[float],
    quaternion: tuple[float, ...] | list[float],
    velocity: tuple[float, ...] | list[float] | None,
    covariance: tuple[float, ...] | list[float] | None,
    resets: int,
) -> OutsidePose:
    if not all(math.isfinite(v) for v in (time_s, *position, *quaternion, *(velocity or ()))):
        raise BadPose("not finite")
    if abs(time_s) > LATEST_S:
        raise BadPose("time out of range")
    if max(abs(v) for v in position) > FARTHEST_M:
        raise BadPose("too far away")
    if velocity is not None and max(abs(v) for v in velocity) > FASTEST_M_S:
        raise BadPose("too fast")
    norm = math.sqrt(sum(q * q for q in quaternion))
    if abs(norm - 1.0) > NORM_TOLERANCE:
        raise BadPose("quaternion not of unit length")
    triangle = None
    if covariance is not None:
        triangle = np.array(covariance, dtype=np.float64)
        if triangle.shape != (COVARIANCE_NUMBERS,) or not np.all(np.isfinite(triangle)):
            raise BadPose("covariance not 21 finite numbers")
        if np.any(np.abs(triangle) > LARGEST_COVARIANCE):
            raise BadPose("covariance out of range")
        if np.any(np.diag(full_covariance(triangle)) < 0.0):
            raise BadPose("negative variance")
    return OutsidePose(
        time_s,
        np.array(position),
        np.array(quaternion) / norm,
        triangle,
        resets,
        None if velocity is None else np.array(velocity),
    )


def pack_pose(pose: OutsidePose, binary: bool = True) -> bytes:
    """Write one datagram. The binary form has no room for `reset_counter`."""
    if not binary:
        fields: dict[str, object] = {
            "time_s": pose.time_s,
            "position_enu": pose.position_enu.tolist(),
            "quaternion_wxyz": pose.quaternion_wxyz.tolist(),
        }
        if pose.covariance is not None:
            fields["covariance"] = pose.covariance.tolist()
        if pose.velocity_enu is not None:
            fields["velocity_enu"] = pose.velocity_enu.tolist()
        if pose.reset_counter:
            fields["reset_counter"] = pose.reset_counter
        return json.dumps(fields).encode()
    magic = b"POS1" if pose.velocity_enu is None else b"POS2"
    velocity = [] if pose.velocity_enu is None else pose.velocity_enu.tolist()
    numbers = (pose.time_s, *pose.position_enu.tolist(), *pose.quaternion_wxyz.tolist(), *velocity)
    body = magic + struct.pack(f"<{_FLOATS[magic]}d", *numbers)
    return body if pose.covariance is None else body + _COVARIANCE.pack(*pose.covariance.tolist())


def full_covariance(triangle: Vector) -> Vector:
    """(6, 6) symmetric matrix of an upper triangle (21,), row by row."""
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = triangle
    return matrix + np.triu(matrix, 1).T


def upper_triangle(matrix: Vector) -> Vector:
    """(21,) upper triangle, row by row, of a (6, 6) matrix."""
    return np.asarray(matrix[np.triu_indices(6)], dtype=np.float64)
