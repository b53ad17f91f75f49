"""Standing still at a point."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.control.structs import Reference
from companion.reference.trajectory import resting


@dataclass(frozen=True, slots=True)
class Hold:
    """Stand at a point, in the trajectory's own axes."""

    x_m: float = 0.0
    y_m: float = 0.0
    height_m: float = 1.0
    yaw_rad: float = 0.0
    duration_s: float = math.inf

    def sample(self, time_s: float) -> Reference:
        """Return the point, at any time. Raises ValueError for NaN."""
        if math.isnan(time_s):
            raise ValueError("trajectory sampled at time NaN")
        return resting(np.array((self.x_m, self.y_m, self.height_m)), self.yaw_rad)
