"""Whether the vehicle is on the ground, told as PX4's land detector tells it: from thrust, speeds and rates, not truth."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

CONTACT_AFTER_US = 350_000
"""How long low thrust without movement lasts before ground contact is believed."""


class LandDetector:
    """Ground contact, then (LNDMC_TRIG_TIME later) landed. Leaving the ground is believed at once."""

    def __init__(self) -> None:
        self.landed = True
        self.ground_contact = True
        self._still_since_us = 0

    def update(
        self,
        time_us: int,
        armed: bool,
        thrust: float,
        velocity_ned: NDArray[np.float64],
        body_rate_frd: NDArray[np.float64],
        parameters: Mapping[str, float],
    ) -> None:
        """One look at thrust (0..1), velocity (3,) m/s and body rate (3,) rad/s."""
        if not armed:
            self.landed = self.ground_contact = True
            self._still_since_us = time_us
            return
        least, hover = parameters["MPC_THR_MIN"], parameters["MPC_THR_HOVER"]
        low_thrust = thrust < least + 0.3 * max(hover - least, 0.05)
        vx, vy, vz = velocity_ned.tolist()
        still = (
            abs(vz) < parameters["LNDMC_Z_VEL_MAX"] and math.hypot(vx, vy) < parameters["LNDMC_XY_VEL_MAX"]
        )
        limit = math.radians(parameters["LNDMC_ROT_MAX"])
        turning = math.hypot(*body_rate_frd[:2].tolist()) > limit
        if self.landed:
            if not low_thrust:
                self.landed = self.ground_contact = False
                self._still_since_us = time_us
            return
        if not (low_thrust and still) or (turning and not self.ground_contact):
            self._still_since_us = time_us
            self.ground_contact = False
            return
        waited = time_us - self._still_since_us
        self.ground_contact = waited >= CONTACT_AFTER_US
        if waited >= CONTACT_AFTER_US + parameters["LNDMC_TRIG_TIME"] * 1e6:
            self.landed = True
