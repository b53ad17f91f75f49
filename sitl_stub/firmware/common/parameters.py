"""The parameter table of a firmware: names, types, values, and how they are changed."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping

INT32 = 6  # MAV_PARAM_TYPE_INT32
REAL32 = 9  # MAV_PARAM_TYPE_REAL32


class ParameterError(ValueError):
    """An unknown parameter or a value it cannot take."""


def to_float32(value: float) -> float:
    """The nearest single-precision number: what a parameter really holds."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


class ParameterTable(Mapping[str, float]):
    """Parameters in the order of their indices. Integers stay `int`, reals are single precision."""

    def __init__(self, values: Mapping[str, float]) -> None:
        self._values: dict[str, float] = {
            name: value if isinstance(value, int) else to_float32(value) for name, value in values.items()
        }
        self._index = {name: index for index, name in enumerate(self._values)}
        self._names = list(self._values)
        self.changes = 0
        """Grows with every change; who caches something derived from parameters compares it."""

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def index(self, name: str) -> int:
        """Position in the list."""
        return self._index[name]

    def name_at(self, index: int) -> str | None:
        """Name at a position, or None."""
        return self._names[index] if 0 <= index < len(self._names) else None

    def kind(self, name: str) -> int:
        """MAV_PARAM_TYPE of a parameter."""
        return INT32 if isinstance(self._values[name], int) else REAL32

    def set(self, name: str, value: float) -> None:
        """Change one; raises ParameterError for an unknown name or a number that is none."""
        if name not in self._values:
            close = [known for known in self._values if known.startswith(name[:5])][:4]
            hint = f"; some there are: {', '.join(close)}" if close else ""
            raise ParameterError(f"unknown parameter {name!r}{hint}")
        if not math.isfinite(value):
            raise ParameterError(f"parameter {name} cannot be {value}: give a finite number")
        if self.kind(name) == INT32:
            if not -(2**31) <= value < 2**31 or value != int(value):
                raise ParameterError(f"parameter {name} takes a whole number of 32 bits, not {value}")
            self._values[name] = int(value)
        else:
            self._values[name] = to_float32(value)
        self.changes += 1

    def hash(self) -> int:
        """CRC-32 over names and values, as the `_HASH_CHECK` parameter reports it: changes when anything changes."""
        crc = 0
        for name, value in self._values.items():
            raw = struct.pack("<i", value) if isinstance(value, int) else struct.pack("<f", value)
            crc = zlib.crc32(raw, zlib.crc32(name.encode(), crc))
        return crc
