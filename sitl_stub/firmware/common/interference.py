"""Where faults meet the firmware: what an autopilot asks of whatever interferes with it, and what asks nothing of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link


class Interference(Protocol):
    """What is to go wrong with one autopilot (`sitl_stub.faults.director`)."""

    def next_instant_us(self, otherwise_us: int) -> int:
        """The next instant at which something happens here, or `otherwise_us` if that is earlier."""

    def run(self) -> int:
        """Do what is due at the present instant; returns how many messages went to clients."""

    def take_on(self, link: Link) -> None:
        """Stand between a client and its socket."""

    def let_go(self, link: Link) -> None:
        """Forget a client and what is still on its way to or from it."""

    def take_in(self, link: Link, message: Received) -> None:
        """A message of a client has come: hand on to the autopilot what reaches it, when it does."""


class Undisturbed:
    """Nothing goes wrong."""

    def __init__(self, deliver: Callable[[Link, Received], None]) -> None:
        self._deliver = deliver

    def next_instant_us(self, otherwise_us: int) -> int:
        """No instant of its own."""
        return otherwise_us

    def run(self) -> int:
        """Nothing is due."""
        return 0

    def take_on(self, link: Link) -> None:
        """Leave it alone."""

    def let_go(self, link: Link) -> None:
        """There is nothing of it here."""

    def take_in(self, link: Link, message: Received) -> None:
        """Everything arrives, at once."""
        self._deliver(link, message)
