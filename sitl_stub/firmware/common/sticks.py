"""A pilot's sticks, whatever brings them: MANUAL_CONTROL, RC_CHANNELS_OVERRIDE, a radio."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

FULL_STICK = 1000.0
GESTURE_YAW, GESTURE_THROTTLE = 0.9, 0.05


@dataclass(slots=True)
class Sticks:
    """−1..1, throttle 0..1."""

    roll: float = 0.0
    pitch: float = 0.0
    """Forward positive."""
    yaw: float = 0.0
    throttle: float = 0.5
    last_us: int = -(10**12)
    """When MANUAL_CONTROL last came."""
    radio: bool = False
    """A pilot's radio is on: there whether or not MANUAL_CONTROL comes."""

    @property
    def now(self) -> tuple[float, float, float, float]:
        """Roll, pitch, yaw, throttle."""
        return self.roll, self.pitch, self.yaw, self.throttle

    def put(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        """Move all four."""
        self.roll, self.pitch, self.yaw, self.throttle = roll, pitch, yaw, throttle

    def take_manual_control(self, fields: dict[str, Any]) -> None:
        """MANUAL_CONTROL's x, y, r, z."""
        pitch, roll, yaw = (min(max(fields[name] / FULL_STICK, -1.0), 1.0) for name in ("x", "y", "r"))
        self.put(roll, pitch, yaw, min(max(fields["z"] / FULL_STICK, 0.0), 1.0))


class ArmingGesture:
    """Throttle down and yaw to the right, held for `held_us`: how a pilot arms by the sticks."""

    def __init__(self, held_us: int) -> None:
        self._held_us = held_us
        self._since_us: int | None = None
        self._done = False

    def made(self, sticks: Sticks, time_us: int) -> bool:
        """Whether it is complete at `time_us`; once for each time that it is held."""
        if not (sticks.yaw >= GESTURE_YAW and sticks.throttle <= GESTURE_THROTTLE):
            self._since_us, self._done = None, False
            return False
        if self._since_us is None:
            self._since_us = time_us
        if self._done or time_us - self._since_us < self._held_us:
            return False
        self._done = True
        return True
