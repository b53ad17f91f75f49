"""How a client's clock stands to the autopilot's: the quickest of its messages tells, all others were only later."""

from __future__ import annotations

import math
from collections import deque

WINDOW_S = 5.0
RESTART_S = 1.0
"""A clock that steps back, or ahead of its arrivals, by more than this was started anew."""


class ClientClock:
    """Turns the client's times into the autopilot's, without the network's jitter."""

    def __init__(self) -> None:
        self._gaps: deque[tuple[float, float]] = deque()  # arrival, arrival − time; gaps ascending

    def take(self, time_s: float, arrived_s: float) -> float:
        """The autopilot's time of `time_s` (client's clock; NaN: its arrival), arrived at `arrived_s`."""
        if math.isnan(time_s):
            return arrived_s
        gap_s = arrived_s - time_s
        if self._gaps and abs(gap_s - self._gaps[0][1]) > RESTART_S:
            self._gaps.clear()
        while self._gaps and self._gaps[-1][1] >= gap_s:
            self._gaps.pop()
        self._gaps.append((arrived_s, gap_s))
        while self._gaps[0][0] < arrived_s - WINDOW_S:
            self._gaps.popleft()
        return time_s + self._gaps[0][1]
