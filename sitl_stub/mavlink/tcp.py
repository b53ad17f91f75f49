"""A TCP server, as ArduPilot's simulator has one."""

from __future__ import annotations

import contextlib
import socket
from dataclasses import dataclass, field
from typing import Any

from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import LARGEST_DATAGRAM, MOST_AT_ONCE, Address, AddressError, Link


class TcpLink(Link):
    """A client connected over TCP. What the socket cannot take at once waits in a bounded buffer."""

    MOST_WAITING_BYTES = 4 << 20

    def __init__(self, connection: socket.socket, address: Address, role: str) -> None:
        super().__init__(f"tcp {address[0]}:{address[1]}", role)
        self.connection = connection
        self.waiting = bytearray()

    def send_bytes(self, frame: bytes) -> None:
        """Queue and send; frames beyond the buffer's bound are lost."""
        if len(self.waiting) > self.MOST_WAITING_BYTES:
            self.traffic.overflows += 1
            return
        self.waiting += frame
        if not self.gathers:
            self.flush()

    def send_gathered(self) -> None:
        """See `Link.send_gathered`."""
        self.flush()

    def flush(self) -> None:
        """Send what the socket takes."""
        try:
            while self.waiting:
                sent = self.connection.send(self.waiting)
                del self.waiting[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self.open = False


@dataclass(slots=True)
class TcpPort:
    """A TCP server; every connection is a link."""

    local: Address
    role: str
    links: list[Link] = field(default_factory=list)
    server: socket.socket = field(init=False)

    def __post_init__(self) -> None:
        self.server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self.server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.server.setblocking(False)
        try:
            self.server.bind(self.local)
            self.server.listen(8)
        except OSError as error:
            self.server.close()
            raise AddressError(
                f"TCP port {self.local[1]} on {self.local[0]} cannot be used ({error.strerror}): "
                "stop the program that has it, or choose another (--port 0 finds free ones)"
            ) from None
        self.local = self.server.getsockname()[:2]

    def sockets(self) -> list[socket.socket]:
        """The listener and every connection."""
        return [self.server, *(link.connection for link in self.links if isinstance(link, TcpLink))]

    def receive(self, ready: socket.socket, most: int = MOST_AT_ONCE) -> list[tuple[Link, list[Received]]]:
        """Accept a client or read from one."""
        if ready is self.server:
            with contextlib.suppress(OSError):
                connection, address = self.server.accept()
                connection.setblocking(False)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                client = TcpLink(connection, address[:2], self.role)
                client.heard = True
                self.links.append(client)
            return []
        for link in list(self.links):
            if isinstance(link, TcpLink) and link.connection is ready:
                try:
                    data = ready.recv(LARGEST_DATAGRAM)
                except BlockingIOError:
                    return []
                except OSError:
                    data = b""
                if not data:
                    link.open = False
                    self.links.remove(link)
                    ready.close()
                    return []
                return [(link, link.reader.read_stream(data))]
        return []

    def describe(self) -> dict[str, Any]:
        """Address and the endpoint a client would use."""
        return {
            "kind": "tcp-server",
            "local": list(self.local),
            "endpoint": f"tcp:{self.local[0]}:{self.local[1]}",
        }

    def close(self) -> None:
        """Close the listener and every connection."""
        self.server.close()
        for link in self.links:
            if isinstance(link, TcpLink):
                link.connection.close()
