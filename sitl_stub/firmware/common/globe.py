"""Latitude and longitude from local north and east, on a sphere flattened about the origin."""

from __future__ import annotations

import math
from dataclasses import dataclass

EARTH_RADIUS_M = 6371000.0


@dataclass(frozen=True, slots=True)
class LocalOrigin:
    """Where local (0, 0, 0) lies. Valid for the few hundred metres a multirotor flies in a test."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    """Above mean sea level."""

    def altitude_of(self, down_m: float) -> float:
        """Altitude above sea level, m, of local z; and local z of an altitude."""
        return self.altitude_m - down_m

    def globe_e7(self, north_m: float, east_m: float) -> tuple[int, int]:
        """Latitude and longitude in 1e-7 degrees, as MAVLink sends them."""
        latitude = self.latitude_deg + math.degrees(north_m / EARTH_RADIUS_M)
        scale = EARTH_RADIUS_M * math.cos(math.radians(self.latitude_deg))
        longitude = self.longitude_deg + math.degrees(east_m / scale)
        return round(latitude * 1e7), round(longitude * 1e7)

    def local(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """North and east, m, of a place."""
        scale = EARTH_RADIUS_M * math.cos(math.radians(self.latitude_deg))
        north = math.radians(latitude_deg - self.latitude_deg) * EARTH_RADIUS_M
        return north, math.radians(longitude_deg - self.longitude_deg) * scale
