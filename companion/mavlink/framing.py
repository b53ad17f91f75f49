"""Cutting bytes into MAVLink frames, before anything is believed about them.

Every frame is decoded on its own, and a UDP datagram never shares a buffer with the next one: with a
shared buffer (pymavlink's default) a truncated datagram swallows the good one after it.
"""

from __future__ import annotations

MAGIC_V1, MAGIC_V2 = 0xFE, 0xFD
SIGNED_FLAG = 0x01
LONGEST_FRAME = 280  # bytes: 10 header, 255 payload, 2 checksum, 13 signature


def split_frames(data: bytes | bytearray) -> tuple[list[bytearray], int, int]:
    """Cut `data` into frames by their length fields.

    Returns:
        The frames (whole ones only; their checksums are not looked at yet), how many bytes from the
        start are used up (what follows is the beginning of a frame), and how many bytes belonged to no frame.
    """
    frames: list[bytearray] = []
    position, skipped, end = 0, 0, len(data)
    while position < end:
        magic = data[position]
        if magic not in (MAGIC_V1, MAGIC_V2):
            position += 1
            skipped += 1
            continue
        if position + 3 > end:
            break
        length = data[position + 1] + (8 if magic == MAGIC_V1 else 12)
        if magic == MAGIC_V2 and data[position + 2] & SIGNED_FLAG:
            length += 13
        if position + length > end:
            break
        frames.append(bytearray(data[position : position + length]))
        position += length
    return frames, position, skipped


class StreamFramer:
    """Frames out of a byte stream (TCP, serial), where one read may hold half a frame or several.

    A frame whose checksum turns out wrong is handed back by `reject`, so that a false start byte inside
    noise costs one byte and not the good frame behind it.
    """

    def __init__(self) -> None:
        self._rest = bytearray()
        self.skipped_bytes = 0

    def feed(self, data: bytes) -> list[bytearray]:
        """Add bytes, return the frames that are now complete."""
        self._rest += data
        frames, used, skipped = split_frames(self._rest)
        self.skipped_bytes += skipped
        del self._rest[:used]
        return frames

    def reject(self, frame: bytearray) -> list[bytearray]:
        """Search a frame that failed its checksum for frames hidden behind its first byte."""
        frames, used, skipped = split_frames(frame[1:])
        self.skipped_bytes += skipped + 1
        self._rest[:0] = frame[1 + used :]
        return frames
