"""A mission: places on the globe, flown smoothly one after the other, once it is known where the vehicle stands.

Through places without a hold time the curve of least snap goes without a stop (`minimum_snap.py`); at the others the
vehicle comes to rest. Horizontally the places lie about GPS_GLOBAL_ORIGIN, the origin of the autopilot's local frame;
heights are above the place of take-off or above mean sea level, as the mission says.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from companion.config.errors import UserError
from companion.control.structs import Reference, Vector
from companion.mavlink.frames import enu_from_global
from companion.reference.minimum_snap import Waypoints, minimum_snap_knots
from companion.reference.spline import Spline, spline_through
from companion.reference.trajectory import Trajectory, placed, wrapped
from companion.reference.transit import TransitLimits

SAME_M, SAME_RAD = 0.01, 0.01


@dataclass(frozen=True, slots=True)
class GlobalPoint:
    """One place."""

    where: str  # in the file, for people
    latitude_deg: float  # NaN: above the place of take-off
    longitude_deg: float
    altitude_m: float
    above_home: bool  # otherwise above mean sea level
    yaw_rad: float  # ENU; NaN: as before
    hold_s: float


class Mission:
    """A `Trajectory` about its own first place, to look at; `located` is the one that is flown."""

    def __init__(self, name: str, points: tuple[GlobalPoint, ...], speed_m_s: float | None) -> None:
        """`speed_m_s`: at most; None as for waypoint files. `name` for people."""
        self.name = name
        self.points = points
        self._limits = TransitLimits() if speed_m_s is None else replace(TransitLimits(), speed_m_s=speed_m_s)
        self._located: tuple[Vector, Spline] | None = None
        self._shown: Spline | None = None

    @property
    def duration_s(self) -> float:
        """See `Trajectory`."""
        return self._preview().duration_s

    def sample(self, time_s: float) -> Reference:
        """See `Trajectory`."""
        return self._preview().sample(time_s)

    def located(self, origin: tuple[float, float, float], home_enu: Vector, yaw_rad: float) -> Trajectory:
        """The mission in the autopilot's local frame, whose `origin` is (latitude °, longitude °, altitude m).

        `home_enu` (3,) m and `yaw_rad`: where and how the vehicle stands. Planned once: for a place of take-off that has
        wandered since, heights go along. Raises UserError where it is no tour.
        """
        if self._located is None:
            self._located = home_enu.copy(), self._tour(origin, home_enu, yaw_rad)
        planned_enu, spline = self._located
        rise_m = float(home_enu[2] - planned_enu[2])
        above_home = all(point.above_home for point in self.points)
        return placed(spline, np.array([0.0, 0.0, rise_m]), 0.0) if above_home and rise_m else spline

    def _preview(self) -> Spline:
        if self._shown is None:
            first = next((point for point in self.points if math.isfinite(point.latitude_deg)), None)
            sea = [point.altitude_m for point in self.points if not point.above_home]
            place = (first.latitude_deg, first.longitude_deg) if first is not None else (0.0, 0.0)
            self._shown = self._tour((*place, sea[0] if sea else 0.0), np.zeros(3), 0.0)
        return self._shown

    def _tour(self, origin: tuple[float, float, float], home_enu: Vector, yaw_rad: float) -> Spline:
        rows: list[tuple[Vector, float]] = []  # x, y, z, yaw; hold
        for point in self.points:
            place = home_enu.copy()
            if math.isfinite(point.latitude_deg):
                place = enu_from_global(point.latitude_deg, point.longitude_deg, 0.0, origin)
            place[2] = point.altitude_m + (home_enu[2] if point.above_home else -origin[2])
            if math.isfinite(point.yaw_rad):
                yaw_rad += wrapped(point.yaw_rad - yaw_rad)
            row = np.array((*place, yaw_rad))
            if (
                rows
                and np.linalg.norm(rows[-1][0][:3] - place) < SAME_M
                and abs(rows[-1][0][3] - yaw_rad) < SAME_RAD
            ):
                rows[-1] = rows[-1][0], rows[-1][1] + point.hold_s
            else:
                rows.append((row, point.hold_s))
        if len(rows) < 2:
            raise UserError(f"{self.name}: all its places are one")
        try:
            return self._joined(np.array([row for row, _ in rows]), [hold_s for _, hold_s in rows])
        except ArithmeticError as error:
            raise UserError(f"{self.name}: {error}") from None

    def _joined(self, rows: Vector, holds_s: list[float]) -> Spline:
        """One spline of stretches from rest to rest, with standing still between them."""
        last = len(rows) - 1
        stops = [0, *(i for i in range(1, last) if holds_s[i] > 0.0), last]
        times: list[Vector] = []
        knots: list[Vector] = []
        now_s = 0.0
        for begin, end in itertools.pairwise(stops):
            if holds_s[begin] > 0.0:
                now_s += self._stand(rows[begin], holds_s[begin], now_s, times, knots)
            part = rows[begin : end + 1]
            at, derivatives = minimum_snap_knots(Waypoints(part[:, :3], part[:, 3], None, self._limits))
            skipped = 1 if times else 0  # where the stretch before ended, or the standing
            times.append(now_s + at[skipped:])
            knots.append(derivatives[skipped:])
            now_s += float(at[-1])
        if holds_s[last] > 0.0:
            self._stand(rows[last], holds_s[last], now_s, times, knots)
        return spline_through(np.concatenate(times), np.concatenate(knots))

    @staticmethod
    def _stand(row: Vector, hold_s: float, now_s: float, times: list[Vector], knots: list[Vector]) -> float:
        still = np.zeros((1, 4, 4))
        still[0, 0] = row
        if not times:
            times.append(np.array([now_s]))
            knots.append(still)
        times.append(np.array([now_s + hold_s]))
        knots.append(still)
        return hold_s
