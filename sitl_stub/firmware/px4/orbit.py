"""DO_ORBIT: PX4 flies a circle about a place, its nose to the middle (`FlightTaskOrbit`)."""

from __future__ import annotations

import math

import numpy as np

from sitl_stub.firmware.common.commands import HIGHEST_M, is_place
from sitl_stub.firmware.px4.follower import Follower
from sitl_stub.firmware.px4.state import Px4State

RADIUS_M, SPEED_M_S = 5.0, 1.0
SMALLEST_M, LARGEST_M = 1.0, 1000.0
MOST_M_S2 = 2.0
"""Centripetal acceleration; a faster orbit is slowed down to it."""
CLIMB_M_S = 1.0


class Orbit:
    """See the module. Radius is positive clockwise, as in MAVLink."""

    def __init__(self, state: Px4State) -> None:
        self._state = state
        self.centre_ned = np.zeros(3)
        self.signed_radius_m = RADIUS_M
        self._speed_m_s = SPEED_M_S
        self._angle = self._out_m = 0.0  # where the setpoint is, from the centre

    def begin(self, params: tuple[float, ...]) -> None:
        """Circle by the parameters of MAV_CMD_DO_ORBIT; what is NaN is left to us."""
        state, here = self._state, self._state.core.position_ned
        radius, speed, _, _, latitude, longitude, altitude = params
        if math.isfinite(radius) and radius:
            self.signed_radius_m = math.copysign(min(max(abs(radius), SMALLEST_M), LARGEST_M), radius)
        if math.isfinite(speed) and speed:
            self._speed_m_s = abs(speed)
            self.signed_radius_m = math.copysign(self.signed_radius_m, self.signed_radius_m * speed)
        self._speed_m_s = min(self._speed_m_s, math.sqrt(MOST_M_S2 * abs(self.signed_radius_m)))
        self.centre_ned = np.array(here)
        if is_place(latitude, longitude, 0.0) and (latitude or longitude):
            self.centre_ned[:2] = state.origin.local(latitude, longitude)
        if math.isfinite(altitude) and abs(altitude) <= HIGHEST_M:
            self.centre_ned[2] = state.origin.altitude_of(altitude)
        north, east = (here - self.centre_ned)[:2].tolist()
        self._out_m = math.hypot(north, east)
        self._angle = math.atan2(east, north) if self._out_m > 0.1 else state.core.yaw + math.pi

    @property
    def yaw(self) -> float:
        """To the middle."""
        return math.remainder(self._angle + math.pi, 2.0 * math.pi)

    def move(self, follower: Follower, dt_s: float) -> tuple[float, float, float]:
        """Move the setpoint on; returns its acceleration, NED m/s²."""
        radius, turns = abs(self.signed_radius_m), math.copysign(1.0, self.signed_radius_m)
        off_m = radius - self._out_m
        outwards = min(max(off_m, -self._speed_m_s), self._speed_m_s)
        around = math.sqrt(max(self._speed_m_s**2 - outwards**2, 0.0)) * turns
        self._out_m += outwards * dt_s
        self._angle += around / max(self._out_m, SMALLEST_M) * dt_s
        c, s = math.cos(self._angle), math.sin(self._angle)
        climb = min(max(float(self.centre_ned[2] - follower.position[2]), -CLIMB_M_S), CLIMB_M_S)
        follower.position[:2] = self.centre_ned[:2] + self._out_m * np.array((c, s))
        follower.position[2] += climb * dt_s
        follower.velocity = np.array((outwards * c - around * s, outwards * s + around * c, climb))
        inwards = around**2 / max(self._out_m, SMALLEST_M)
        return -inwards * c, -inwards * s, 0.0
