"""STATUSTEXT in one piece: PX4 and ArduPilot send what is longer than 50 bytes in chunks (`id`, `chunk_seq`).

https://mavlink.io/en/messages/common.html#STATUSTEXT: `id` 0 is a whole text; chunks of one text share another id, and the
last one is the first that is not full. Chunks may come late, twice, or never; a missing one is shown as MISSING.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

from companion.mavlink.link import Message, mav
from companion.mavlink.received import Received

CHUNK_BYTES = 50
LONGEST_CHUNKS = 255
WAIT_S = 1.0
"""For a missing chunk, by our clock: they leave one after the other."""
MISSING = "[…]"
_TEXT, _ID = slice(1, 51), slice(51, 53)  # of the payload: severity, text, id, chunk_seq


@dataclass(frozen=True, slots=True)
class StatusText:
    """One text. `severity` is a MAV_SEVERITY."""

    severity: int
    text: str


@dataclass(slots=True)
class _Pieces:
    severity: int
    since_s: float
    texts: dict[int, bytes] = field(default_factory=dict)
    last: int | None = None

    @property
    def whole(self) -> bool:
        return self.last is not None and all(place in self.texts for place in range(self.last + 1))

    def put_together(self) -> StatusText:
        end = max(self.texts) if self.last is None else self.last
        text, missing = "", False
        run = b""
        for place in range(end + 1):
            if place in self.texts:
                run, missing = run + self.texts[place], False
            elif not missing:
                text, run, missing = text + _decoded(run) + MISSING, b"", True
        ending = MISSING if self.last is None else ""
        return StatusText(self.severity, text + _decoded(run) + ending)


class StatusTexts:
    """Puts the chunks of each sender together."""

    def __init__(self) -> None:
        self._pieces: dict[tuple[int, int, int], _Pieces] = {}  # by system, component, id

    def take(self, message: Received, now_s: float) -> list[StatusText]:
        """Take a STATUSTEXT; return the texts that are whole now, in their order."""
        payload = message.msg_payload.ljust(54, b"\0")
        severity, number, chunk = payload[0], int.from_bytes(payload[_ID], "little"), payload[53]
        text, full, _ = payload[_TEXT].partition(b"\0")
        if number == 0:
            return [StatusText(severity, _decoded(text))]
        sender = message.msg_system, message.msg_component
        done = [
            self._pieces.pop(key).put_together()
            for key in list(self._pieces)
            if key[:2] == sender and key[2] != number  # it goes on to its next text
        ]
        pieces = self._pieces.setdefault((*sender, number), _Pieces(severity, now_s))
        pieces.texts.setdefault(chunk, text)
        if full or chunk == LONGEST_CHUNKS:
            pieces.last = chunk
        if pieces.whole:
            done.append(self._pieces.pop((*sender, number)).put_together())
        return done

    def overdue(self, now_s: float) -> list[StatusText]:
        """Texts whose missing chunks are not waited for any longer."""
        if not self._pieces:
            return []
        old = [key for key, pieces in self._pieces.items() if now_s - pieces.since_s > WAIT_S]
        return [self._pieces.pop(key).put_together() for key in old]


def status_texts(severity: int, text: str) -> list[Message]:
    """The STATUSTEXT that say `text`: one, or chunks of it where it is long. `severity` is a MAV_SEVERITY."""
    data = text.encode()
    count = len(data) // CHUNK_BYTES + 1  # the last one is the first that is not full
    number = 0 if len(data) <= CHUNK_BYTES else zlib.crc32(data) % 65535 + 1
    if not number:
        count = 1
    return [
        mav.MAVLink_statustext_message(severity, data[at * CHUNK_BYTES :][:CHUNK_BYTES], number, at)
        for at in range(count)
    ]


def _decoded(text: bytes) -> str:
    return text.decode("utf-8", "replace")
