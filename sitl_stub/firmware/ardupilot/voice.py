"""ArduCopter's STATUSTEXT: chunks of 50 bytes, sent after what they explain."""

from __future__ import annotations

from sitl_stub.firmware.common.voice import STATUSTEXT_BYTES, Voice
from sitl_stub.mavlink.links import Link


class ArduPilotVoice(Voice):
    """The voice of one ArduCopter."""

    def __init__(self) -> None:
        super().__init__()
        self.forget()

    def forget(self) -> None:
        """Start anew: nothing waits, texts are numbered from 1."""
        self._number = 0
        self._waiting: list[tuple[Link, int, str, int, int]] = []

    def say(self, severity: int, text: str) -> None:
        """STATUSTEXT to every client; longer than 50 bytes goes in chunks under one id."""
        self.note(text)
        for link in self.links:
            self.say_to(link, severity, text)

    def say_to(self, link: Link, severity: int, text: str) -> None:
        """STATUSTEXT to one client."""
        starts = range(0, len(text), STATUSTEXT_BYTES)
        chunks = [text[start : start + STATUSTEXT_BYTES] for start in starts] or [""]
        number = 0
        if len(chunks) > 1:
            self._number = self._number % 65535 + 1
            number = self._number
        for index, chunk in enumerate(chunks):
            self._waiting.append((link, severity, chunk, number, index))

    def send_waiting(self) -> int:
        """Send what has been said since the last time; returns how many messages."""
        texts, self._waiting = self._waiting, []
        for link, severity, text, number, chunk in texts:
            link.send("STATUSTEXT", severity=severity, text=text, id=number, chunk_seq=chunk)
        return len(texts)
