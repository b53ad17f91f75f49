"""What a client asks of an autopilot by MAVLink, as points: position targets, and the trajectory representations.

As PX4 (`mavlink_receiver.cpp`, `ObstacleAvoidance`) and ArduCopter (`GCS_MAVLink_Copter.cpp`) take them: every mask,
axis by axis, and every frame of both but heights above terrain, of which nobody has told us. Points come out in the
autopilot's local frame as ENU. A velocity or acceleration in a body's frame is turned by the vehicle's yaw only (PX4
turns an acceleration by its whole attitude, so that it leaks into the vertical; that is not copied). A position in an
offset frame counts from where the vehicle is; one in a body's frame too, with a yaw that counts from its heading
(ArduCopter), or is not taken at all, with a yaw that is a heading (PX4). Global positions need GPS_GLOBAL_ORIGIN;
heights above home count from the place of take-off.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.control.structs import Vector
from companion.live.json_points import Asked
from companion.live.point import BadPoint, Point, PolynomialPiece
from companion.mavlink.frames import enu_from_global, enu_from_ned, yaw_enu_from_ned
from companion.mavlink.framing import Framer
from companion.mavlink.layouts import mav
from companion.mavlink.received import Received, read

FRAMES_AT_ONCE = 8
"""Of one datagram; what is behind them is not read."""
_LOCAL: int = mav.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED
_GLOBAL: int = mav.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT
_WAYPOINTS: int = mav.MAVLINK_MSG_ID_TRAJECTORY_REPRESENTATION_WAYPOINTS
_BEZIER: int = mav.MAVLINK_MSG_ID_TRAJECTORY_REPRESENTATION_BEZIER
_BODY = (mav.MAV_FRAME_BODY_NED, mav.MAV_FRAME_BODY_OFFSET_NED)
_FROM_VEHICLE = (*_BODY, mav.MAV_FRAME_LOCAL_OFFSET_NED)
_ABOVE_SEA = (mav.MAV_FRAME_GLOBAL, mav.MAV_FRAME_GLOBAL_INT)
_ABOVE_HOME = (mav.MAV_FRAME_GLOBAL_RELATIVE_ALT, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
_FORCE, _NO_YAW, _NO_YAW_RATE = 0x200, 0x400, 0x800
_QUARTER_TURN = math.pi / 2


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What of the vehicle a message may count from."""

    position_enu: Vector | None  # (3,) m
    yaw_rad: float  # ENU
    origin: tuple[float, float, float] | None  # of the local frame: latitude °, longitude °, altitude m
    ground_m: float  # height of the place of take-off in the local frame
    system: int | None  # the autopilot's
    body_frame_of_px4: bool = False
    """In a body's frame no position is taken, and yaw is a heading; otherwise both count from the vehicle (ArduCopter)."""


class MavlinkPoints:
    """Reads datagrams; `surroundings` is asked where a message counts from the vehicle."""

    def __init__(self, surroundings: Callable[[], Surroundings]) -> None:
        self._surroundings = surroundings
        self._last: tuple[int, bytes] = (-1, b"")  # time stamp, frame

    def parse(self, data: bytes) -> list[Asked]:
        """Points of one datagram, in order; other messages are passed over. Raises BadPoint, in words."""
        framer = Framer(mav.mavlink_map, stream=False)
        framer.feed(data)
        found: list[Asked] = []
        for _ in range(FRAMES_AT_ONCE):
            frame = framer.next_frame()
            if frame is None:
                break
            message = read(frame)
            if message is None:
                framer.reject()
                continue
            asked = self.asked(message)
            if asked is not None:
                found.append(asked)
        if not found and framer.stray_bytes:
            raise BadPoint("not MAVLink")
        return found

    def asked(self, message: Received) -> Asked | None:
        """What one message asks for; None where it is none of the four. Raises BadPoint, in words."""
        kind = message.msg_id
        if kind in (_LOCAL, _GLOBAL):
            around = self._surroundings()
            if message.target_system not in (0, around.system):
                raise BadPoint(f"for another: system {message.target_system}, and we fly {around.system}")
            return self._target(message, around)
        if kind == _WAYPOINTS:
            return _first_waypoint(message)
        if kind == _BEZIER:
            return _bezier(message)
        return None

    def _target(self, message: Received, around: Surroundings) -> Point:
        mask, frame = message.type_mask, message.coordinate_frame
        acceleration = _masked(mask, 6, "acceleration", message.afx, message.afy, message.afz)
        if mask & _FORCE and not np.isnan(acceleration).all():
            raise BadPoint("force: setpoints of force are not flown (type_mask, bit 9)")
        velocity = _masked(mask, 3, "velocity", message.vx, message.vy, message.vz)
        if message.msg_id == _GLOBAL:
            position = _global_position(message, around)
            yaw_frame = 0.0
        else:
            if frame != mav.MAV_FRAME_LOCAL_NED and frame not in _FROM_VEHICLE:
                raise BadPoint(
                    f"frame: {frame} is not flown; LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED are"
                )
            of_px4 = frame in _BODY and around.body_frame_of_px4
            position = enu_from_ned(
                _masked(mask | 7 if of_px4 else mask, 0, "position", message.x, message.y, message.z)
            )
            yaw_frame = around.yaw_rad - _QUARTER_TURN if frame in _BODY else 0.0
            if frame in _FROM_VEHICLE and not np.isnan(position).all():
                if around.position_enu is None:
                    raise BadPoint("the vehicle's position is not known yet")
                position = around.position_enu + _turned(position, yaw_frame)
        yaw = yaw_rate = math.nan
        if not mask & _NO_YAW:
            yaw = yaw_enu_from_ned(_finite("yaw", message.yaw))
            yaw = yaw + yaw_frame if frame in _BODY and not around.body_frame_of_px4 else yaw
        if not mask & _NO_YAW_RATE:
            yaw_rate = -_finite("yaw rate", message.yaw_rate)
        return Point(
            self._time(message),
            position,
            _turned(enu_from_ned(velocity), yaw_frame),
            _turned(enu_from_ned(acceleration), yaw_frame),
            yaw_rad=yaw,
            yaw_rate_rad_s=yaw_rate,
        )

    def _time(self, message: Received) -> float:
        """s; NaN where the client does not fill it in, or always with the same (autopilots do not look at it)."""
        stamp_ms, frame = message.time_boot_ms, message.msg_frame
        last_ms, last_frame = self._last
        if frame == last_frame:
            raise BadPoint("repeated: a point of this time has come")
        self._last = (stamp_ms, frame)
        return math.nan if stamp_ms in (0, last_ms) else stamp_ms * 1e-3


