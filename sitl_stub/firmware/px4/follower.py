"""A setpoint that travels to a target: limited speed and acceleration, simpler than PX4's jerk-limited profile."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(slots=True)
class Follower:
    """A setpoint that travels to a target under limits of speed and acceleration, horizontal and vertical apart."""

    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def start(self, position: NDArray[np.float64], velocity: NDArray[np.float64]) -> None:
        """Begin at a place, moving."""
        self.position = np.array(position)
        self.velocity = np.array(velocity)

    def move(
        self,
        target: NDArray[np.float64],
        speed_xy: float,
        speed_up: float,
        speed_down: float,
        acceleration_xy: float,
        acceleration_z: float,
        dt_s: float,
    ) -> None:
        """One step towards `target` (3,) NED."""
        offset = target[:2] - self.position[:2]
        distance = math.hypot(float(offset[0]), float(offset[1]))
        wanted = np.zeros(2)
        if distance > 1e-6:
            # the speed from which half the allowed deceleration stops in the distance left
            wanted = (
                offset
                / distance
                * min(speed_xy, math.sqrt(acceleration_xy * distance), distance / (2.0 * dt_s))
            )
        change = wanted - self.velocity[:2]
        size = math.hypot(float(change[0]), float(change[1]))
        most = acceleration_xy * dt_s
        self.velocity[:2] += change if size <= most else change / size * most
        drop = float(target[2] - self.position[2])
        limit = speed_down if drop > 0 else speed_up
        wanted_z = math.copysign(
            min(limit, math.sqrt(acceleration_z * abs(drop)), abs(drop) / (2.0 * dt_s)), drop
        )
        change_z = wanted_z - float(self.velocity[2])
        self.velocity[2] += min(max(change_z, -acceleration_z * dt_s), acceleration_z * dt_s)
        self.position += self.velocity * dt_s
