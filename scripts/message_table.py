"""Write the stub's message table anew from the installed pymavlink: `sitl_stub/mavlink/data/messages.json`.

python scripts/message_table.py

The stub reads that file instead of importing pymavlink, whose module of 300 classes would be a third of the time until it
is ready. A test holds the file to pymavlink.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

TABLE = Path(__file__).resolve().parents[1] / "sitl_stub" / "mavlink" / "data" / "messages.json"


def _field(cls: Any, index: int, name: str) -> str:
    """Name of a field in wire order, with its count where it is an array, or [] where it is a string."""
    # pymavlink keeps array lengths in wire order, types in the order of the definition
    if cls.fieldtypes[cls.fieldnames.index(name)] == "char":
        return f"{name}[]"
    return f"{name}[{cls.array_lengths[index]}]" if cls.array_lengths[index] else name


def table() -> dict[str, list[Any]]:
    """Name: [message id, CRC extra, wire format, fields in wire order]."""
    return {
        cls.msgname: [
            message_id,
            cls.crc_extra,
            cls.unpacker.format,
            " ".join(_field(cls, index, name) for index, name in enumerate(cls.ordered_fieldnames)),
        ]
        for message_id, cls in sorted(dialect.mavlink_map.items())
    }


if __name__ == "__main__":
    lines = [f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in table().items()]
    TABLE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    print(f"{len(lines)} messages in {TABLE.name}")
