"""What a client sent, with all that its meaning rests on: enough to make the same points of it again from a log."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from companion.control.structs import Vector
from companion.live.mavlink_points import Surroundings

BEFORE_TRACKING = -1


@dataclass(frozen=True, slots=True)
class Heard:
    """One datagram or line."""

    time_s: float  # autopilot's clock
    data: bytes
    samples: int = BEFORE_TRACKING  # of the trajectory, between the beginning of tracking and this
    around: Surroundings = field(default_factory=lambda: Surroundings(None, 0.0, None, 0.0, None))
    moved_enu: Vector = field(default_factory=lambda: np.zeros(3))
    """By how much the estimator has moved its frame since the plan was laid out; the plan goes along, (3,) m."""
    turned_rad: float = 0.0

    def numbers(self) -> tuple[float, ...]:
        """All but time and data, as in the log (`NUMBERS`); NaN where something is not known."""
        around = self.around
        return (
            float(self.samples),
            *(around.position_enu.tolist() if around.position_enu is not None else [math.nan] * 3),
            around.yaw_rad,
            *(around.origin or [math.nan] * 3),
            around.ground_m,
            math.nan if around.system is None else float(around.system),
            float(around.body_frame_of_px4),
            *self.moved_enu.tolist(),
            self.turned_rad,
        )

    @classmethod
    def from_log(cls, time_s: float, numbers: tuple[float, ...], data: bytes) -> Heard:
        """The same again."""
        samples, x, y, z, yaw_rad, latitude, longitude, altitude, ground_m, system, of_px4, *moved = numbers
        around = Surroundings(
            None if math.isnan(x) else np.array([x, y, z]),
            yaw_rad,
            None if math.isnan(latitude) else (latitude, longitude, altitude),
            ground_m,
            None if math.isnan(system) else int(system),
            bool(of_px4),
        )
        return cls(time_s, data, int(samples), around, np.array(moved[:3]), moved[3])
