"""The only place where MAVLink's frames become ours: world NED → ENU, body FRD → FLU, and back.

Every map here is its own inverse, so one function serves both directions; both names exist so that a
call says which way it goes.

    ENU = (y, x, −z) of NED          FLU = (x, −y, −z) of FRD
    R(ENU←FLU) = T · R(NED←FRD) · F ,  T = [[0,1,0],[1,0,0],[0,0,−1]] ,  F = diag(1, −1, −1)
    yaw_ENU = π/2 − yaw_NED          (counter-clockwise from east; clockwise from north)
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vector = NDArray[np.float64]
_SQRT_HALF = math.sqrt(0.5)


def _numbers(values: ArrayLike) -> Sequence[float]:
    """The components as Python's floats: with three or four of them that is quicker than NumPy's arithmetic."""
    if type(values) is tuple:
        return values
    return np.asarray(values, dtype=np.float64).tolist()  # type: ignore[no-any-return]


def enu_from_ned(vector_ned: ArrayLike) -> Vector:
    """(3,) world vector NED → ENU; any unit."""
    north, east, down = _numbers(vector_ned)
    return np.array((east, north, -down), dtype=np.float64)


def ned_from_enu(vector_enu: ArrayLike) -> Vector:
    """(3,) world vector ENU → NED; any unit."""
    return enu_from_ned(vector_enu)


def flu_from_frd(vector_frd: ArrayLike) -> Vector:
    """(3,) body vector FRD → FLU; any unit. Holds for rates and torques too (a proper rotation)."""
    forward, right, down = _numbers(vector_frd)
    return np.array((forward, -right, -down), dtype=np.float64)


def frd_from_flu(vector_flu: ArrayLike) -> Vector:
    """(3,) body vector FLU → FRD; any unit."""
    return flu_from_frd(vector_flu)


def quaternion_enu_flu_from_ned_frd(quaternion_wxyz: ArrayLike) -> Vector:
    """(4,) attitude, Hamilton w first: body FRD → NED becomes body FLU → ENU.

    This is q_T ⊗ q ⊗ q_F with q_T = (0, √½, √½, 0) (half a turn about north-east) and q_F = (0, 1, 0, 0)
    (half a turn about forward), multiplied out. The sign is chosen so that w ≥ 0.
    """
    w, x, y, z = _numbers(quaternion_wxyz)
    half = -_SQRT_HALF if _SQRT_HALF * (w + z) < 0.0 else _SQRT_HALF
    return np.array((half * (w + z), half * (x + y), half * (x - y), half * (w - z)))


def quaternion_ned_frd_from_enu_flu(quaternion_wxyz: ArrayLike) -> Vector:
    """(4,) attitude, Hamilton w first: body FLU → ENU becomes body FRD → NED."""
    return quaternion_enu_flu_from_ned_frd(quaternion_wxyz)


def attitude_from_euler_ned(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Vector:
    """(4,) attitude body FLU → ENU of ATTITUDE's angles: ZYX, body FRD in NED."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return quaternion_enu_flu_from_ned_frd(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def angle_between(one_wxyz: Vector, other_wxyz: Vector) -> float:
    """Angle of the rotation that leads from one attitude to the other, rad, 0 to π."""
    return 2.0 * math.acos(min(1.0, abs(float(one_wxyz @ other_wxyz))))


def yaw_enu_from_ned(yaw_ned_rad: float) -> float:
    """Heading clockwise from north → counter-clockwise from east, wrapped to [−π, π)."""
    return (math.pi / 2 - yaw_ned_rad + math.pi) % (2 * math.pi) - math.pi


def yaw_ned_from_enu(yaw_enu_rad: float) -> float:
    """Heading counter-clockwise from east → clockwise from north, wrapped to [−π, π)."""
    return yaw_enu_from_ned(yaw_enu_rad)


_EARTH_RADIUS_M = 6371000.0  # the sphere PX4's and ArduPilot's local projections are close to


def enu_from_global(
    latitude_deg: float, longitude_deg: float, altitude_m: float, origin: tuple[float, float, float]
) -> Vector:
    """(3,) m ENU of a global position about `origin` (latitude °, longitude °, altitude m).

    Flat-earth (equirectangular) about the origin: off by less than 1 mm within 1 km, the size of a flight here.
    """
    latitude_0, longitude_0, altitude_0 = origin
    north = math.radians(latitude_deg - latitude_0) * _EARTH_RADIUS_M
    east = math.radians(longitude_deg - longitude_0) * _EARTH_RADIUS_M * math.cos(math.radians(latitude_0))
    return np.array([east, north, altitude_m - altitude_0])
