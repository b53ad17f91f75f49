"""The last gate before the wire: a setpoint that is not fit to be sent is not sent, whatever made it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.control.structs import ControlLevel, Setpoint, Vector

UNIT_TOLERANCE = 1e-3  # of the quaternion's length; both autopilots act oddly on others
RATE_TOLERANCE = 1.01  # the law's own bound is exact, rounding is not


@dataclass(frozen=True, slots=True)
class SetpointGate:
    """What may go out. `refusal` is asked for every setpoint, at every level."""

    body_rate_max_rad_s: Vector  # (3,) of the profile

    def refusal(self, setpoint: Setpoint, thrust: float, controls: Vector | None = None) -> str:
        """Why a setpoint may not be sent, in numbers; empty when it may.

        Args:
            setpoint: what the law, or the lift-off, asks for.
            thrust: the collective that would be sent, 0..1.
            controls: (4,) actuator controls that would be sent, at the actuator level.
        """
        if not 0.0 <= thrust <= 1.0:  # NaN fails this too
            return f"thrust {thrust:g} is not within 0..1"
        if not math.isfinite(setpoint.thrust_newton):
            return f"thrust {setpoint.thrust_newton:g} N is not a number"
        if setpoint.level is ControlLevel.ACTUATOR:
            if controls is None or not all(-1.0 <= value <= 1.0 for value in controls.tolist()):
                return f"actuator controls {controls} are not within -1..1"
            return ""
        if setpoint.level is ControlLevel.ATTITUDE:
            w, x, y, z = setpoint.quaternion_wxyz.tolist()
            length = math.sqrt(w * w + x * x + y * y + z * z)
            if not abs(length - 1.0) <= UNIT_TOLERANCE:
                return f"attitude setpoint has length {length:g}, not 1"
        rates = setpoint.body_rate_flu.tolist()
        limits = self.body_rate_max_rad_s.tolist()
        for rate, limit in zip(rates, limits, strict=True):
            if not abs(rate) <= limit * RATE_TOLERANCE:
                shown = np.degrees(setpoint.body_rate_flu).round(1).tolist()
                return f"body rate setpoint {shown} °/s is beyond the profile's limits"
        return ""
