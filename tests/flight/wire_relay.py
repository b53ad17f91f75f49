"""A relay between the stub and the companion, for what loopback UDP alone cannot do: other wires, broken ones, signed ones.

The stub's side is UDP. The companion's side is any `Wire` here. Everything runs in one thread of its own.
"""

from __future__ import annotations

import os
import pty
import select
import socket
import sys
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from pymavlink.dialects.v20 import all as mavlink

Change = Callable[[bytes], list[bytes]]


def unchanged(data: bytes) -> list[bytes]:
    return [data]


class Wire(Protocol):
    """The companion's side of the relay."""

    def sources(self) -> list[int]: ...

    def read(self, source: int) -> list[bytes]: ...

    def write(self, data: bytes) -> None: ...

    def close(self) -> None: ...


class UdpWire:
    """Speaks to a companion that listens. `move()` goes on from another port."""

    def __init__(self, port: int) -> None:
        self.to = ("127.0.0.1", port)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))

    def move(self) -> int:
        before, self.socket = self.socket, socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        before.close()
        return int(self.socket.getsockname()[1])

    def sources(self) -> list[int]:
        return [self.socket.fileno()]

    def read(self, source: int) -> list[bytes]:
        return [self.socket.recv(65535)]

    def write(self, data: bytes) -> None:
        self.socket.sendto(data, self.to)

    def close(self) -> None:
        self.socket.close()


class TcpWire:
    """A TCP server, as ArduPilot's simulation is. `drop()` ends the connection; the next client is taken again."""

    def __init__(self, port: int = 0) -> None:
        self.listener = socket.create_server(("127.0.0.1", port))
        self.port = int(self.listener.getsockname()[1])
        self.connection: socket.socket | None = None
        self.accepted = 0

    def drop(self) -> None:
        connection, self.connection = self.connection, None
        if connection is not None:
            connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def sources(self) -> list[int]:
        return [s.fileno() for s in (self.listener, self.connection) if s is not None]

    def read(self, source: int) -> list[bytes]:
        if source == self.listener.fileno():
            self.connection = self.listener.accept()[0]
            self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.accepted += 1
            return []
        connection = self.connection
        try:
            data = connection.recv(65536) if connection is not None else b""
        except ConnectionError:  # closed by the companion with bytes of ours unread
            data = b""
        if not data and connection is self.connection:
            self.connection = None
        return [data] if data else []

    def write(self, data: bytes) -> None:
        if self.connection is not None:
            try:
                self.connection.sendall(data)
            except ConnectionError:
                self.connection = None

    def close(self) -> None:
        self.drop()
        self.listener.close()


class Pace:
    """One direction of a UART: `bytes_s`, and a buffer of BURST_BYTES before one has to wait."""

    BURST_BYTES = 512  # what a UART's driver buffers

    def __init__(self, bytes_s: float) -> None:
        self.bytes_s = bytes_s
        self._credit, self._since = float(self.BURST_BYTES), time.monotonic()

    def wait(self, count: int) -> None:
        """Return when `count` more bytes are through."""
        now = time.monotonic()
        self._credit = min(self.BURST_BYTES, self._credit + (now - self._since) * self.bytes_s)
        self._since = now
        self._credit -= count
        if self._credit < 0.0:
            time.sleep(-self._credit / self.bytes_s)


class SerialWire:
    """A pseudo-terminal as a serial port of `baud` bit/s: 10 bits a byte each way, and no faster than that."""

    def __init__(self, path: Path, baud: int) -> None:
        self.path = path
        self.rate = baud / 10.0
        self.dropped = 0
        self.carried = 0  # to the companion
        self.received = 0  # from it
        self._open()

    def _open(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._slave))
        self._down, self._up = Pace(self.rate), Pace(self.rate)

    def pull(self) -> None:
        """Pull the plug: whoever has the port open is hung up on."""
        self.path.unlink()
        os.close(self._slave)
        os.close(self.master)
        self.master = -1

    def plug(self) -> None:
        self._open()

    def sources(self) -> list[int]:
        return [self.master] if self.master >= 0 else []

    def read(self, source: int) -> list[bytes]:
        try:
            data = os.read(self.master, 65536)
        except OSError:
            return []
        self.received += len(data)
        self._up.wait(len(data))
        return [data]

    def write(self, data: bytes) -> None:
        self._down.wait(len(data))
        try:
            self.carried += os.write(self.master, data)
        except OSError:
            self.dropped += len(data)

    def close(self) -> None:
        if self.master >= 0:
            self.pull()


class Relay(threading.Thread):
    """Carries bytes between the stub, which speaks to `stub_port` first, and a wire."""

    def __init__(self, stub_port: int, wire: Wire, down: Change = unchanged, up: Change = unchanged) -> None:
        super().__init__(daemon=True)
        self.wire = wire
        self.down, self.up = down, up
        self.mute = False
        self._stub = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stub.bind(("127.0.0.1", stub_port))
        self._stub_address: tuple[str, int] | None = None
        self._going = True
        self._orders: list[Callable[[], object]] = []

    def order(self, what: Callable[[], object]) -> None:
        """Have something done by the relay's own thread, between two packets."""
        self._orders.append(what)

    def run(self) -> None:
        while self._going:
            while self._orders:
                self._orders.pop(0)()
            ready = select.select([self._stub.fileno(), *self.wire.sources()], [], [], 0.01)[0]
            for source in ready:
                if source == self._stub.fileno():
                    data, self._stub_address = self._stub.recvfrom(65535)
                    for piece in [] if self.mute else self.down(data):
                        self.wire.write(piece)
                elif source in self.wire.sources():
                    for data in self.wire.read(source):
                        for piece in self.up(data):
                            if self._stub_address is not None:
                                self._stub.sendto(piece, self._stub_address)
        self._stub.close()
        self.wire.close()

    def __enter__(self) -> Relay:
        self._switch_interval_s = sys.getswitchinterval()
        sys.setswitchinterval(
            2e-4
        )  # the companion flies in this process: packets must not wait 5 ms for its GIL
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._going = False
        self.join()
        sys.setswitchinterval(self._switch_interval_s)


class SigningPeer:
    """Makes the stub an autopilot that signs (pymavlink's signing): what it says is signed, what it believes, too."""

    def __init__(self, key: bytes, stamp: int) -> None:
        self._plain = mavlink.MAVLink(None)
        self._plain.robust_parsing = True
        self._signed = mavlink.MAVLink(None)
        self._signed.signing.secret_key = key
        self._signed.signing.sign_outgoing = True
        self._signed.signing.timestamp = stamp
        self._up = mavlink.MAVLink(None)
        self.refused = 0
        self.believed = 0
        self.latest = b""

    def down(self, datagram: bytes) -> list[bytes]:
        frames = []
        for message in self._plain.parse_buffer(bytearray(datagram)) or []:
            if message.get_msgId() < 0:
                continue
            self._signed.srcSystem, self._signed.srcComponent = (
                message.get_srcSystem(),
                message.get_srcComponent(),
            )
            self._signed.seq = message.get_seq()
            self.latest = bytes(message.pack(self._signed))
            frames.append(self.latest)
        return [b"".join(frames)] if frames else []

    def up(self, datagram: bytes) -> list[bytes]:
        try:
            message = self._signed.decode(bytearray(datagram))
        except mavlink.MAVError:
            self.refused += 1
            return []
        self.believed += 1
        self._up.srcSystem, self._up.srcComponent = message.get_srcSystem(), message.get_srcComponent()
        self._up.seq = message.get_seq()
        return [bytes(message.pack(self._up))]
