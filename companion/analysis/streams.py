"""How the autopilot's streams arrived, from a flight's log: rate, jitter and age of each."""

from __future__ import annotations

import numpy as np

from companion.flightlog.reader import FlightRecord
from companion.mavlink.stream_timing import STREAMS

NUMBERS = ("rate_hz", "jitter_s", "age_s", "age_95_s")


def stream_delays(record: FlightRecord) -> dict[str, dict[str, float | None]]:
    """Return for each stream its NUMBERS: medians over the flight of what each second had. None is not known.

    `age_s` is the median age at arrival of a second's messages, `age_95_s` what 95 % of them were younger than.
    """
    channel = record.channel("/streams")
    if channel is None:
        return {}
    found: dict[str, dict[str, float | None]] = {}
    for message_id in np.unique(channel["message_id"]):
        rows = channel["message_id"] == message_id
        name = STREAMS.get(int(message_id), f"message {int(message_id)}")
        found[name] = {number: _median(channel[number][rows]) for number in NUMBERS}
    return found


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
