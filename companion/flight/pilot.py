"""The pilot's sticks: whether somebody has moved them since we took over, and whether there is a transmitter (RC_CHANNELS).

A mode change and a disarm say by themselves that the pilot wants the vehicle. Sticks do so on PX4 where COM_RC_OVERRIDE
lets them, on ArduPilot in GUIDED never; so they are watched here as well. A lost transmitter moves sticks, too, and is no
pilot: receivers let the throttle fall below its travel, tell no signal, go to preset positions, or repeat the last ones.
"""

from __future__ import annotations

import math

from companion.mavlink.link import Message

STICKS = ("roll", "pitch", "throttle", "yaw")
"""Channels 1 to 4 as RCMAP_… and RC_MAP_… have them by default."""
TRAVEL_US = 1000.0
NO_SIGNAL = (0, 65535)
TWICE = 2  # messages in a row; one can be a glitch of the receiver
THROTTLE_LOST_US = 975  # FS_THR_VALUE as ArduPilot ships; transmitters end at 988 or more
LOST_S = 0.5  # a receiver that loses a few frames has not lost its transmitter
PRESET_S = 1.0
MIDDLE_US = 1500
GESTURE_SHARE = 0.25  # of the full travel, to one side: less is a trim
STILL_S = 0.5
STILL_US = 2.0  # less is no movement of a thumb
_THROTTLE = STICKS.index("throttle")


class Pilot:
    """Remembers where the sticks stood when we took over. Times are the autopilot's."""

    def __init__(self, share: float) -> None:
        """`share` of the full travel counts as moved."""
        self._share = share
        self._now: tuple[int, ...] | None = None
        self._rest: tuple[int, ...] | None = None
        self._watching = False
        self._moved = ""
        self._count = 0
        self._rssi_known = self._was_healthy = False
        self._lost: tuple[float, str] | None = None  # since when, by which sign
        self._jumped: tuple[float, tuple[int, ...]] | None = None  # when the sticks jumped, and to where
        self.alive_s = -math.inf
        """When the sticks were last seen to move."""

    def take(self, message: Message, time_s: float, receiver_healthy: bool | None = None) -> None:
        """Take an RC_CHANNELS that came at `time_s`, with SYS_STATUS' word on the receiver (None: not told)."""
        sticks = (message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw)
        sign = self._sign_of_loss(message, sticks, receiver_healthy)
        if sign:
            if self._now is not None and self._lost is None:  # who was never there is not lost
                self._lost = time_s, sign
            self._count, self._jumped = 0, None
            return
        before, self._now = self._now, sticks
        if before is not None and _apart_us(before, sticks) > STILL_US:
            self.alive_s = time_s
        if not self._watching:
            self._lost = None
            return
        if self._rest is None:
            self._rest = sticks
        travels = [(value - rest) / TRAVEL_US for value, rest in zip(sticks, self._rest, strict=True)]
        far = [abs(travel) > self._share for travel in travels]
        if self._is_preset(time_s, before, sticks, far):
            return
        self._lost = None
        self._count = self._count + 1 if any(far) and self._jumped is None else 0
        if self._count >= TWICE:
            self._moved = ", ".join(
                f"{name} by {travel:+.0%}"
                for name, travel, moved in zip(STICKS, travels, far, strict=True)
                if moved
            )

    def _sign_of_loss(self, message: Message, sticks: tuple[int, ...], healthy: bool | None) -> str:
        if message.chancount < len(STICKS) or any(value in NO_SIGNAL for value in sticks):
            return "no signal in RC_CHANNELS"
        if sticks[_THROTTLE] < THROTTLE_LOST_US:
            return f"throttle at {sticks[_THROTTLE]} µs"
        self._rssi_known = self._rssi_known or message.rssi > 0  # one that always says 0 does not measure
        if self._rssi_known and message.rssi == 0:
            return "signal strength 0"
        self._was_healthy = self._was_healthy or healthy is True
        if self._was_healthy and healthy is False:
            return "receiver unhealthy in SYS_STATUS"
        return ""

    def _is_preset(
        self, time_s: float, before: tuple[int, ...] | None, sticks: tuple[int, ...], far: list[bool]
    ) -> bool:
        """Whether the sticks stand where no thumb has put them.

        From one message to the next the throttle alone has gone far, or all four to one value, and since then not one has
        stirred: a receiver's preset positions. Whoever moves roll, pitch or yaw otherwise is a pilot at once; whoever moves
        anything within PRESET_S, too.
        """
        assert self._rest is not None
        alone = far == [name == "throttle" for name in STICKS]
        if not (alone or (any(far) and len(set(sticks)) == 1)):
            self._jumped = None
        elif self._jumped is None:
            if self._count == 0 and before is not None and _apart_us(before, self._rest) <= STILL_US:
                self._jumped = time_s, sticks
        elif _apart_us(self._jumped[1], sticks) > STILL_US:
            self._jumped, self._count = None, TWICE
        elif time_s - self._jumped[0] >= PRESET_S:
            self._lost = self._lost or (self._jumped[0], f"sticks jumped to {sticks} µs and stand still")
            return True
        return False

    def lets_go(self, time_s: float) -> bool:
        """Whether no stick has moved for STILL_S, and yaw is not held to one side, as it is to arm; True without sticks."""
        yaw_us = self._now[STICKS.index("yaw")] if self._now is not None else MIDDLE_US
        return time_s - self.alive_s >= STILL_S and abs(yaw_us - MIDDLE_US) < GESTURE_SHARE * TRAVEL_US

    def sticks_are_at_rest(self) -> None:
        """From here on a movement counts; the sticks stand where the newest message has them, or the next."""
        self._watching = True
        self._rest = self._now

    def moved_sticks(self) -> str:
        """Which sticks were moved and how far; empty when none."""
        return self._moved

    def lost_transmitter(self, time_s: float) -> str:
        """By which sign the transmitter is lost; empty while it is there, and where there never was one."""
        return self._lost[1] if self._lost is not None and time_s - self._lost[0] >= LOST_S else ""


def _apart_us(one: tuple[int, ...], other: tuple[int, ...]) -> float:
    return max(abs(a - b) for a, b in zip(one, other, strict=True))
