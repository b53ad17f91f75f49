"""What the operating system can do for a control thread, asked for before arming. What it refuses is said, not hidden."""

from __future__ import annotations

import ctypes
import gc
import os

FIFO_PRIORITY = 50
_MCL_CURRENT_AND_FUTURE = 3


def prepare() -> list[str]:
    """Real-time scheduling, locked memory, frozen collector. Returns one line for each thing that was refused."""
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except (OSError, AttributeError):
        refused.append(
            "no SCHED_FIFO (needs CAP_SYS_NICE or an rtprio limit): other programs can delay setpoints"
        )
    try:
        if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT_AND_FUTURE) != 0:
            refused.append(
                "memory not locked (needs CAP_IPC_LOCK or a memlock limit): a page fault can delay setpoints"
            )
    except (OSError, AttributeError):
        refused.append("memory not locked: this system has no mlockall")
    freeze_collector()
    return refused


def freeze_collector() -> None:
    """Take all that is alive now out of the garbage collector's sight, so that no pass over it happens in flight."""
    gc.collect()
    gc.freeze()
