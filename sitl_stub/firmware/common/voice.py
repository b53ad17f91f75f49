"""What an autopilot says of its own accord: messages to every client, and words to whoever runs the stub."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sitl_stub.mavlink.links import Link

STATUSTEXT_BYTES = 50


class Voice:
    """The voice of one autopilot."""

    def __init__(self) -> None:
        self.links: list[Link] = []
        """The clients there are."""
        self.on_text: Callable[[str], None] = lambda text: None
        """Called with every notable event in words (the command line prints them)."""

    def forget(self) -> None:
        """The firmware starts anew: nothing that was to be said is."""

    def note(self, text: str) -> None:
        """Words for whoever runs the stub; nothing is sent."""
        self.on_text(text)

    def broadcast(self, name: str, **fields: Any) -> None:
        """Send one message to every client."""
        for link in self.links:
            link.send(name, **fields)

    def say(self, severity: int, text: str) -> None:
        """STATUSTEXT (MAV_SEVERITY) to every client."""
        self.note(text)
        self.broadcast("STATUSTEXT", severity=severity, text=text[:STATUSTEXT_BYTES])
