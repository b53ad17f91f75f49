"""Where clients connect: doors that listen, and the wire of each client behind them.

A client gets a socket of its own, on UDP too (bound to the door's port and connected to the client), so that a flood of
one client, or of a stranger at the door, fills nobody else's queue in the kernel.
"""

from __future__ import annotations

import socket
import time
from collections import Counter
from typing import Protocol

from companion.config.errors import UserError
from companion.mavlink.endpoint import Endpoint, EndpointKind, parse_endpoint
from companion.mavlink.framing import frame_length
from companion.mavlink.received import read
from companion.mavlink.transport import (
    RECEIVE_BUFFER_BYTES,
    Address,
    StreamTransport,
    UdpTransport,
    open_transport,
    resolve,
)

MOST_CLIENTS = 16
"""At one door."""
CHUNKS_AT_ONCE = 8
"""Read from one client before the others, and the autopilot, have their turn."""
REPLACED_AFTER_S = 10.0
"""Where a door is full, a client silent for so long makes place."""
REFUSED_FOR_S = 3.0
"""A client whose port has been closed for so long, and who says nothing, is gone."""
UNSENT_BYTES = 1 << 18
"""What a TCP client may be behind; beyond that it loses whole messages."""


class Client(Protocol):
    """One client's wire. None of the methods waits."""

    datagrams: bool

    def fileno(self) -> int:
        """To wait on; −1: not now."""
        ...

    def receive(self) -> list[bytes]:
        """What has come, CHUNKS_AT_ONCE chunks at most."""
        ...

    def send(self, data: bytes) -> bool:
        """Send whole frames; False where there was no room for them."""
        ...

    @property
    def gone(self) -> bool:
        """Whether it will not be heard of again."""
        ...

    def close(self) -> None:
        """Close it."""
        ...


class Door(Protocol):
    """What clients come through."""

    clients: list[Client]
    counters: Counter[str]

    def fileno(self) -> int:
        """To wait on; −1: nobody comes this way but who is there."""
        ...

    def open(self) -> list[tuple[Client, bytes]]:
        """Let in who waits; returns what they have said meanwhile."""
        ...

    def close(self) -> None:
        """Close it, and all behind it."""
        ...


class UdpClient:
    """A client that spoke to a `UdpDoor`."""

    datagrams = True

    def __init__(self, door: socket.socket, sender: Address) -> None:
        self._socket = socket.socket(door.family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.bind(door.getsockname())
        self._socket.connect(sender)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        self._refused_since_s: float | None = None
        self.sender = sender
        self.heard_s = time.monotonic()

    def fileno(self) -> int:
        """See `Client`."""
        return self._socket.fileno()

    def share_port(self, wanted: bool) -> None:
        """Whether another socket may be bound to the same port now."""
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(wanted))

    def receive(self) -> list[bytes]:
        """See `Client`."""
        chunks = []
        for _ in range(CHUNKS_AT_ONCE):
            try:
                chunks.append(self._socket.recv(65535))
            except BlockingIOError:
                break
            except OSError:  # ICMP port unreachable
                self._note_refused()
        if chunks:
            self.heard_s, self._refused_since_s = time.monotonic(), None
        return chunks

    def send(self, data: bytes) -> bool:
        """See `Client`."""
        try:
            self._socket.send(data)
        except BlockingIOError:
            return False
        except OSError:
            self._note_refused()
            return False
        return True

    def _note_refused(self) -> None:
        if self._refused_since_s is None:
            self._refused_since_s = time.monotonic()

    @property
    def gone(self) -> bool:
        """See `Client`."""
        since_s = self._refused_since_s
        return since_s is not None and time.monotonic() - max(since_s, self.heard_s) > REFUSED_FOR_S

    def close(self) -> None:
        """See `Client`."""
        self._socket.close()


class UdpDoor:
    """Listens on a UDP port; every sender of MAVLink becomes a client."""

    def __init__(self, endpoint: Endpoint) -> None:
        """Raises UserError where the port cannot be had."""
        self.clients: list[Client] = []
        self.counters: Counter[str] = Counter()
        try:
            family, address = resolve(endpoint.host, endpoint.number, socket.SOCK_DGRAM, True)
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            self._socket.bind(address)
        except OSError as error:
            raise _cannot_listen(endpoint, error) from None

    def fileno(self) -> int:
        """See `Door`."""
        return self._socket.fileno()

    def open(self) -> list[tuple[Client, bytes]]:
        """See `Door`. What is not MAVLink is dropped and counted."""
        said: list[tuple[Client, bytes]] = []
        for _ in range(CHUNKS_AT_ONCE):
            try:
                data, sender = self._socket.recvfrom(65535)
            except OSError:
                break
            client = next((each for each in self._udp_clients() if each.sender == sender), None)
            if client is None:
                client = self._let_in(data, sender)
            if client is not None:
                said.append((client, data))
        return said

    def _udp_clients(self) -> list[UdpClient]:
        return [each for each in self.clients if isinstance(each, UdpClient)]

    def _let_in(self, data: bytes, sender: Address) -> UdpClient | None:
        length = frame_length(data, 0) if data else None
        if not length or read(data[:length]) is None:
            self.counters["strangers' datagrams"] += 1
            return None
        clients = self._udp_clients()
        if len(clients) >= MOST_CLIENTS:
            oldest = min(clients, key=lambda each: each.heard_s)
            if time.monotonic() - oldest.heard_s < REPLACED_AFTER_S:
                self.counters["turned away: too many clients"] += 1
                return None
            self.clients.remove(oldest)
            oldest.close()
            clients.remove(oldest)
        self._share_port(True)
        try:
            client = UdpClient(self._socket, sender)
        except OSError:
            self.counters["clients that could not be let in"] += 1
            return None
        finally:
            self._share_port(False)
        self.clients.append(client)
        return client

    def _share_port(self, wanted: bool) -> None:
        """For a moment only: another program must not get a port that is ours."""
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(wanted))
        for each in self._udp_clients():
            each.share_port(wanted)

    def close(self) -> None:
        """See `Door`."""
        self._socket.close()
        for each in self.clients:
            each.close()


