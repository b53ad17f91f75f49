"""Values of a message in wire order, and what a field of 16 bits holds."""

from __future__ import annotations

from typing import Any

NAN = float("nan")
Values = tuple[Any, ...]


def int16(value: float) -> int:
    """The nearest number that 16 bits hold."""
    return max(-32768, min(32767, round(value)))
