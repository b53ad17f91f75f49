"""How often the autopilot asks for the time by itself: counted without lockstep, whose own questions come every instant.

The sessions of the captures are flown in lockstep, so that they repeat; a real autopilot has no lockstep, and its rate of
TIMESYNC is compared with that of a stub that runs free. The clock is in the questions themselves (ts1), the link is TCP,
which loses none.
"""

from __future__ import annotations

import os
from typing import Any

os.environ.setdefault("MAVLINK20", "1")
from px4_scenario import INTERVALS
from pymavlink import mavutil

from sitl_stub import Stub

PATIENCE_S = 240.0  # a new machine compiles first


def _rate_hz(link: Any, questions: int) -> float:
    """Mean rate over the time that so many questions span."""
    times = []
    while len(times) < questions:
        message = link.recv_match(
            type="TIMESYNC", condition="TIMESYNC.tc1==0", blocking=True, timeout=PATIENCE_S
        )
        assert message is not None, "no TIMESYNC question came"
        times.append(message.ts1 * 1e-9)
    return round((questions - 1) / (times[-1] - times[0]), 2)


def rates_hz(firmware: str, questions: tuple[int, int], speed: float) -> tuple[float, float]:
    """TIMESYNC questions a second of a stub that runs free: unasked, and after the captures' SET_MESSAGE_INTERVALs.

    `questions`: over how many each is counted; `speed`: times real time.
    """
    with Stub(firmware, speed=speed, transport="tcp") as stub:
        link = mavutil.mavlink_connection(stub.endpoint, source_system=1, source_component=191)
        try:
            unasked = _rate_hz(link, questions[0])
            for message_id, interval_us in INTERVALS.items():
                link.mav.command_long_send(1, 1, 511, 0, message_id, interval_us, 0, 0, 0, 0, 0)
            return unasked, _rate_hz(link, questions[1])
        finally:
            link.close()
