"""A step of position or yaw and back, to see how a vehicle answers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.config.errors import UserError
from companion.control.structs import Reference
from companion.reference.trajectory import resting

LARGEST_STEP_M = 2.0  # a law with a gain of a few m/s per m asks for full tilt from there on


@dataclass(frozen=True, slots=True)
class Step:
    """Stand at (0, 0, height); from `at_s` on offset by (x, y, z) and yaw; from `at_s + hold_s` on back.

    The jump is meant: `jumps_by_design` tells the feasibility check so. Derivatives are zero throughout.
    """

    x_m: float = 0.5
    y_m: float = 0.0
    z_m: float = 0.0
    yaw_rad: float = 0.0
    height_m: float = 1.0
    at_s: float = 2.0
    hold_s: float = 5.0
    settle_s: float = 5.0

    def __post_init__(self) -> None:
        """Refuse steps that are no test but a collision."""
        size = math.hypot(self.x_m, self.y_m, self.z_m)
        if not size <= LARGEST_STEP_M:
            raise UserError(
                f"step: {size:.3g} m is more than {LARGEST_STEP_M:g} m; take waypoints for longer ways"
            )
        for name in ("at_s", "hold_s", "settle_s"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise UserError(f"step: {name} is {getattr(self, name):g}; it must not be below 0")
        if not self.duration_s > 0.0:
            raise UserError("step: at_s, hold_s and settle_s are all 0; nothing would be flown")

    @property
    def jumps_by_design(self) -> bool:
        """True: this trajectory is there to jump."""
        return True

    @property
    def duration_s(self) -> float:
        """Length in s."""
        return self.at_s + self.hold_s + self.settle_s

    def sample(self, time_s: float) -> Reference:
        """Return the reference at `time_s`. Raises ValueError for NaN."""
        if math.isnan(time_s):
            raise ValueError("trajectory sampled at time NaN")
        out = self.at_s <= time_s < self.at_s + self.hold_s
        offset = (self.x_m, self.y_m, self.height_m + self.z_m) if out else (0.0, 0.0, self.height_m)
        return resting(np.array(offset), self.yaw_rad if out else 0.0)
