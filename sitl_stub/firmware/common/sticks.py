"""A pilot's sticks, whatever brings them: MANUAL_CONTROL, RC_CHANNELS_OVERRIDE, a radio."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

FULL_STICK = 1000.0


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
