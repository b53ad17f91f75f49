"""What one link has carried: the counts and rates that an autopilot reports of it (LINK_NODE_STATUS).

Counted are the messages of autopilot and client, not the questions and answers of lockstep, so that the report of a flight
in lockstep is a function of the flight and not of how fast the machine was.
"""

from __future__ import annotations

from sitl_stub.mavlink.codec import MAVLINK2_MAGIC, Received

RATE_WINDOW_US = 900_000
"""Rates are means over at least this: a report that comes once a second renews them each time."""


class LinkTraffic:
    """Counts since the firmware started or the link was opened."""

    __slots__ = (
        "_last_sequence",
        "_marked_received",
        "_marked_sent",
        "_marked_us",
        "lost",
        "overflows",
        "received",
        "received_bytes",
        "received_bytes_s",
        "sent",
        "sent_bytes",
        "sent_bytes_s",
    )

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Count from nothing again."""
        self.sent = self.sent_bytes = 0
        self.received = self.received_bytes = 0
        self.lost = 0
        """Messages that are missing in the senders' sequence numbers."""
        self.overflows = 0
        """Messages that were not sent because the client did not take those before."""
        self.sent_bytes_s = self.received_bytes_s = 0.0
        """Means over the last window, bytes/s (`measure`)."""
        self._last_sequence: dict[tuple[int, int], int] = {}
        self._marked_us: int | None = None
        self._marked_sent = self._marked_received = 0

    def take(self, message: Received) -> None:
        """Count a message that has come."""
        self.received += 1
        self.received_bytes += len(message.frame)
        missed = self._missed(message)
        if missed:
            self.lost += missed

    def pass_over(self, message: Received) -> None:
        """A message that has come and is not to be counted: its number is used up all the same."""
        self._missed(message)

    def _missed(self, message: Received) -> int:
        """How many messages of its sender are missing before this one.

        As PX4 counts (`MavlinkReceiver::update_rx_stats`), which is one short where the number has wrapped.
        """
        frame = message.frame
        if not frame:
            return 0
        sequence = frame[4] if frame[0] == MAVLINK2_MAGIC else frame[2]
        sender = (message.system, message.component)
        last = self._last_sequence.get(sender)
        self._last_sequence[sender] = sequence
        if last is None:
            return 0
        expected = (last + 1) & 0xFF
        return sequence - expected if sequence >= expected else sequence + 255 - expected

    def measure(self, time_us: int) -> None:
        """Renew the rates where a window is over at `time_us`."""
        if self._marked_us is None:
            self._marked_us = time_us
        elif time_us - self._marked_us >= RATE_WINDOW_US:
            seconds = (time_us - self._marked_us) * 1e-6
            self.sent_bytes_s = (self.sent_bytes - self._marked_sent) / seconds
            self.received_bytes_s = (self.received_bytes - self._marked_received) / seconds
            self._marked_us = time_us
        else:
            return
        self._marked_sent, self._marked_received = self.sent_bytes, self.received_bytes
