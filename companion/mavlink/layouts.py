"""How the dialect's messages lie on the wire, from pymavlink's tables: for who reads and packs them without its objects."""

from __future__ import annotations

import os
import struct
from typing import Any

os.environ.setdefault("MAVLINK20", "1")
from pymavlink.dialects.v20 import all as every_dialect  # CURRENT_MODE is in no smaller one

mav: Any = every_dialect
_STAMP = "time_boot_ms"


class Layout:
    """How a message of the dialect lies in its payload."""

    __slots__ = (
        "counts",
        "crc_extra",
        "has_arrays",
        "message_id",
        "name",
        "names",
        "pack",
        "plain",
        "size",
        "stamp_at",
        "stamp_us_at",
        "unpack",
    )

    def __init__(self, kind: Any) -> None:
        """`kind`: the message's class in pymavlink."""
        self.name: str = kind.msgname
        self.message_id: int = kind.id
        self.crc_extra = bytes((kind.crc_extra,))
        self.pack = kind.unpacker.pack
        self.unpack = kind.unpacker.unpack_from
        self.size: int = kind.unpacker.size
        self.names: tuple[str, ...] = tuple(kind.ordered_fieldnames)
        """Of the fields, in the order in which they lie there."""
        self.counts: tuple[int, ...] = tuple(kind.lengths)
        """How many numbers each of them is."""
        self.has_arrays = any(count != 1 for count in self.counts)
        self.plain = "char" not in kind.fieldtypes
        """Numbers only: no text whose end has to be found."""
        self.stamp_at = self._place_of(_STAMP, kind)
        """Where the time since boot stands in the payload (uint32, ms); -1 where there is none."""
        self.stamp_us_at = self._place_of("time_usec", kind)
        """The same of `time_usec` (uint64, µs)."""

    def _place_of(self, field: str, kind: Any) -> int:
        if field not in self.names:
            return -1
        before = kind.native_format.decode()[1:]
        counts = [max(1, count) for count in kind.array_lengths]  # as the format has no text's length
        place = self.names.index(field)
        return struct.calcsize(
            "<" + "".join(f"{count}{code}" for count, code in zip(counts[:place], before, strict=False))
        )


LAYOUTS = {number: Layout(kind) for number, kind in mav.mavlink_map.items()}
