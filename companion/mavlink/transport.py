"""The wires: UDP, TCP and serial, all non-blocking, all with the same four methods.

`receive` never blocks; `wait` blocks until there is something to receive or the time is over. What comes
back is a list of chunks; `datagrams` says whether a chunk stands alone (UDP) or continues a stream.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import time
from typing import Protocol

from companion.config.errors import UserError
from companion.mavlink.endpoint import Endpoint, EndpointKind

RECEIVE_BUFFER_BYTES = 1 << 20
CHUNKS_PER_READ = 64  # bounds how long one `receive` can keep the control thread under a flood


class Transport(Protocol):
    """A wire to an autopilot."""

    datagrams: bool

    def wait(self, timeout_s: float) -> bool:
        """Block until something can be received, at most `timeout_s`; say whether something can."""
        ...

    def receive(self) -> list[bytes]:
        """All chunks waiting now (bounded), without blocking."""
        ...

    def send(self, data: bytes) -> bool:
        """Send one frame without blocking; False when it could not go out now."""
        ...

    def close(self) -> None:
        """Close the wire."""
        ...


class UdpTransport:
    """UDP, listening (the peer is whoever speaks MAVLink first) or speaking first to a fixed address."""

    datagrams = True

    def __init__(self, endpoint: Endpoint) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self._socket.setblocking(False)
        self._fixed_peer = endpoint.kind is EndpointKind.UDP_OUT
        self.peer: tuple[str, int] | None = None
        self._last_sender: tuple[str, int] | None = None
        try:
            if self._fixed_peer:
                self.peer = (socket.gethostbyname(endpoint.host), endpoint.number)
                self._socket.bind(("0.0.0.0", 0))
            else:
                self._socket.bind((endpoint.host, endpoint.number))
        except OSError as error:
            self._socket.close()
            raise _cannot_open(endpoint, error) from None

    def wait(self, timeout_s: float) -> bool:
        """See `Transport.wait`."""
        return bool(select.select([self._socket], [], [], max(0.0, timeout_s))[0])

    def receive(self) -> list[bytes]:
        """See `Transport.receive`. Once the peer is known, other senders' datagrams are dropped unread."""
        chunks = []
        for _ in range(CHUNKS_PER_READ):
            try:
                data, sender = self._socket.recvfrom(65535)
            except BlockingIOError:
                break
            except OSError:  # ICMP port unreachable: the peer is gone for now; silence is handled above
                continue
            if self.peer is None:
                self._last_sender = sender
                chunks.append(data)
                break  # its frames have to be believed before this sender becomes the peer
            if sender == self.peer:
                chunks.append(data)
        return chunks

    def believe_sender(self) -> None:
        """The last datagram held a good frame of an autopilot: answer there, and hear nobody else."""
        if self.peer is None:
            self.peer = self._last_sender

    def send(self, data: bytes) -> bool:
        """See `Transport.send`."""
        if self.peer is None:
            return False
        try:
            self._socket.sendto(data, self.peer)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class StreamTransport:
    """TCP or serial: one file descriptor, bytes in order. A closed connection is told by `ConnectionError`."""

    datagrams = False

    def __init__(self, endpoint: Endpoint, connect_timeout_s: float) -> None:
        self._listener: socket.socket | None = None
        self._unsent = bytearray()
        self._endpoint = endpoint
        try:
            if endpoint.kind is EndpointKind.SERIAL:
                self._file = _open_serial(endpoint)
            elif endpoint.kind is EndpointKind.TCP_SERVER:
                self._file = self._accept(endpoint, connect_timeout_s)
            else:
                self._file = _connect(endpoint, connect_timeout_s)
        except OSError as error:
            raise _cannot_open(endpoint, error) from None

    def _accept(self, endpoint: Endpoint, timeout_s: float) -> int:
        self._listener = socket.create_server((endpoint.host, endpoint.number))
        self._listener.settimeout(timeout_s)
        try:
            connection, _ = self._listener.accept()
        except TimeoutError:
            self._listener.close()
            raise UserError(
                f"endpoint {endpoint}: nobody connected within {timeout_s:.0f} s; "
                "point the autopilot's TCP client at this address"
            ) from None
        return _detached(connection)

    def wait(self, timeout_s: float) -> bool:
        """See `Transport.wait`."""
        return bool(select.select([self._file], [], [], max(0.0, timeout_s))[0])

    def receive(self) -> list[bytes]:
        """See `Transport.receive`.

        Raises:
            ConnectionError: when the other side closed the connection or the device is gone.
        """
        try:
            data = os.read(self._file, 65536)
        except BlockingIOError:
            return []
        except OSError as error:
            raise ConnectionError(f"endpoint {self._endpoint}: {os.strerror(error.errno or 0)}") from None
        if not data and self._endpoint.kind is not EndpointKind.SERIAL:
            raise ConnectionError(f"endpoint {self._endpoint}: the other side closed the connection")
        return [data] if data else []

    def send(self, data: bytes) -> bool:
        """See `Transport.send`. A frame once begun is finished first; one that finds no room is dropped whole."""
        if self._unsent and not self._flush():
            return False
        self._unsent += data
        self._flush()
        return True

    def _flush(self) -> bool:
        try:
            del self._unsent[: os.write(self._file, self._unsent)]
        except BlockingIOError:
            return False
        except OSError as error:
            raise ConnectionError(f"endpoint {self._endpoint}: {os.strerror(error.errno or 0)}") from None
        return not self._unsent

    def close(self) -> None:
        """Close the connection."""
        os.close(self._file)
        if self._listener is not None:
            self._listener.close()


def open_transport(endpoint: Endpoint, connect_timeout_s: float = 30.0) -> UdpTransport | StreamTransport:
    """Open the wire of an endpoint.

    Raises:
        UserError: when it cannot be opened (port taken, no such device, nobody answers), with the remedy.
    """
    if endpoint.kind in (EndpointKind.UDP_IN, EndpointKind.UDP_OUT):
        return UdpTransport(endpoint)
    return StreamTransport(endpoint, connect_timeout_s)


def _connect(endpoint: Endpoint, timeout_s: float) -> int:
    """Connect, trying again while nobody listens yet: simulators open their port late."""
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            return _detached(socket.create_connection((endpoint.host, endpoint.number), timeout=2.0))
        except (ConnectionRefusedError, TimeoutError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def _detached(connection: socket.socket) -> int:
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setblocking(False)
    return connection.detach()


def _open_serial(endpoint: Endpoint) -> int:
    import serial  # pyserial: only who has a serial port needs it

    try:
        port = serial.Serial(endpoint.host, endpoint.number, timeout=0, exclusive=True)
    except serial.SerialException as error:
        raise OSError(error.errno or errno.EIO, str(error)) from None
    file = os.dup(port.fileno())
    os.set_blocking(file, False)
    port.close()
    return file


_REMEDIES = {
    errno.EADDRINUSE: "another program has this port; stop it (a ground station? an earlier run?) or use another port",
    errno.EACCES: "no permission; for a serial port: add the user to the group dialout",
    errno.ENOENT: "no such device; is the cable in? `ls /dev/tty*` lists what there is",
    errno.ECONNREFUSED: "nobody listens there; is the autopilot or simulator running?",
    errno.EADDRNOTAVAIL: "this machine has no such address; use 0.0.0.0 to listen on all",
}


def _cannot_open(endpoint: Endpoint, error: OSError) -> UserError:
    remedy = _REMEDIES.get(error.errno or 0, "check the address and the cable")
    return UserError(f"endpoint {endpoint}: {error.strerror or error}; {remedy}")
