"""What a log says, in one number: equal for two runs of the same seed, whatever the wall clock did.

Left out: channels marked as wall clock (/timing), event fields named `wall_…`, metadata named `wall…` or
`clock`, and the fixed offset between autopilot time and UTC. Chunks, compression and the interleaving of
channels do not count either.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Collection

from companion.flightlog import events
from companion.flightlog.reader import RawChannel, RawLog, read_raw

_PROTOBUF = "protobuf"


def digest(path: str | os.PathLike[str], *, without: Collection[str] = ()) -> str:
    """Return the digest of a log as hex. `without` leaves out more topics. Raises UserError as `read_log`."""
    total = hashlib.sha256()
    for name, part in sorted(digests(path).items()):
        if name not in without:
            total.update(f"{name}={part}\n".encode())
    return total.hexdigest()


def digests(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return a digest by topic, by `metadata:name` and by `attachment:name`: where two logs differ.

    Foxglove's poses are left out: they are made of /state and the rest, with UTC inside.
    """
    raw = read_raw(path)
    offset = _utc_offset_ns(raw)
    parts = {
        item.topic: _of_channel(item, offset)
        for item in raw.channels
        if item.metadata.get("wall_clock") != "true" and item.encoding != _PROTOBUF and item.messages
    }
    for name, values in raw.metadata:
        if name != "clock" and not name.startswith("wall"):
            text = json.dumps(values, sort_keys=True)
            parts[f"metadata:{name}"] = hashlib.sha256(text.encode()).hexdigest()
    for attachment in raw.attachments:
        parts[f"attachment:{attachment.name}"] = hashlib.sha256(attachment.data).hexdigest()
    return parts


def _utc_offset_ns(raw: RawLog) -> int:
    for name, values in raw.metadata:
        if name == "clock":
            return int(values.get("utc_offset_ns", "0"))
    return 0


def _of_channel(item: RawChannel, offset: int) -> str:
    total = hashlib.sha256()
    total.update(item.schema_data)
    for log_time, message in zip(item.log_times_ns, item.messages, strict=True):
        body = _without_wall_clock(message) if item.topic == events.TOPIC else message
        total.update(b"%d %d\n" % (log_time - offset, len(body)))
        total.update(body)
    return total.hexdigest()


def _without_wall_clock(message: bytes) -> bytes:
    try:
        body = json.loads(message)
    except ValueError:
        return message
    kept = {key: value for key, value in body.items() if not key.startswith(events.WALL_CLOCK_PREFIX)}
    return json.dumps(kept, sort_keys=True).encode()
