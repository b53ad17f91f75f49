"""Whether the vehicle is on the ground, told as PX4's land detector tells it: from thrust, speeds and rates, not truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CONTACT_AFTER_US = 350_000
"""How long low thrust without movement lasts before ground contact is believed."""


@dataclass(frozen=True, slots=True)
class Ground:
    """What the land detector found."""

    landed: bool
    contact: bool
    """Ground contact, which comes before `landed`."""


ON_GROUND, IN_AIR = Ground(True, True), Ground(False, False)


class LandDetector:
    """Ground contact, then (LNDMC_TRIG_TIME later) landed. Leaving the ground is believed at once."""

    def __init__(self) -> None:
        self._found = ON_GROUND
        self._still_since_us = 0

    def update(
        self,
        time_us: int,
        armed: bool,
        thrust: float,
        velocity_ned: NDArray[np.float64],
        body_rate_frd: NDArray[np.float64],
        parameters: Mapping[str, float],
    ) -> Ground:
        """One look at thrust (0..1), velocity (3,) m/s and body rate (3,) rad/s."""
        self._found = self._look(time_us, armed, thrust, velocity_ned, body_rate_frd, parameters)
        return self._found

    def _look(
        self,
        time_us: int,
        armed: bool,
        thrust: float,
        velocity_ned: NDArray[np.float64],
        body_rate_frd: NDArray[np.float64],
        parameters: Mapping[str, float],
    ) -> Ground:
        if not armed:
            return self._since(time_us, ON_GROUND)
        least, hover = parameters["MPC_THR_MIN"], parameters["MPC_THR_HOVER"]
        low_thrust = thrust < least + 0.3 * max(hover - least, 0.05)
        vx, vy, vz = velocity_ned.tolist()
        still = (
            abs(vz) < parameters["LNDMC_Z_VEL_MAX"] and math.hypot(vx, vy) < parameters["LNDMC_XY_VEL_MAX"]
        )
        limit = math.radians(parameters["LNDMC_ROT_MAX"])
        turning = math.hypot(*body_rate_frd[:2].tolist()) > limit
        if self._found.landed:
            return ON_GROUND if low_thrust else self._since(time_us, IN_AIR)
        if not (low_thrust and still) or (turning and not self._found.contact):
            return self._since(time_us, IN_AIR)
        waited = time_us - self._still_since_us
        landed = waited >= CONTACT_AFTER_US + parameters["LNDMC_TRIG_TIME"] * 1e6
        return Ground(landed, waited >= CONTACT_AFTER_US)

    def _since(self, time_us: int, found: Ground) -> Ground:
        """`found`, and the time of stillness begins anew."""
        self._still_since_us = time_us
        return found
