"""Ground contact while tracking: the height estimate may be wrong by more than the plan's lowest point is high.

A vehicle that stands where its law believes it flies is pushed over by its own setpoints. Three signs, each its own: the
land detector says ground (EXTENDED_SYS_STATE); part of the weight is carried by something else than thrust,
s = (Δv_z / Δt − g (T cos θ / T_hover − 1)) / g over WINDOW_S; and it does not turn although it is asked to.
"""

from __future__ import annotations

import math
from collections import deque

from companion.autopilot.adapter import VehicleStatus
from companion.mavlink.link import mav

WINDOW_S = 0.5
SETTLED_S = 5.0  # after lift-off: until then the hover thrust is not known well enough
BELOW_M = 2.0  # above the place of take-off, by the estimate: higher up it is a gust, or a load that fell off
ASKED_DEG, TURNED_DEG = (
    10.0,
    1.5,
)  # off what is asked for all the time, and turned by less: a rotor turns it by more
GRAVITY = 9.81
_LANDED: int = mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
_Axis = tuple[float, float, float]


class GroundContact:
    """Asked once a state, from lift-off on."""

    def __init__(self, since_s: float | None = None) -> None:
        """`since_s`: when it lifted off, where that was before the first look."""
        self._since_s = since_s
        self._was_in_air = False
        self._seen: deque[tuple[float, float, float, _Axis, float]] = deque()

    def support(
        self,
        time_s: float,
        height_m: float,
        velocity_up_m_s: float,
        thrust_hovers: float,
        axis: _Axis,
        attitude_error_deg: float,
        status: VehicleStatus,
    ) -> float | None:
        """Share of the weight that the ground carries, 1 where other signs say ground; None where nothing is known.

        Args:
            time_s: the state's, autopilot's clock.
            height_m: above the place of take-off, by the estimate.
            velocity_up_m_s: world z.
            thrust_hovers: the thrust asked for, in hover thrusts.
            axis: the vehicle's thrust axis in world axes.
            attitude_error_deg: between that and the one asked for.
            status: what the land detector says.
        """
        self._since_s = time_s if self._since_s is None else self._since_s
        landed, seen = status.landed_state, self._seen
        self._was_in_air = self._was_in_air or landed == mav.MAV_LANDED_STATE_IN_AIR
        seen.append((time_s, velocity_up_m_s, thrust_hovers * axis[2], axis, attitude_error_deg))
        while seen[0][0] < time_s - WINDOW_S - 1e-6:
            seen.popleft()
        span_s = time_s - seen[0][0]
        if time_s - self._since_s < SETTLED_S or height_m > BELOW_M or span_s < 0.8 * WINDOW_S:
            return None
        fresh = time_s - status.heard_s.get(_LANDED, -math.inf) < 1.0
        if self._was_in_air and fresh and landed == mav.MAV_LANDED_STATE_ON_GROUND:
            return 1.0
        first = seen[0][3]
        turned = math.degrees(
            math.acos(max(-1.0, min(1.0, sum(a * b for a, b in zip(first, axis, strict=True)))))
        )
        if turned < TURNED_DEG and min(item[4] for item in seen) > ASKED_DEG:
            return 1.0
        lift = sum(item[2] for item in seen) / len(seen)
        carried = (velocity_up_m_s - seen[0][1]) / (GRAVITY * span_s) - (lift - 1.0)
        return min(carried, 1.0 - lift)  # the ground cannot carry more than thrust leaves
