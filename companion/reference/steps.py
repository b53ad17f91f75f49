"""Small steps about one place, forward, to the left, up and in heading, there and back: they tell a response."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.config.errors import UserError
from companion.control.structs import Reference
from companion.reference.trajectory import resting

LARGEST_M = 0.7
"""A step is position error at once: beyond 0.8 m the supervisor warns."""
_DIRECTIONS = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.6, 0.0), (0.0, 0.0, 0.0, 1.0))
"""Of position, in sizes, and of heading."""


@dataclass(frozen=True, slots=True)
class Steps:
    """Stand at (0, 0, height); step by `size_m` forward, left, up (0.6 of it) and by `yaw_rad`, `rounds` times.

    The jumps are meant: `jumps_by_design` tells the feasibility check so. Derivatives are zero throughout. It stays within
    `size_m` of where it stands, but for the overshoot of whoever flies it.
    """

    size_m: float = 0.5
    yaw_rad: float = 0.5
    height_m: float = 1.5
    hold_s: float = 2.0
    rounds: float = 2.0

    def __post_init__(self) -> None:
        """Refuse what is no small step."""
        if not 0.05 <= self.size_m <= LARGEST_M:
            raise UserError(f"steps: size_m is {self.size_m:g}; give 0.05 to {LARGEST_M:g} m")
        if not abs(self.yaw_rad) <= 1.0:
            raise UserError(f"steps: yaw_rad is {self.yaw_rad:g}; give up to 1 rad (57°)")
        if not (0.5 <= self.hold_s <= 60.0 and 1.0 <= self.rounds <= 20.0):
            raise UserError("steps: hold_s has to be 0.5 to 60 s, rounds 1 to 20")

    @property
    def jumps_by_design(self) -> bool:
        """True: this trajectory is there to jump."""
        return True

    @property
    def duration_s(self) -> float:
        """Length in s: each direction there and back, and standing still before."""
        return self.hold_s * (1.0 + 2.0 * len(_DIRECTIONS) * int(self.rounds))

    def sample(self, time_s: float) -> Reference:
        """Return the reference at `time_s`. Raises ValueError for NaN."""
        if math.isnan(time_s):
            raise ValueError("trajectory sampled at time NaN")
        index = math.floor(time_s / self.hold_s) - 1
        x = y = z = yaw = 0.0
        if 0 <= index < 2 * len(_DIRECTIONS) * int(self.rounds) and index % 2 == 0:
            x, y, z, yaw = _DIRECTIONS[index // 2 % len(_DIRECTIONS)]
        place = np.array((x, y, z)) * self.size_m + np.array((0.0, 0.0, self.height_m))
        return resting(place, yaw * self.yaw_rad)
