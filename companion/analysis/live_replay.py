"""Make the references of another program again from what it sent, and compare the bits."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from companion.config.errors import UserError
from companion.config.settings import settings_from_tables
from companion.flight.live_bounds import bounds_from
from companion.flightlog.channels import LIVE_SAMPLED
from companion.flightlog.reader import FlightRecord
from companion.live.heard import BEFORE_TRACKING, Heard
from companion.live.trajectory import Beginning, LiveAddress, LiveTrajectory, checksum
from companion.reference.transit import TransitLimits


def replay_references(record: FlightRecord) -> tuple[int, int] | None:
    """How many references were asked for while tracking, and how many come out with the same bits.

    None for a flight whose trajectory was not told by another program. Raises UserError where the log does not hold what
    it takes.
    """
    begun = next((event.fields for event in record.events_of("live") if "started_s" in event.fields), None)
    if begun is None:
        return None
    sampled = record.channel(LIVE_SAMPLED.topic)
    if sampled is None:
        raise UserError(
            f"{record.path}: no {LIVE_SAMPLED.topic} in this log, so its references cannot be repeated"
        )
    live, beginning = _begun(record, begun)
    waiting = [Heard.from_log(*logged) for logged in record.live]
    while waiting and waiting[0].samples == BEFORE_TRACKING:
        live.take(waiting.pop(0))
    live.begin(beginning)
    identical = 0
    for number, (own_time_s, wanted) in enumerate(
        zip(sampled["own_time_s"], sampled["checksum"], strict=True)
    ):
        while waiting and waiting[0].samples <= number:
            live.take(waiting.pop(0))
        identical += checksum(live.sample(float(own_time_s))) == int(wanted)
    return len(sampled), identical


def _begun(record: FlightRecord, fields: dict[str, Any]) -> tuple[LiveTrajectory, Beginning]:
    text = record.attachments.get("settings.json")
    if text is None:
        raise UserError(f"{record.path}: no settings.json in this log, so its references cannot be repeated")
    safety = settings_from_tables(json.loads(text)).flight.safety
    live = LiveTrajectory(LiveAddress("mavlink" if fields["mavlink"] else "udp", ("", 0)))
    *position, yaw_rad = fields["start"]
    live.stand_at(np.array(position), yaw_rad)
    limits = TransitLimits(
        **{name: math.inf if value is None else value for name, value in fields["limits"].items()}
    )
    return live, Beginning(
        fields["started_s"],
        fields["now_s"],
        limits,
        fields["silence_s"],
        bounds_from(safety, fields["bounds"]),
    )
