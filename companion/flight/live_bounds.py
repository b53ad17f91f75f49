"""Where references of another program may lead: inside the fence with the margins that the supervisor asks for, not into
the ground, and not harder than the vehicle can fly. Refused in words as they come, so that the supervisor need not land."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.config.safety import Fence, Reaction, SafetyLimits
from companion.control.law import ControlLaw
from companion.control.structs import Vector
from companion.flight.fence import horizontal_margin
from companion.reference.trajectory import Placed, Trajectory, placed

LOWEST_M = 0.25


@dataclass(frozen=True, slots=True)
class LiveBounds:
    """Called with a position (3,) m and an acceleration (3,) m/s² in own axes: why not; empty where it may be flown."""

    fence: Fence
    fence_margin_m: float
    ceiling_margin_m: float
    home_enu: Vector  # (3,) m, the place of take-off
    lowest_m: float  # above it
    origin_enu: Vector  # (3,) m, of the trajectory's own axes
    heading_rad: float
    tilt_max_rad: float
    lift_min_m_s2: float  # thrust by mass
    lift_max_m_s2: float
    gravity_m_s2: float

    def __call__(self, position: Vector, acceleration: Vector) -> str:
        """See the class."""
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        x, y, z = position.tolist()
        east, north, up = (
            np.array((c * x - s * y, s * x + c * y, z)) + self.origin_enu - self.home_enu
        ).tolist()
        short_m = self.fence_margin_m - horizontal_margin(self.fence, east, north)
        if short_m > 0.0:
            return f"outside the fence: by {short_m:.2f} m (flight.safety.fence)"
        if self.fence.height_max_m - up < self.ceiling_margin_m:
            return f"above the ceiling: {up:.2f} m high (flight.safety.fence.height_max_m)"
        if up < self.lowest_m:
            return f"too low: {up:.2f} m above the place of take-off, {self.lowest_m:.2f} m is the least"
        ax, ay, az = acceleration.tolist()
        sideways, upwards = math.hypot(ax, ay), az + self.gravity_m_s2
        tilt_rad, lift = math.atan2(sideways, upwards), math.hypot(sideways, upwards)
        if tilt_rad > self.tilt_max_rad:
            return (
                f"too hard: {sideways:.1f} m/s² is a tilt of {math.degrees(tilt_rad):.0f}°, "
                f"limit {math.degrees(self.tilt_max_rad):.0f}°"
            )
        if not self.lift_min_m_s2 <= lift <= self.lift_max_m_s2:
            return f"too hard: {lift:.1f} m/s² of thrust, of {self.lift_min_m_s2:.1f} to {self.lift_max_m_s2:.1f}"
        return ""

    def as_fields(self) -> dict[str, Any]:
        """What `from_fields` and the flight's settings make it of again."""
        return {
            "home_enu": self.home_enu.tolist(),
            "lowest_m": self.lowest_m,
            "origin_enu": self.origin_enu.tolist(),
            "heading_rad": self.heading_rad,
            "tilt_max_rad": self.tilt_max_rad,
            "lift_min_m_s2": self.lift_min_m_s2,
            "lift_max_m_s2": self.lift_max_m_s2,
            "gravity_m_s2": self.gravity_m_s2,
        }


def bounds_of(
    safety: SafetyLimits, law: ControlLaw, trajectory: Trajectory, home_enu: Vector, height_accuracy_m: float
) -> LiveBounds:
    """The bounds of a flight. `trajectory` is the live one as it is laid out."""
    where = trajectory if isinstance(trajectory, Placed) else placed(trajectory, np.zeros(3), 0.0)
    p = law.parameters
    mass_kg = float(p.mass_estimate)
    fields = {
        "home_enu": home_enu,
        "lowest_m": max(LOWEST_M, height_accuracy_m),
        "origin_enu": where.origin_enu,
        "heading_rad": where.heading_rad,
        "tilt_max_rad": float(p.tilt_max),
        "lift_min_m_s2": float(p.thrust_min) / mass_kg,
        "lift_max_m_s2": float(p.thrust_max) / mass_kg,
        "gravity_m_s2": float(p.gravity),
    }
    return bounds_from(safety, fields)


def bounds_from(safety: SafetyLimits, fields: dict[str, Any]) -> LiveBounds:
    """The bounds of a logged flight, from what `as_fields` gave."""
    known: dict[str, Any] = {
        name: np.array(value) if name.endswith("_enu") else value for name, value in fields.items()
    }
    return LiveBounds(
        fence=safety.fence,
        fence_margin_m=_margin(safety, "fence_margin_m"),
        ceiling_margin_m=_margin(safety, "ceiling_margin_m"),
        **known,
    )


def _margin(safety: SafetyLimits, name: str) -> float:
    """From where on the supervisor does more than to warn."""
    rungs = safety.ladder(name).rungs()
    return max((at for reaction, at, _ in rungs if reaction >= Reaction.HOLD), default=0.0)
