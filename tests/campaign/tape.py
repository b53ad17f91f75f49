"""What is recorded beside the flight, in memory that the processes of one flight share.

The stub's process writes the black box: the vehicle as it truly is, straight from the physics. The companion's writes its
ticks: when it had dealt with which simulated instant. Whoever dies, the other side's notes remain.
"""

from __future__ import annotations

import mmap

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

BOX_ROWS, BOX_WIDTH = 20_000, 16
TICK_ROWS, TICK_WIDTH = 80_000, 3
_HEAD = 8

TIME, ARMED, MODE, POSITION, VELOCITY, QUATERNION, BODY_RATE = (
    0,
    1,
    2,
    slice(3, 6),
    slice(6, 9),
    slice(9, 13),
    slice(13, 16),
)
"""Columns of the black box: s, 0/1, custom mode, NED m, NED m/s, FRD to NED, FRD rad/s."""
TICK_TIME, TICK_WALL, TICK_CPU = 0, 1, 2
"""Columns of the ticks: simulated s, monotonic s, process time s."""


class Tape:
    """One flight's notes; make it before the processes are forked."""

    def __init__(self) -> None:
        numbers = _HEAD + BOX_ROWS * BOX_WIDTH + TICK_ROWS * TICK_WIDTH
        self._memory = np.frombuffer(mmap.mmap(-1, 8 * numbers), np.float64)
        self._head = self._memory[:_HEAD]
        box_end = _HEAD + BOX_ROWS * BOX_WIDTH
        self._box = self._memory[_HEAD:box_end].reshape(BOX_ROWS, BOX_WIDTH)
        self._ticks = self._memory[box_end:].reshape(TICK_ROWS, TICK_WIDTH)
        self._head[:] = 0.0
        self._head[2] = np.nan

    def note_vehicle(self, row: FloatArray) -> None:
        """Add a row (BOX_WIDTH,) to the black box; a full one keeps its beginning."""
        count = int(self._head[0])
        if count < BOX_ROWS:
            self._box[count] = row
            if row[ARMED] and np.isnan(self._head[2]):
                self._head[2] = row[TIME]
            self._head[0] = count + 1

    def note_tick(self, time_s: float, wall_s: float, cpu_s: float) -> None:
        """Add a tick of the companion."""
        count = int(self._head[1])
        if count < TICK_ROWS:
            self._ticks[count] = (time_s, wall_s, cpu_s)
            self._head[1] = count + 1

    @property
    def companion_gone(self) -> bool:
        """Whether the companion's process has ended; written by who started it."""
        return bool(self._head[3])

    @companion_gone.setter
    def companion_gone(self, gone: bool) -> None:
        self._head[3] = float(gone)

    @property
    def struck_at_s(self) -> float:
        """When the end of a cell of the hand-over matrix happened, s of simulated time; 0 before."""
        return float(self._head[4])

    @struck_at_s.setter
    def struck_at_s(self, time_s: float) -> None:
        self._head[4] = time_s

    @property
    def order(self) -> int:
        """What the stub's process is asked to do next (`instruments.obey`); 0 nothing."""
        return int(self._head[5])

    @order.setter
    def order(self, number: int) -> None:
        self._head[5] = number

    @property
    def armed_at_s(self) -> float:
        """When the vehicle was first armed, s of simulated time; NaN before."""
        return float(self._head[2])

    @property
    def now_s(self) -> float:
        """Newest time in the black box, s of simulated time; 0 before its first row."""
        count = int(self._head[0])
        return float(self._box[count - 1, TIME]) if count else 0.0

    @property
    def box(self) -> FloatArray:
        """(n, BOX_WIDTH) so far."""
        return self._box[: int(self._head[0])]

    @property
    def ticks(self) -> FloatArray:
        """(n, TICK_WIDTH) so far."""
        return self._ticks[: int(self._head[1])]
