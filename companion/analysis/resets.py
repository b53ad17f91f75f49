"""The truth carried along with the estimator's resets: a reset moves the plan, not the vehicle, and is no error of either.

The flight logs each reset that moved its plan with the jump's vector (event `estimator_reset`). From then on the reference
lies in the moved frame, and the truth, which was never moved, has to be brought there before the two are compared.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from companion.flightlog.reader import FlightRecord, NumericChannel

Array = NDArray[np.float64]


def resets(record: FlightRecord) -> tuple[Array, Array, Array]:
    """Times (n,) s, jumps (n, 3) m ENU and turns of the heading (n,) rad of the resets that moved the plan."""
    events = record.events_of("estimator_reset")
    times = np.array([event.time_s for event in events], dtype=np.float64)
    jumps = np.array([event.fields["jump_enu"] for event in events], dtype=np.float64).reshape(-1, 3)
    turns = np.array([event.fields["yaw_jump_rad"] for event in events], dtype=np.float64)
    return times, jumps, turns


def carried(record: FlightRecord, topic: str) -> NumericChannel | None:
    """A channel as it is; the truth in the frame that the estimate had at each of its times."""
    channel = record.channel(topic)
    times, jumps, turns = resets(record)
    if channel is None or topic != "/truth" or not len(times):
        return channel
    moved = replace(channel, values=channel.values.copy())
    count = np.searchsorted(times, channel.time_s, side="right")
    moved["position_enu"][:] += np.vstack((np.zeros(3), np.cumsum(jumps, axis=0)))[count]
    half = 0.5 * np.concatenate(([0.0], np.cumsum(turns)))[count]
    c, s = np.cos(half), np.sin(half)
    w, x, y, z = channel["quaternion_wxyz"].T
    moved["quaternion_wxyz"][:] = np.stack(
        (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w), axis=1
    )
    return moved
