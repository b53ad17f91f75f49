"""When the vehicle has left the ground.

Height by itself does not tell: with its motors shaking it on the ground, an estimate fed by GPS climbs by 0.3 m in two
seconds (seen on PX4's own simulator), at 0.1 to 0.2 m/s². A vehicle that a rising thrust lifts gains speed far more
quickly. So what counts is what was gained within `WINDOW_S`, in height and in speed, and only at a thrust that could carry
the weight: the law and its integrals must not run on the ground.
"""

from __future__ import annotations

from collections import deque

from companion.config.procedure import Procedure

WINDOW_S = 0.5


class LiftOffDetector:
    """Watches one lift-off; ask it once a state."""

    def __init__(self, settings: Procedure) -> None:
        self._settings = settings
        self._past: deque[tuple[float, float, float]] = deque()  # time, height, upward speed

    def has_left(self, time_s: float, height_m: float, velocity_up_m_s: float, hovers: float) -> bool:
        """Whether the vehicle flies.

        Args:
            time_s: the state's, autopilot's clock.
            height_m: any origin.
            velocity_up_m_s: world z.
            hovers: the thrust sent, in hover thrusts.
        """
        past, settings = self._past, self._settings
        if past and time_s <= past[-1][0]:
            return False
        past.append((time_s, height_m, velocity_up_m_s))
        while past[0][0] < time_s - WINDOW_S:
            past.popleft()
        gained_m = height_m - min(height for _, height, _ in past)
        gained_m_s = velocity_up_m_s - min(speed for _, _, speed in past)
        return (
            hovers >= settings.lift_off_least
            and gained_m > settings.lift_off_height_m
            and gained_m_s > settings.lift_off_speed_m_s
        )
