"""What the operating system can do for a control thread, asked for before arming, and a watch over it from outside.

What the system refuses is said, not hidden.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

FIFO_PRIORITY = 50
YOUNG_OBJECTS = 5000  # a pass over so many takes 0.3 ms
_USUAL_THRESHOLDS = gc.get_threshold()
SWITCH_INTERVAL_S = 5e-4
_USUAL_SWITCH_INTERVAL_S = sys.getswitchinterval()
_MCL_CURRENT_AND_FUTURE = 3


def prepare() -> list[str]:
    """Real-time scheduling, locked memory, frozen collector. Returns one line for each thing that was refused."""
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except (OSError, AttributeError):
        refused.append(
            "no SCHED_FIFO (needs CAP_SYS_NICE or an rtprio limit: scripts/install): other programs can delay setpoints"
        )
    try:
        if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT_AND_FUTURE) != 0:
            refused.append(
                "memory not locked (needs CAP_IPC_LOCK or a memlock limit: scripts/install): "
                "a page fault can delay setpoints"
            )
    except (OSError, AttributeError):
        refused.append("memory not locked: this system has no mlockall")
    steady_interpreter()
    return refused


def restore() -> None:
    """Take `prepare` back, for a process that goes on after its flight: neither it nor what it starts may starve others."""
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).munlockall()
    gc.unfreeze()
    gc.set_threshold(*_USUAL_THRESHOLDS)
    sys.setswitchinterval(_USUAL_SWITCH_INTERVAL_S)


def steady_interpreter() -> None:
    """Keep Python's own housekeeping, and our other threads, out of the control thread's way.

    All that is alive now is taken out of the garbage collector's sight, so that no pass over it happens in flight; and
    it looks at what is new less often: a simulation in lockstep has a thousand records wait for the log's writer, and to
    go through them after every 700 costs more than anything it finds. A thread that has the interpreter gives it up
    after SWITCH_INTERVAL_S instead of 5 ms: the log's writer works for a few milliseconds at a time, and a state that
    comes meanwhile would wait for it.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG_OBJECTS)
    sys.setswitchinterval(SWITCH_INTERVAL_S)


class LoopWatchdog:
    """Notices from a thread of its own that the flight's thread has not come round for `limit_s` of our clock.

    Our setpoints are sent by the flight's thread only, so a loop that hangs sends nothing and the autopilot's own
    offboard-loss action follows. What is left to do is to say so while it hangs, and to see that what it had begun before
    is not sent when it wakes: `tripped` stays set until the flight's thread has dealt with it (`reset`).
    """

    def __init__(self, limit_s: float, on_stall: Callable[[float], None]) -> None:
        """`on_stall` is called in the watchdog's thread, once per stall, with its length so far in s."""
        self.limit_s = limit_s
        self.tripped = False
        self.longest_s = 0.0
        self._on_stall = on_stall
        self._beat_s = time.monotonic()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to watch."""
        self.beat()
        self._thread = threading.Thread(target=self._watch, name="loop watchdog", daemon=True)
        self._thread.start()

    def beat(self) -> None:
        """The flight's thread has come round."""
        now_s = time.monotonic()
        if now_s - self._beat_s > self.longest_s:
            self.longest_s = now_s - self._beat_s
        self._beat_s = now_s

    def reset(self) -> None:
        """The flight's thread knows that it stood still."""
        self.longest_s = 0.0
        self.tripped = False

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def _watch(self) -> None:
        while not self._stop.wait(self.limit_s / 10.0):
            still_s = time.monotonic() - self._beat_s
            if still_s > self.limit_s and not self.tripped:
                self.tripped = True
                self._on_stall(still_s)
