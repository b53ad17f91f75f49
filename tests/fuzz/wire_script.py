"""What a fuzzer's bytes mean on a wire: a script of datagrams, well-formed frames and waiting.

Noise alone never gets past MAVLink's checksum, so most of what is worth trying would never be tried. A script is a
series of records, each `kind, argument, length, payload`:

    kind % 4 == 0    the payload is a datagram as it is
    kind % 4 == 1    a frame of message `argument` of MESSAGES with the payload in it and a right checksum
    kind % 4 == 2    the same, sent by somebody else
    kind % 4 == 3    time passes: `argument` ms

A record that is cut short takes what is left, so every string of bytes is a script.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

os.environ.setdefault("MAVLINK20", "1")
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as mav

MESSAGES = tuple(sorted(mav.mavlink_map))
MOST_RECORDS = 64


@dataclass(frozen=True)
class Wait:
    """Time passes."""

    seconds: float


def frame(number: int, payload: bytes, system: int = 1, component: int = 1, sequence: int = 0) -> bytes:
    """A MAVLink 2 frame whose checksum is right, whatever the payload."""
    payload = payload[:255]
    body = bytes((len(payload), 0, 0, sequence, system, component)) + number.to_bytes(3, "little") + payload
    return b"\xfd" + body + mcrf4xx(body + bytes((mav.mavlink_map[number].crc_extra,))).to_bytes(2, "little")


def checksum_holds(data: bytes) -> bool:
    """Whether a whole frame, of either version, has the checksum that its message asks for."""
    if data[0] == 0xFD:
        end, number = 10 + data[1], int.from_bytes(data[7:10], "little")
    else:
        end, number = 6 + data[1], data[5]
    known = mav.mavlink_map.get(number)
    if known is None:
        return False
    return mcrf4xx(data[1:end] + bytes((known.crc_extra,))) == int.from_bytes(data[end : end + 2], "little")


def play(script: bytes, ours: tuple[int, int], other: tuple[int, int]) -> Iterator[bytes | Wait]:
    """Datagrams and waits of a script; frames are sent by `ours` or `other` (system, component)."""
    at = 0
    for sequence in range(MOST_RECORDS):
        if at >= len(script):
            return
        kind, argument, length, *_ = *script[at : at + 3], 0, 0
        payload = script[at + 3 : at + 3 + length]
        at += 3 + length
        if kind % 4 == 0:
            yield payload
        elif kind % 4 == 3:
            yield Wait(argument * 1e-3)
        else:
            number = MESSAGES[(argument | (kind >> 2) << 8) % len(MESSAGES)]
            yield frame(number, payload, *(ours if kind % 4 == 1 else other), sequence & 0xFF)


def datagram_record(data: bytes) -> bytes:
    """The record of a datagram (at most 255 bytes)."""
    return bytes((0, 0, len(data))) + data


def message_record(message: object, by_other: bool = False) -> bytes:
    """The record of a pymavlink message."""
    index = MESSAGES.index(message.get_msgId())  # type: ignore[attr-defined]
    message.pack(mav.MAVLink(None))  # type: ignore[attr-defined]
    payload = bytes(message.get_payload())[:255]  # type: ignore[attr-defined]
    return bytes(((2 if by_other else 1) | (index >> 8) << 2, index & 0xFF, len(payload))) + payload


def wait_record(milliseconds: int) -> bytes:
    """The record of a pause."""
    return bytes((3, milliseconds, 0))
