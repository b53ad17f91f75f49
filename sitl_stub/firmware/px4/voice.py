"""How PX4 tells what happened: as EVENT where the release does that, else as STATUSTEXT."""

from __future__ import annotations

from sitl_stub.firmware.common.clock import Clock
from sitl_stub.firmware.common.voice import Voice
from sitl_stub.firmware.px4.events import Event

FIRST_SEQUENCE = 0xFFF9


class Px4Voice(Voice):
    """The voice of one PX4."""

    def __init__(self, clock: Clock, speaks_events: bool) -> None:
        super().__init__()
        self.event_sequence = FIRST_SEQUENCE
        self._clock = clock
        self._speaks_events = speaks_events

    def forget(self) -> None:
        """Start anew: events are numbered from the beginning."""
        self.event_sequence = FIRST_SEQUENCE

    def announce(
        self,
        severity: int,
        text: str,
        event: Event | None = None,
        arguments: bytes = b"",
        old_text: str | None = None,
    ) -> None:
        """Tell clients what happened: as EVENT where the release does that, else as STATUSTEXT (`old_text`, if other)."""
        if not self._speaks_events:
            self.say(severity, text if old_text is None else old_text)
            return
        self.note(text)
        if event is None:
            return
        self.event_sequence = (self.event_sequence + 1) & 0xFFFF
        self.broadcast(
            "EVENT",
            id=event.number,
            event_time_boot_ms=self._clock.stamp_ms,
            sequence=self.event_sequence,
            log_levels=event.log_levels,
            arguments=arguments,
        )
