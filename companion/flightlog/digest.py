"""What a log says, in one number: equal for two runs of the same seed, whatever the wall clock did.

Left out: channels and fields marked as wall clock (/timing, the clock offset), event fields named
`wall_…`, metadata named `wall…` or `clock`, the fixed offset between autopilot time and UTC, what TIMESYNC
frames hold, which is the companion's clock by nature (that one came counts), and the sequence number of
every MAVLink frame with the checksum over it: a peer that called before we listened starts at another
number. Chunks, compression and the interleaving of channels do not count either; Foxglove's poses are made
of /state and the rest.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Collection, Iterator

from companion.flightlog import events
from companion.flightlog.channels import CDR_HEADER, WALL_FIELDS_KEY, parse_definition
from companion.flightlog.reader import RawChannel, RawLog, read_raw

TIMESYNC_ID = 111
_FRAME_OFFSET = 16  # CDR header, time, length; then the frame


def digest(path: str | os.PathLike[str], *, without: Collection[str] = ()) -> str:
    """Return the digest of a log as hex. `without` leaves out more topics. Raises UserError as `read_log`."""
    total = hashlib.sha256()
    for name, part in sorted(digests(path).items()):
        if name not in without:
            total.update(f"{name}={part}\n".encode())
    return total.hexdigest()


def digests(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return a digest by topic, by `metadata:name` and by `attachment:name`: where two logs differ."""
    raw = read_raw(path)
    parts = {}
    for item in _counted(raw):
        total = hashlib.sha256(item.schema_data)
        for time_ns, body in _content(item, _utc_offset_ns(raw)):
            total.update(b"%d %d\n" % (time_ns, len(body)))
            total.update(body)
        parts[item.topic] = total.hexdigest()
    for name, values in raw.metadata:
        if name != "clock" and not name.startswith("wall"):
            text = json.dumps(values, sort_keys=True)
            parts[f"metadata:{name}"] = hashlib.sha256(text.encode()).hexdigest()
    for attachment in raw.attachments:
        parts[f"attachment:{attachment.name}"] = hashlib.sha256(attachment.data).hexdigest()
    return parts


def differences(first: str | os.PathLike[str], second: str | os.PathLike[str]) -> list[str]:
    """Say where two logs part: for each topic that differs the first record that does, the earliest topic first."""
    raws = read_raw(first), read_raw(second)
    channels = [{item.topic: item for item in _counted(raw)} for raw in raws]
    found: list[tuple[int, str]] = []
    for topic in sorted(channels[0].keys() | channels[1].keys()):
        pair = [by_topic.get(topic) for by_topic in channels]
        if pair[0] is None or pair[1] is None:
            found.append((0, f"{topic}: only in the {'second' if pair[0] is None else 'first'}"))
            continue
        rows = [
            list(_content(item, _utc_offset_ns(raw)))
            for item, raw in zip(pair, raws, strict=True)
            if item is not None
        ]
        counts = f"{len(rows[0])} and {len(rows[1])} records"
        for number, (left, right) in enumerate(zip(*rows, strict=False)):
            if left != right:
                times = f"at {left[0] / 1e9:.6f} s" + (
                    f" and {right[0] / 1e9:.6f} s" if right[0] != left[0] else ""
                )
                found.append((min(left[0], right[0]), f"{topic}: record {number} {times}; {counts}"))
                break
        else:
            if len(rows[0]) != len(rows[1]):
                shorter = min(rows, key=len)
                found.append(
                    (shorter[-1][0] if shorter else 0, f"{topic}: equal as far as both go; {counts}")
                )
    return [text for _, text in sorted(found)]


def _counted(raw: RawLog) -> Iterator[RawChannel]:
    for item in raw.channels:
        if item.messages and item.encoding != "protobuf" and item.metadata.get("wall_clock") != "true":
            yield item


def _utc_offset_ns(raw: RawLog) -> int:
    for name, values in raw.metadata:
        if name == "clock":
            return int(values.get("utc_offset_ns", "0"))
    return 0


def _content(item: RawChannel, offset: int) -> Iterator[tuple[int, bytes]]:
    """Yield autopilot time in ns and what of each message counts."""
    blanks = _wall_slices(item)
    for log_time, message in zip(item.log_times_ns, item.messages, strict=True):
        if item.topic == events.TOPIC:
            message = _without_wall_clock(message)
        elif item.topic.startswith("/mavlink/"):
            message = message[:_FRAME_OFFSET] + _lasting(message[_FRAME_OFFSET:])
        elif blanks:
            blanked = bytearray(message)
            for part in blanks:
                blanked[part] = bytes(part.stop - part.start)
            message = bytes(blanked)
        yield log_time - offset, message


def _wall_slices(item: RawChannel) -> list[slice]:
    """Return where in a message the fields marked as wall clock stand."""
    names = [name for name in item.metadata.get(WALL_FIELDS_KEY, "").split(",") if name]
    if not names:
        return []
    slices, start = [], len(CDR_HEADER)
    for part in parse_definition(item.schema_data.decode()):
        stop = start + 8 * part.width
        if part.name in names:
            slices.append(slice(start, stop))
        start = stop
    return slices


def _lasting(frame: bytes) -> bytes:
    """Return what of a MAVLink frame is the same in every run: header without sequence number, and payload."""
    if (
        len(frame) >= 12 and frame[0] == 0xFD
    ):  # MAVLink 2: magic, length, flags, flags, sequence, ids, payload
        number, head, sequence = int.from_bytes(frame[7:10], "little"), 10, 4
    elif len(frame) >= 8 and frame[0] == 0xFE:  # MAVLink 1: magic, length, sequence, ids, payload
        number, head, sequence = frame[5], 6, 2
    else:
        return frame
    payload = b"" if number == TIMESYNC_ID else frame[head : head + frame[1]]
    return frame[:sequence] + frame[sequence + 1 : head] + payload


def _without_wall_clock(message: bytes) -> bytes:
    try:
        body = json.loads(message)
    except ValueError:
        return message
    kept = {key: value for key, value in body.items() if not key.startswith(events.WALL_CLOCK_PREFIX)}
    return json.dumps(kept, sort_keys=True).encode()