def _masked(mask: int, lowest_bit: int, name: str, *values: float) -> tuple[float, float, float]:
    """Three numbers, NaN where their bit says to ignore them."""
    x, y, z = (
        math.nan if mask >> (lowest_bit + axis) & 1 else _finite(name, value)
        for axis, value in enumerate(values)
    )
    return x, y, z


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise BadPoint(f"not a number: {name}, and type_mask does not say to ignore it")
    return value


def _turned(vector_enu: Vector, yaw_rad: float) -> Vector:
    """(3,) turned about z. What is not known of one horizontal axis is not known of either, where they mix."""
    if yaw_rad == 0.0:
        return vector_enu
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    x, y, z = vector_enu.tolist()
    return np.array((c * x - s * y, s * x + c * y, z))


def _global_position(message: Received, around: Surroundings) -> Vector:
    frame, mask = message.coordinate_frame, message.type_mask
    if frame not in (*_ABOVE_SEA, *_ABOVE_HOME):
        raise BadPoint(
            f"frame: {frame} is not flown; GLOBAL_INT and GLOBAL_RELATIVE_ALT_INT are (heights above terrain are not known)"
        )
    position = np.full(3, math.nan)
    if mask & 7 == 7:
        return position
    if around.origin is None:
        raise BadPoint("no GPS_GLOBAL_ORIGIN: the autopilot has not said where its local frame lies")
    altitude = _finite("altitude", message.alt) if not mask & 4 else 0.0
    place = enu_from_global(message.lat_int * 1e-7, message.lon_int * 1e-7, altitude, around.origin)
    if frame in _ABOVE_HOME:
        place[2] = altitude + around.ground_m
    for axis, bit in ((1, 1), (0, 2), (2, 4)):  # x of the mask is north
        if not mask & bit:
            position[axis] = place[axis]
    return position


def _first_waypoint(message: Received) -> Point:
    """Point 0, as PX4 took it from an obstacle avoidance: those behind it have no times."""
    if not 1 <= message.valid_points <= 5:
        raise BadPoint(f"valid_points: {message.valid_points}, of 1 to 5")

    def vector(name: str) -> Vector:
        return enu_from_ned([getattr(message, f"{name}_{axis}")[0] for axis in "xyz"])

    yaw, yaw_rate = message.pos_yaw[0], message.vel_yaw[0]
    return Point(
        message.time_usec * 1e-6 or math.nan,
        vector("pos"),
        vector("vel"),
        vector("acc"),
        yaw_rad=yaw_enu_from_ned(yaw) if math.isfinite(yaw) else math.nan,
        yaw_rate_rad_s=-yaw_rate,
    )


def _bezier(message: Received) -> PolynomialPiece:
    """Control points of one curve, over the time horizon `delta` of the last of them."""
    count = message.valid_points
    if not 1 <= count <= 5:
        raise BadPoint(f"valid_points: {count}, of 1 to 5")
    duration_s = message.delta[count - 1]
    if not (math.isfinite(duration_s) and duration_s > 0.0):
        raise BadPoint(f"delta: {duration_s:g} s; a curve without a time horizon is no motion")
    rows = np.array([getattr(message, name)[:count] for name in ("pos_y", "pos_x", "pos_z", "pos_yaw")])
    rows[2:] = -rows[2:]
    rows[3] = np.unwrap(rows[3] + _QUARTER_TURN) if np.isfinite(rows[3]).all() else math.nan
    return PolynomialPiece(_powers(rows, duration_s), duration_s, message.time_usec * 1e-6 or math.nan)


def _powers(control_points: Vector, duration_s: float) -> Vector:
    """(rows, n) Bernstein → ascending powers of the time: c_k = C(d, k) Σ_i (−1)^(k−i) C(k, i) P_i / T^k, d = n − 1."""
    degree = control_points.shape[1] - 1
    out = np.empty_like(control_points)
    for k in range(degree + 1):
        signs = np.array([(-1.0) ** (k - i) * math.comb(k, i) for i in range(k + 1)])
        out[:, k] = math.comb(degree, k) * (control_points[:, : k + 1] @ signs) / duration_s**k
    return out