class TcpClient:
    """A client that connected to a `TcpDoor`."""

    datagrams = False

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection
        self._unsent = bytearray()
        self._gone = False

    def fileno(self) -> int:
        """See `Client`."""
        return -1 if self._gone else self._socket.fileno()

    def receive(self) -> list[bytes]:
        """See `Client`."""
        try:
            data = self._socket.recv(65536)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        self._gone = self._gone or not data
        return [data] if data else []

    def send(self, data: bytes) -> bool:
        """See `Client`. A frame once begun is finished first."""
        if self._unsent and not self.flush() and len(self._unsent) + len(data) > UNSENT_BYTES:
            return False
        self._unsent += data
        self.flush()
        return not self._gone

    def flush(self) -> bool:
        """Send what is left over; whether all of it went."""
        try:
            del self._unsent[: self._socket.send(self._unsent)]
        except BlockingIOError:
            return False
        except OSError:
            self._gone = True
            return False
        return not self._unsent

    @property
    def gone(self) -> bool:
        """See `Client`."""
        if self._unsent and not self._gone:
            self.flush()
        return self._gone

    def close(self) -> None:
        """See `Client`."""
        self._socket.close()


class TcpDoor:
    """Listens on a TCP port; every connection is a client."""

    def __init__(self, endpoint: Endpoint) -> None:
        """Raises UserError where the port cannot be had."""
        self.clients: list[Client] = []
        self.counters: Counter[str] = Counter()
        try:
            family, address = resolve(endpoint.host, endpoint.number, socket.SOCK_STREAM, True)
            self._socket = socket.create_server(address, family=family)
        except OSError as error:
            raise _cannot_listen(endpoint, error) from None
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """See `Door`."""
        return self._socket.fileno()

    def open(self) -> list[tuple[Client, bytes]]:
        """See `Door`."""
        try:
            connection = self._socket.accept()[0]
        except OSError:
            return []
        if len(self.clients) >= MOST_CLIENTS:
            connection.close()
            self.counters["turned away: too many clients"] += 1
        else:
            self.clients.append(TcpClient(connection))
        return []

    def close(self) -> None:
        """See `Door`."""
        self._socket.close()
        for each in self.clients:
            each.close()


class _OneClient:
    """A client at a known place: a UDP address that we speak to first, or a serial port."""

    def __init__(self, wire: UdpTransport | StreamTransport) -> None:
        self._wire = wire
        self.datagrams = wire.datagrams

    def fileno(self) -> int:
        """See `Client`."""
        return self._wire.fileno()

    def receive(self) -> list[bytes]:
        """See `Client`."""
        return self._wire.receive()

    def send(self, data: bytes) -> bool:
        """See `Client`."""
        return self._wire.send(data)

    @property
    def gone(self) -> bool:
        """See `Client`: it may always come back."""
        if self._wire.fileno() < 0:
            self._wire.wait(0.0)  # opens a serial port again
        return False

    def close(self) -> None:
        """See `Client`."""
        self._wire.close()


class OpenDoor:
    """The door of a client at a known place: there is nobody to wait for."""

    def __init__(self, endpoint: Endpoint) -> None:
        """Raises UserError where it cannot be opened."""
        speaks = endpoint.kind is EndpointKind.UDP_OUT
        wire = UdpTransport(endpoint, CHUNKS_AT_ONCE) if speaks else open_transport(endpoint)
        self.clients: list[Client] = [_OneClient(wire)]
        self.counters: Counter[str] = Counter()

    def fileno(self) -> int:
        """See `Door`."""
        return -1

    def open(self) -> list[tuple[Client, bytes]]:
        """See `Door`."""
        return []

    def close(self) -> None:
        """See `Door`."""
        for each in self.clients:
            each.close()


def open_door(text: str) -> Door:
    """The door of an address of `--clients`; what listens does so on this machine only, unless a host is named.

    Raises:
        UserError: it is no address, of no kind for clients, or cannot be had.
    """
    endpoint = parse_endpoint(text, listen_on="127.0.0.1")
    if endpoint.kind is EndpointKind.UDP_IN:
        return UdpDoor(endpoint)
    if endpoint.kind is EndpointKind.TCP_SERVER:
        return TcpDoor(endpoint)
    if endpoint.kind in (EndpointKind.UDP_OUT, EndpointKind.SERIAL):
        return OpenDoor(endpoint)
    raise UserError(
        f"--clients {text}: clients come to us (udpin:, tcpin:), listen on a UDP port (udpout:) or are at a serial port"
    )


def _cannot_listen(endpoint: Endpoint, error: OSError) -> UserError:
    return UserError(
        f"--clients {endpoint}: {error.strerror or error}; is another program listening there? "
        f"use another port, or 0.0.0.0 for all addresses of this machine"
    )
