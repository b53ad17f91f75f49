"""Where references come from: a UDP port, or standard input. Nothing here waits, and nothing is parsed.

One client at a time. Whoever proves himself first is heard alone until he is silent or lets go: the kernel drops
everybody else's datagrams then (`mavlink/sender_filter.py`), and tells how many: a flood costs the control thread nothing.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
from typing import Protocol

from companion.config.errors import UserError
from companion.live.json_points import LONGEST_BYTES
from companion.mavlink.sender_filter import hear_everybody, hear_only
from companion.mavlink.transport import Address, resolve

_SO_RXQ_OVFL = (
    40  # <asm-generic/socket.h>: how many datagrams this socket has dropped, with each that is read
)
_COUNT = struct.Struct("=I")
_STRANGERS_AT_ONCE = 8
_QUEUE_BYTES = 1 << 16
STANDARD_INPUT = 0


class Source(Protocol):
    """What hears a client."""

    dropped: int
    """Strangers' datagrams, and those for which there was no room."""

    def take(self) -> bytes | None:
        """The next datagram or line; None when there is none."""
        ...

    def believe(self) -> None:
        """Whoever sent the last one is our client."""
        ...

    def let_go(self) -> None:
        """We have no client any more."""
        ...

    def answer(self, data: bytes) -> None:
        """Tell the sender of the last one something, if he can be told."""
        ...

    def close(self) -> None:
        """Close it."""
        ...


class NoSource:
    """Hears nobody: before listening begins, and in a replay."""

    dropped = 0

    def take(self) -> bytes | None:
        """See `Source`."""
        return None

    def believe(self) -> None:
        """See `Source`."""

    def let_go(self) -> None:
        """See `Source`."""

    def answer(self, data: bytes) -> None:
        """See `Source`."""

    def close(self) -> None:
        """See `Source`."""


class UdpSource:
    """Listens on a UDP port."""

    def __init__(self, address: tuple[str, int], what: str) -> None:
        """Listen on `address`; `what` names it in words.

        Raises:
            UserError: the address cannot be listened on.
        """
        try:
            family, place = resolve(*address, socket.SOCK_DGRAM, True)
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _QUEUE_BYTES)
            if sys.platform == "linux":
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
            self._socket.bind(place)
        except OSError as error:
            raise UserError(
                f"{what}: {error.strerror or error}; is another program listening there? 0.0.0.0 listens on all addresses"
            ) from None
        self._client: Address | None = None
        self._sender: Address | None = None
        self._read_and_dropped = self._dropped_by_kernel = 0

    @property
    def address(self) -> tuple[str, int]:
        """Where we listen."""
        host, port, *_ = self._socket.getsockname()
        return str(host), int(port)

    @property
    def dropped(self) -> int:
        """See `Source`."""
        return self._read_and_dropped + self._dropped_by_kernel

    def take(self) -> bytes | None:
        """See `Source`."""
        for _ in range(_STRANGERS_AT_ONCE):
            try:
                data, notes, _, sender = self._socket.recvmsg(
                    LONGEST_BYTES + 1, socket.CMSG_SPACE(_COUNT.size)
                )
            except OSError:  # nothing there, or an answer that found nobody
                return None
            for level, kind, note in notes:
                if (level, kind) == (socket.SOL_SOCKET, _SO_RXQ_OVFL):
                    (self._dropped_by_kernel,) = _COUNT.unpack(note[: _COUNT.size])
            if self._client in (None, sender):
                self._sender = sender
                return data
            self._read_and_dropped += 1
        return None

    def believe(self) -> None:
        """See `Source`."""
        if self._client is None and self._sender is not None:
            self._client = self._sender
            hear_only(self._socket, self._sender)

    def let_go(self) -> None:
        """See `Source`."""
        if self._client is not None:
            self._client = None
            hear_everybody(self._socket)

    def answer(self, data: bytes) -> None:
        """See `Source`."""
        if self._sender is not None:
            try:
                self._socket.sendto(data, self._sender)
            except OSError:
                return  # he does not listen

    def close(self) -> None:
        """See `Source`."""
        self._socket.close()


class LineSource:
    """Reads lines from a file descriptor that somebody else opened: standard input. Its end is the end of the flight."""

    def __init__(self) -> None:
        """Raises UserError where nothing can be read."""
        self._file = STANDARD_INPUT
        self._arrivals = select.poll()
        try:
            self._arrivals.register(self._file, select.POLLIN)
        except OSError as error:
            raise UserError(f"live:stdin: standard input: {error.strerror}") from None
        self._text = bytearray()
        self._over = self._skipping = False
        self.dropped = 0

    def take(self) -> bytes | None:
        """See `Source`. Of a line that never ends the beginning is given, the rest passed over."""
        line = self._line()
        if line is None and not self._over and self._arrivals.poll(0):
            data = os.read(self._file, _QUEUE_BYTES)
            self._over = not data
            self._text += data or b"\n"  # the last line may have none
            line = self._line()
        if line is None and self._over:
            return b'{"end": true}'
        return line

    def _line(self) -> bytes | None:
        while True:
            end = self._text.find(b"\n")
            if end < 0:
                if len(self._text) <= LONGEST_BYTES:
                    return None
                line = b"" if self._skipping else bytes(self._text)
                self._text.clear()
                self._skipping = True
                return line or None
            line = bytes(self._text[:end]).strip()
            del self._text[: end + 1]
            skipped, self._skipping = self._skipping, False
            if line and not skipped:
                return line

    def believe(self) -> None:
        """See `Source`: there is only one."""

    def let_go(self) -> None:
        """See `Source`."""

    def answer(self, data: bytes) -> None:
        """See `Source`: there is no way back."""

    def close(self) -> None:
        """See `Source`: it is not ours."""
