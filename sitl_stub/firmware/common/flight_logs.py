"""The list of logs, one a flight: LOG_REQUEST_LIST, LOG_ERASE. There is nothing in them: data asked for ends at once."""

from __future__ import annotations

from collections.abc import Mapping

from sitl_stub.firmware.common.clock import SIMULATED_EPOCH_US, Clock
from sitl_stub.firmware.common.commands import MessageHandler
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link

BYTES_PER_S = 50_000
"""What a flight's log grows by, as the autopilots' do roughly."""


class FlightLogs:
    """Logs since power-up: from arming to disarming."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._armed = False
        self._flights: list[list[int]] = []  # begin and end, µs

    def messages(self) -> Mapping[str, MessageHandler]:
        """Message name to handler."""
        return {"LOG_REQUEST_LIST": self._list, "LOG_REQUEST_DATA": self._data, "LOG_ERASE": self._erase}

    def update(self, armed: bool) -> None:
        """Called a hundred times a second."""
        now_us = self._clock.time_us
        if armed and not self._armed:
            self._flights.append([now_us, now_us])
        elif armed and self._flights:
            self._flights[-1][1] = now_us
        self._armed = armed

    def _list(self, link: Link, message: Received) -> None:
        first, last = message.values["start"], message.values["end"]
        count = len(self._flights)
        if not count:
            link.send("LOG_ENTRY")  # of no log
        for number, (begin_us, end_us) in enumerate(self._flights):
            if first <= number <= last:
                link.send(
                    "LOG_ENTRY",
                    id=number,
                    num_logs=count,
                    last_log_num=count - 1,
                    time_utc=(SIMULATED_EPOCH_US + begin_us) // 1_000_000,
                    size=max((end_us - begin_us) * BYTES_PER_S // 1_000_000, 1),
                )

    def _data(self, link: Link, message: Received) -> None:
        link.send("LOG_DATA", id=message.values["id"], ofs=message.values["ofs"])

    def _erase(self, link: Link, message: Received) -> None:
        self._flights.clear()
