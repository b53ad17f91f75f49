"""How many frames never came, by the numbers (modulo 256) of those that did."""

from __future__ import annotations

_NEVER, _SKIPPED = 0, 1  # beside the hashes of frames
BEFORE_THE_FIRST = 8  # frames that may come late when nothing is known of what was before


class SequenceCount:
    """A number up to 128 behind the expected one is a frame that came late or twice; or it is half a turn and more ahead.

    It came late where that number was skipped, twice where the frame is the same, and is ahead where another frame had
    that number.
    """

    def __init__(self) -> None:
        self._expected: int | None = None
        self._seen = [_NEVER] * 256  # of the last turn: hash of the frame with that number

    def lost_before(self, sequence: int, frame: bytes) -> int:
        """How many frames are missing between the last one in order and this one."""
        mark = hash(frame)
        gap = 0 if self._expected is None else (sequence - self._expected) % 256
        before = self._seen[sequence]
        if gap >= 128 and (
            before in (_SKIPPED, mark) or (before == _NEVER and gap >= 256 - BEFORE_THE_FIRST)
        ):
            self._seen[sequence] = mark
            return 0
        for number in range(gap):
            self._seen[(sequence - 1 - number) % 256] = _SKIPPED
        self._seen[sequence] = mark
        self._expected = (sequence + 1) % 256
        return gap
