"""EVENT messages of PX4 1.17: what it says instead of STATUSTEXT. Numbers and arguments are those of the capture."""

from __future__ import annotations

from enum import Enum


class Event(Enum):
    """An event: id, log levels (internal << 4 | external), arguments."""

    ARMING_DENIED = (0x0102089D, 0x62, b"")
    """Arming denied: resolve the failing checks first."""
    ARMED = (0x0190CAF3, 0x66, b"\x04")
    """Armed, by external command."""
    TAKEOFF_DETECTED = (0x01414569, 0x66, b"")
    """The land detector saw the take-off."""
    LANDING_DETECTED = (0x019638AC, 0x66, b"")
    """The land detector saw the landing."""
    DISARMED = (0x01F46777, 0x66, b"\x06")
    """Disarmed, by auto-disarm after landing."""
    FAILSAFE = (0x01DEDBD0, 0x42, bytes.fromhex("0000060007"))
    """Failsafe action, with its mode and cause."""

    @property
    def number(self) -> int:
        """Event id with the component in its top byte."""
        return self.value[0]

    @property
    def log_levels(self) -> int:
        """Internal and external level, four bits each."""
        return self.value[1]

    @property
    def arguments(self) -> bytes:
        """Argument bytes, filled up with zeros on the wire."""
        return self.value[2]
