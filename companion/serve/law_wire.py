"""The law's two wires to the forwarder: one to the autopilot, and one for what clients ask for."""

from __future__ import annotations

import select
import socket

from companion.flight.outcome import LinkLost
from companion.mavlink.transport import CHUNKS_PER_READ, Transport

GONE = "the process that passes messages on is gone"


class LawWire(Transport):
    """The autopilot, behind the forwarder: a socket of SOCK_SEQPACKET, whole datagrams both ways."""

    datagrams = True

    def __init__(self, wire: socket.socket) -> None:
        super().__init__()
        self._socket = wire
        self._socket.setblocking(False)
        self._arrivals = select.poll()
        self._arrivals.register(wire, select.POLLIN)

    def fileno(self) -> int:
        """See `Transport.fileno`."""
        return self._socket.fileno()

    def wait(self, timeout_s: float) -> bool:
        """See `Transport.wait`."""
        return bool(self._arrivals.poll(max(0.0, 1e3 * timeout_s)))

    def receive(self) -> list[bytes]:
        """See `Transport.receive`. Raises LinkLost when the forwarder is gone."""
        chunks: list[bytes] = []
        for _ in range(CHUNKS_PER_READ):
            data = received(self._socket)
            if data is None:
                break
            chunks.append(data)
        return chunks

    def send(self, data: bytes) -> bool:
        """See `Transport.send`."""
        try:
            self._socket.send(data)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close it."""
        self._socket.close()


def received(wire: socket.socket) -> bytes | None:
    """The next datagram of the forwarder, without waiting; None: there is none. Raises LinkLost when it is gone."""
    try:
        data = wire.recv(65535)
    except BlockingIOError:
        return None
    except OSError:
        raise LinkLost(GONE) from None
    if not data:
        raise LinkLost(GONE)
    return data
