"""Cutting bytes into MAVLink frames, before anything is believed about them.

A start byte is only believed when the frame behind it is: a candidate whose checksum turns out wrong is given back
with `reject`, costs one byte, and the search goes on inside it.

A bridge between a serial line and UDP cuts frames wherever its packet is full, so what is unfinished at the end of a
datagram is tried once more in front of the same sender's next one. It never keeps that one waiting, as the shared buffer
of pymavlink does, where a truncated datagram swallows the good one after it: whole frames behind an unfinished one are
candidates at once.
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
    follows it, or when it ends its datagram; not when it reaches into a datagram that has a start byte of its own.
    """

    def __init__(self, known: Container[int], stream: bool) -> None:
        """`known`: numbers of the messages whose checksum can be checked. `stream`: one read may end inside a frame."""
        self._known = known
        self._stream = stream
        self._data: bytes | bytearray = bytearray()  # one datagram, or what a stream has brought so far
        self._chunks: deque[tuple[bytes, object]] = deque()
        self._sender: object = None  # of the datagram
        self._unfinished = -1  # where a frame begins that the datagram does not end; −1: nowhere
        self._seam = 0  # between an earlier datagram's unfinished frame and this one
        self._position = 0
        self._start = -1  # of the last candidate; −1 once it has been judged
        self.stray_bytes = 0  # that belonged to no frame

    def feed(self, chunk: bytes, sender: object = None) -> None:
        """Take what one read or one datagram brought, and from whom (of datagrams)."""
        if not self._stream:
            self._chunks.append((chunk, sender))
            return
        assert isinstance(self._data, bytearray)
        del self._data[: self._position]
        self._position = 0
        self._data += chunk

    def next_frame(self) -> bytes | None:
        """The next candidate; None when there is no whole one."""
        if self._start >= 0:  # the last candidate was believed: what seemed to begin in front of it does not
            self._unfinished = -1
        while True:
            if self._position < len(self._data):
                frame = self._search()
                if frame is not None:
                    return frame
            if not self._chunks:
                self._start = -1
                return None
            chunk, sender = self._chunks.popleft()
            tail = self._data[self._unfinished :] if self._unfinished >= 0 and sender == self._sender else b""
            self._data, self._position, self._sender = chunk, 0, sender
            self._unfinished, self._seam = -1, 0
            if chunk and frame_length(chunk, 0) == len(chunk):  # as nearly all datagrams are: one frame
                self._start, self._position = 0, len(chunk)
                return chunk
            if tail:
                self._data, self._seam = bytes(tail) + chunk, len(tail)
                self.stray_bytes -= len(tail)  # they are gone through once more

    def reject(self) -> None:
        """The last candidate was no frame: go on behind its first byte."""
        self._position = self._start + 1
        self._start = -1
        self.stray_bytes += 1

    def _search(self) -> bytes | None:
        data, end = self._data, len(self._data)
        while self._position < end:
            start = self._position
            if start >= self._seam and data[start] == MAGIC_V2 and start + 12 <= end and not data[start + 2]:
                after = start + data[start + 1] + 12
                if (after < end and data[after] in _MAGICS) or (after == end and not self._stream):
                    self._start, self._position = start, after
                    return bytes(data[start:after])
            length = frame_length(data, start)
            whole = length is not None and start + length <= end
            if not whole:
                if self._stream:
                    self._start = -1
                    return None
                if self._unfinished < 0:
                    self._unfinished = start
            if whole and length:
                frame, after = bytes(data[start : start + length]), start + length
                known = message_id(frame) in self._known
                if not known and after == end and self._stream:
                    self._start = -1
                    return None  # the byte that will follow decides
                over = start < self._seam < after and data[self._seam] in _MAGICS
                if known or (not over and (after == end or data[after] in _MAGICS)):
                    self._start, self._position = start, after
                    return frame
            self._position += 1
            self.stray_bytes += 1
        return None
