"""Where a flight says what it does. The base class says nothing; `companion.cli.console` speaks."""

from __future__ import annotations

from companion.autopilot.adapter import Finding
from companion.flight.phases import Phase


class Reporter:
    """Called in the flight's thread: must not block."""

    def say(self, text: str) -> None:
        """One line worth keeping."""

    def progress(self, phase: Phase, time_s: float, of_s: float, text: str) -> None:
        """Where we are, about once a second."""

    def finding(self, finding: Finding) -> None:
        """One preflight check."""
