"""A circle flown at constant speed, with the vehicle looking one way or ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.config.errors import UserError
from companion.control.structs import Reference
from companion.reference.trajectory import held_outside


@dataclass(frozen=True, slots=True)
class Circle:
    """Anticlockwise (seen from above) about the origin, from (radius, 0); already moving at t = 0.

    `look_ahead` turns the vehicle with the path: yaw is then the direction of flight plus `yaw_rad`.
    """

    radius_m: float = 1.0
    speed_m_s: float = 1.0
    height_m: float = 1.0
    yaw_rad: float = 0.0
    look_ahead: bool = False
    clockwise: bool = False
    duration_s: float = math.inf

    def __post_init__(self) -> None:
        """Refuse what is no circle."""
        for name in ("radius_m", "speed_m_s", "duration_s"):
            if not getattr(self, name) > 0.0:
                raise UserError(f"circle: {name} is {getattr(self, name):g}; it has to be above 0")

    def sample(self, time_s: float) -> Reference:
        """Return the reference at `time_s`; outside `[0, duration_s]` it stands still at that end."""
        if not 0.0 <= time_s <= self.duration_s:
            return held_outside(self, time_s)
        turning = self.speed_m_s / self.radius_m
        if self.clockwise:
            turning = -turning
        angle = turning * time_s
        x = self.radius_m * math.cos(angle)
        y = self.radius_m * math.sin(angle)
        w2 = turning * turning
        ahead = angle + math.copysign(math.pi / 2.0, turning)
        return Reference(
            np.array((x, y, self.height_m)),
            np.array((-turning * y, turning * x, 0.0)),
            np.array((-w2 * x, -w2 * y, 0.0)),
            np.array((turning * w2 * y, -turning * w2 * x, 0.0)),
            np.array((w2 * w2 * x, w2 * w2 * y, 0.0)),
            self.yaw_rad + (ahead if self.look_ahead else 0.0),
            turning if self.look_ahead else 0.0,
            0.0,
        )
