"""How each stream of the autopilot arrives: how often, how evenly, and how old a message is when it is here.

The age is the time of arrival, on the autopilot's clock by TIMESYNC, less the message's own time stamp. So it holds
everything between the moment a message is about and the moment it is dealt with: the autopilot's own scheduling, the
wire, and the wait for the control loop. TIMESYNC takes the middle of its round trip for the moment of the answer, so a
wire that is slower one way than the other shifts every age by half of the difference; and `time_boot_ms` is cut to whole
milliseconds, which makes ages 0.5 ms too great on average.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.mavlink.received import mav
from companion.mavlink.timesync import TimeSync

Vector = NDArray[np.float64]
WINDOW_S = 2.0
_LONGEST = 1024  # messages kept of a stream: WINDOW_S at 500 Hz

STREAMS: dict[int, str] = {
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: "ATTITUDE_QUATERNION",
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: "LOCAL_POSITION_NED",
    mav.MAVLINK_MSG_ID_ATTITUDE: "ATTITUDE",
    mav.MAVLINK_MSG_ID_ODOMETRY: "ODOMETRY",
    mav.MAVLINK_MSG_ID_HIGHRES_IMU: "HIGHRES_IMU",
}
"""What is measured: streams whose stamp is the time since boot at which the vehicle was as they say. The first two are
what a state is made of."""
STATE_STREAMS = tuple(STREAMS)[:2]


@dataclass(frozen=True, slots=True)
class StreamFigures:
    """One stream over the last WINDOW_S. What cannot be told is nan: on a simulation's clock no age can."""

    message_id: int
    rate_hz: float  # by the messages' own stamps
    jitter_s: (
        float  # mean difference of the way's duration from message to message (RFC 3550, without its filter)
    )
    age_s: float  # at arrival, median
    age_95_s: float  # at arrival, 95 % are younger

    @property
    def name(self) -> str:
        """The message's name."""
        return STREAMS[self.message_id]


class StreamTiming:
    """Takes stamps and arrivals, one by one; `figures` sums up."""

    def __init__(self, timesync: TimeSync) -> None:
        self._timesync = timesync
        self._seen: dict[int, deque[tuple[float, float]]] = {
            message_id: deque(maxlen=_LONGEST) for message_id in STREAMS
        }

    def note(self, message_id: int, stamp_s: float, arrived_ns: int) -> None:
        """A message of STREAMS stamped `stamp_s` (autopilot's clock) arrived at `arrived_ns` (ours)."""
        self._seen[message_id].append((stamp_s, arrived_ns * 1e-9))

    def figures(self) -> list[StreamFigures]:
        """Every stream of which at least two messages came within the last WINDOW_S."""
        found = []
        for message_id, seen in self._seen.items():
            if not seen:
                continue
            stamps_s, arrived_s = np.array(seen).T
            recent = stamps_s >= stamps_s.max() - WINDOW_S
            stamps_s, arrived_s = stamps_s[recent], arrived_s[recent]
            if len(stamps_s) > 1 and stamps_s.max() > stamps_s[0]:
                found.append(self._summed_up(message_id, stamps_s, arrived_s))
        return found

    def _summed_up(self, message_id: int, stamps_s: Vector, arrived_s: Vector) -> StreamFigures:
        rate_hz = (len(np.unique(stamps_s)) - 1) / float(np.ptp(stamps_s))
        if not self._timesync.steady:
            return StreamFigures(message_id, rate_hz, math.nan, math.nan, math.nan)
        ages_s = self._timesync.autopilot_time_s(arrived_s) - stamps_s
        jitter_s = float(np.abs(np.diff(ages_s)).mean())
        ordered = np.sort(ages_s).tolist()
        return StreamFigures(
            message_id,
            rate_hz,
            jitter_s,
            ordered[len(ordered) // 2],
            ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))],
        )


def in_words(figures: StreamFigures) -> str:
    """One line: `100 Hz, age 2.1 ms (95 %: 3.0 ms), jitter 0.4 ms`."""
    if math.isnan(figures.age_s):
        return f"{figures.rate_hz:.0f} Hz; its clock does not run like ours, so ages cannot be told"
    return (
        f"{figures.rate_hz:.0f} Hz, age {figures.age_s * 1e3:.1f} ms "
        f"(95 %: {figures.age_95_s * 1e3:.1f} ms), jitter {figures.jitter_s * 1e3:.1f} ms"
    )
