"""Cutting bytes into MAVLink frames, before anything is believed about them.

A start byte is only believed when the frame behind it is: a candidate whose checksum turns out wrong is given back
with `reject`, costs one byte, and the search goes on inside it. A UDP datagram never shares a buffer with the next
one: with a shared buffer (pymavlink's default) a truncated datagram swallows the good one after it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Container

MAGIC_V1, MAGIC_V2 = 0xFE, 0xFD
SIGNED_FLAG = 0x01
_MAGICS = (MAGIC_V1, MAGIC_V2)


def frame_length(data: bytes | bytearray, start: int) -> int | None:
    """Length of the frame that may begin at `start`: 0 when none can, None when too few bytes are there to say."""
    magic = data[start]
    if magic == MAGIC_V1:
        return data[start + 1] + 8 if start + 1 < len(data) else None
    if magic != MAGIC_V2:
        return 0
    if start + 2 >= len(data):
        return None
    flags = data[start + 2]
    if flags & ~SIGNED_FLAG:
        return 0  # a frame with flags the receiver does not know has to be thrown away (MAVLink 2)
    return data[start + 1] + (25 if flags & SIGNED_FLAG else 12)


def message_id(frame: bytes | bytearray) -> int:
    """The message's number in a whole frame's header."""
    return frame[5] if frame[0] == MAGIC_V1 else frame[7] | frame[8] << 8 | frame[9] << 16


def is_signed(frame: bytes | bytearray) -> bool:
    """Whether a whole frame ends with a signature (MAVLink 2 only)."""
    return frame[0] == MAGIC_V2 and bool(frame[2] & SIGNED_FLAG)


class Framer:
    """Candidates for frames, one at a time, out of datagrams or out of a stream.

    The checksum of a message that is not `known` cannot be checked. It becomes a candidate when another start byte
    follows it, or when it ends its datagram.
    """

    def __init__(self, known: Container[int], stream: bool) -> None:
        """`known`: numbers of the messages whose checksum can be checked. `stream`: one read may end inside a frame."""
        self._known = known
        self._stream = stream
        self._data: bytes | bytearray = bytearray()  # one datagram, or what a stream has brought so far
        self._chunks: deque[bytes] = deque()
        self._position = 0
        self._start = 0  # of the last candidate
        self.stray_bytes = 0  # that belonged to no frame

    def feed(self, chunk: bytes) -> None:
        """Take what one read or one datagram brought."""
        if not self._stream:
            self._chunks.append(chunk)
            return
        assert isinstance(self._data, bytearray)
        del self._data[: self._position]
        self._position = 0
        self._data += chunk

    def next_frame(self) -> bytes | None:
        """The next candidate; None when there is no whole one."""
        while True:
            if self._position < len(self._data):
                frame = self._search()
                if frame is not None:
                    return frame
            if not self._chunks:
                return None
            chunk = self._chunks.popleft()
            self._data, self._position = chunk, 0
            if chunk and frame_length(chunk, 0) == len(chunk):  # as nearly all datagrams are: one frame
                self._start, self._position = 0, len(chunk)
                return chunk

    def reject(self) -> None:
        """The last candidate was no frame: go on behind its first byte."""
        self._position = self._start + 1
        self.stray_bytes += 1

    def _search(self) -> bytes | None:
        data, end = self._data, len(self._data)
        while self._position < end:
            start = self._position
            if data[start] == MAGIC_V2 and start + 12 <= end and not data[start + 2]:  # as nearly all are
                after = start + data[start + 1] + 12
                if (after < end and data[after] in _MAGICS) or (after == end and not self._stream):
                    self._start, self._position = start, after
                    return bytes(data[start:after])
            length = frame_length(data, start)
            whole = length is not None and start + length <= end
            if not whole and self._stream:
                return None
            if whole and length:
                frame, after = bytes(data[start : start + length]), start + length
                known = message_id(frame) in self._known
                if not known and after == end and self._stream:
                    return None  # the byte that will follow decides
                if known or after == end or data[after] in _MAGICS:
                    self._start, self._position = start, after
                    return frame
            self._position += 1
            self.stray_bytes += 1
        return None
