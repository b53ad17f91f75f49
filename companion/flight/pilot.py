"""The pilot's sticks: whether they have been moved since we took over (RC_CHANNELS).

A mode change and a disarm say by themselves that the pilot wants the vehicle. Sticks do so on PX4 where COM_RC_OVERRIDE
lets them, on ArduPilot in GUIDED never; so they are watched here as well.
"""

from __future__ import annotations

from companion.mavlink.link import Message

STICKS = ("roll", "pitch", "throttle", "yaw")
"""Channels 1 to 4 as RCMAP_… and RC_MAP_… have them by default."""
TRAVEL_US = 1000.0
NO_SIGNAL = (0, 65535)
TWICE = 2  # messages in a row; one can be a glitch of the receiver


class Pilot:
    """Remembers where the sticks stood when we took over."""

    def __init__(self, share: float) -> None:
        """`share` of the full travel counts as moved."""
        self._share = share
        self._now: tuple[int, ...] | None = None
        self._rest: tuple[int, ...] | None = None
        self._watching = False
        self._moved = ""
        self._count = 0

    def take(self, message: Message) -> None:
        """Take an RC_CHANNELS; one without a receiver's signal is ignored."""
        sticks = (message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw)
        if message.chancount < len(STICKS) or any(value in NO_SIGNAL for value in sticks):
            return
        self._now = sticks
        if not self._watching:
            return
        if self._rest is None:
            self._rest = sticks
            return
        travels = [(value - rest) / TRAVEL_US for value, rest in zip(sticks, self._rest, strict=True)]
        far = [
            f"{name} by {travel:+.0%}"
            for name, travel in zip(STICKS, travels, strict=True)
            if abs(travel) > self._share
        ]
        self._count = self._count + 1 if far else 0
        if self._count >= TWICE:
            self._moved = ", ".join(far)

    def sticks_are_at_rest(self) -> None:
        """From here on a movement counts; the sticks stand where the newest message has them, or the next."""
        self._watching = True
        self._rest = self._now

    def moved_sticks(self) -> str:
        """Which sticks were moved and how far; empty when none."""
        return self._moved
