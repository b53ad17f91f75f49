"""The sockets of the stub: UDP that speaks first (as PX4 does), UDP that waits, and a TCP server.

A `Link` is one client; a `Port` is one socket that may carry several. Only loopback and local addresses are
sensible here; nothing is encrypted or signed.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from sitl_stub.mavlink.codec import (
    LAYOUTS,
    FrameReader,
    FrameWriter,
    LinkCounters,
    MessageLayout,
    Received,
    pack_fields,
)
from sitl_stub.mavlink.traffic import LinkTraffic

Address = tuple[str, int]
IP_RECVERR = 11  # Linux: report a refused datagram of an unconnected socket; Python names no constant for it
LARGEST_DATAGRAM = 65535
FULL_DATAGRAM = 1400
"""Bytes gathered into one: no network cuts it into pieces."""
MOST_AT_ONCE = 1000
"""Datagrams read before anything else is looked at."""
MOST_CLIENTS_OF_A_PORT = 16
CLIENT_PORTS = (20000, 32000)
"""Where `reserve_client_port` looks."""


class AddressError(ValueError):
    """An address that cannot be read or used, with the remedy in the text."""


class Link:
    """One client of the autopilot: its counters, its protocol version and (owned by the firmware) its streams."""

    def __init__(self, name: str, role: str) -> None:
        self.name = name
        self.role = role
        """`onboard`, `gcs` or `tcp`: which default streams the firmware gives it."""
        self.counters = LinkCounters()
        self.traffic = LinkTraffic()
        self.reader = FrameReader(self.counters)
        self.writer = FrameWriter()
        self.open = True
        self.heard = False
        self.last_heard_us = 0
        self.refused = False
        """True when the last datagram found nobody at the address (Linux reports it on loopback)."""
        self.firmware_data: Any = None
        self.muted: Mapping[int, int] = {}
        """Messages, by id, that are not sent at all: faults of the autopilot's streams."""
        self.outgoing: Callable[[MessageLayout, bytes], None] | None = None
        """What a frame goes through instead of `send_bytes`: faults of the link."""
        self.overtaking: Callable[[MessageLayout, tuple[Any, ...]], None] | None = None
        """What sends a message past frames that are still on their way."""
        self.gathers = False
        """Whether frames wait for `send_gathered`. In lockstep those of one instant leave together: a client that is
        woken by the first of them while the next is being made goes to sleep and wakes again, for each."""

    def send_frame(self, layout: MessageLayout, values: tuple[Any, ...]) -> None:
        """Send one message given its values in wire order."""
        if (layout.message_id > 255 and self.writer.version == 1) or layout.message_id in self.muted:
            return
        frame = self.writer.frame(layout, values)
        self.counters.sent += 1
        self.traffic.sent += 1
        self.traffic.sent_bytes += len(frame)
        if self.outgoing is None:
            self.send_bytes(frame)
        else:
            self.outgoing(layout, frame)

    def send_past_faults(self, layout: MessageLayout, values: tuple[Any, ...]) -> None:
        """Send one message that no fault touches: the questions of lockstep."""
        self.counters.sent += 1
        if self.overtaking is None:
            self.send_bytes(self.writer.frame(layout, values))
        else:
            self.overtaking(layout, values)

    def send(self, name: str, **fields: Any) -> None:
        """Send one message by field names; fields left out are zero."""
        layout = LAYOUTS[name]
        self.send_frame(layout, pack_fields(layout, fields))

    def send_payload(self, layout: MessageLayout, payload: bytes) -> None:
        """Send one message whose payload is already packed."""
        if layout.message_id in self.muted:
            return
        frame = self.writer.frame_of_payload(layout, payload)
        self.counters.sent += 1
        self.traffic.sent += 1
        self.traffic.sent_bytes += len(frame)
        if self.outgoing is None:
            self.send_bytes(frame)
        else:
            self.outgoing(layout, frame)

    def send_bytes(self, frame: bytes) -> None:
        """Hand one frame to the socket."""
        raise NotImplementedError

    def send_apart(self, frame: bytes) -> None:
        """Hand over one frame that must not share a datagram with others: a damaged one would take them along."""
        self.send_bytes(frame)

    def send_gathered(self) -> None:
        """Hand over what has been gathered."""


class MemoryLink(Link):
    """A link without a socket: frames are kept in `frames`, for tests and for use inside one process."""

    def __init__(self, name: str = "memory", role: str = "onboard") -> None:
        super().__init__(name, role)
        self.frames: list[bytes] = []
        self._decoder = FrameReader()

    def send_bytes(self, frame: bytes) -> None:
        """Keep the frame."""
        self.frames.append(frame)

    def take(self) -> list[Received]:
        """Messages sent since the last call, decoded."""
        frames, self.frames = self.frames, []
        return [message for frame in frames for message in self._decoder.read_datagram(frame)]


class Port(Protocol):
    """A socket of the stub."""

    links: list[Link]

    def sockets(self) -> list[socket.socket]:
        """Sockets to wait on."""

    def receive(self, ready: socket.socket, most: int = MOST_AT_ONCE) -> list[tuple[Link, list[Received]]]:
        """Messages waiting at one of `sockets()`, of `most` reads of it; new clients appear in `links`."""

    def describe(self) -> dict[str, Any]:
        """The address as it goes into the ready line."""

    def close(self) -> None:
        """Close every socket."""


class UdpLink(Link):
    """A client at a UDP address."""

    def __init__(self, port: UdpPort, address: Address, role: str) -> None:
        super().__init__(f"udp {address[0]}:{address[1]}", role)
        self.port = port
        self.address = address
        self._gathered: list[bytes] = []

    def send_bytes(self, frame: bytes) -> None:
        """Send one datagram; a full buffer or an absent client loses it, as on a real link."""
        if self.gathers:
            self._gathered.append(frame)
        else:
            self._send(frame)

    def send_apart(self, frame: bytes) -> None:
        """See `Link.send_apart`."""
        self.send_gathered()
        self._send(frame)

    def send_gathered(self) -> None:
        """See `Link.send_gathered`: in as few datagrams as have room for them."""
        frames, self._gathered = self._gathered, []
        first, size = 0, 0
        for index, frame in enumerate(frames):
            if size + len(frame) > FULL_DATAGRAM and size:
                self._send(b"".join(frames[first:index]))
                first, size = index, 0
            size += len(frame)
        if size:
            self._send(b"".join(frames[first:]))

    def _send(self, frame: bytes) -> None:
        try:
            self.port.socket.sendto(frame, self.address)
            self.refused = False
        except ConnectionRefusedError:
            # The refusal belongs to an earlier datagram; this one was not sent, so it is tried once more.
            self.refused = True
            with contextlib.suppress(OSError):
                self.port.socket.sendto(frame, self.address)
        except OSError:
            pass


class UdpPort:
    """A UDP socket. With `remote` it speaks first, from `local`; without, it waits for clients."""

    def __init__(self, local: Address, remote: Address | None, role: str) -> None:
        self.role = role
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        with contextlib.suppress(OSError):
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
        with contextlib.suppress(OSError):
            self.socket.setsockopt(socket.SOL_IP, IP_RECVERR, 1)
        try:
            self.socket.bind(local)
        except OSError as error:
            self.socket.close()
            raise AddressError(
                f"UDP port {local[1]} on {local[0]} cannot be used ({error.strerror}): "
                "stop the program that has it, or choose another (--port 0 finds free ones)"
            ) from None
        self.local: Address = self.socket.getsockname()[:2]
        self.remote = remote
        self.links: list[Link] = []
        self.strangers = FrameReader()
        """Reads, and counts, what comes from addresses that are no client yet."""
        self._by_address: dict[Address, UdpLink] = {}
        if remote is not None:
            self._add(remote)

    def _add(self, address: Address) -> UdpLink:
        link = UdpLink(self, address, self.role)
        self.links.append(link)
        self._by_address[address] = link
        return link

    def _link_for(self, address: Address) -> UdpLink:
        """The link a new address gets."""
        if self.remote is not None and len(self.links) == 1 and not self.links[0].heard:
            # As PX4: until the configured address answers, whoever speaks first becomes the partner.
            first = self.links[0]
            assert isinstance(first, UdpLink)
            del self._by_address[first.address]
            first.address = address
            first.name = f"udp {address[0]}:{address[1]}"
            self._by_address[address] = first
            return first
        if len(self.links) >= MOST_CLIENTS_OF_A_PORT:
            oldest = min(self.links, key=lambda item: item.last_heard_us)
            assert isinstance(oldest, UdpLink)
            self.drop(oldest)
        return self._add(address)

    def drop(self, link: UdpLink) -> None:
        """Forget a client."""
        link.open = False
        self.links.remove(link)
        del self._by_address[link.address]

    def sockets(self) -> list[socket.socket]:
        """The one socket."""
        return [self.socket]

    def receive(self, ready: socket.socket, most: int = MOST_AT_ONCE) -> list[tuple[Link, list[Received]]]:
        """`most` datagrams of those waiting, in order of arrival."""
        batches: list[tuple[Link, list[Received]]] = []
        for _ in range(most):
            try:
                data, address = ready.recvfrom(LARGEST_DATAGRAM)
            except BlockingIOError:
                break
            except ConnectionRefusedError:
                for link in self.links:
                    if isinstance(link, UdpLink) and len(self.links) == 1:
                        link.refused = True
                continue
            except OSError:
                break
            known = self._by_address.get(address)
            # A stranger becomes a client (or the partner) only with a frame that can be read.
            messages = (self.strangers if known is None else known.reader).read_datagram(data)
            if messages:
                link = known if known is not None else self._link_for(address)
                link.heard = True
                link.refused = False
                batches.append((link, messages))
        if not batches:
            self._forget_errors()
        return batches

    def _forget_errors(self) -> None:
        """Empty the queue of refusals: while there is one, a selector finds the socket ready without end."""
        with contextlib.suppress(OSError):
            for _ in range(MOST_AT_ONCE):
                self.socket.recvmsg(1, 512, socket.MSG_ERRQUEUE)

    def describe(self) -> dict[str, Any]:
        """Local and, if any, remote address and the endpoint a client would use."""
        if self.remote is not None:
            return {
                "kind": "udp",
                "local": list(self.local),
                "remote": list(self.remote),
                "endpoint": f"udpin:{self.remote[0]}:{self.remote[1]}",
            }
        return {
            "kind": "udp-server",
            "local": list(self.local),
            "endpoint": f"udpout:{self.local[0]}:{self.local[1]}",
        }

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()


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


_reserved: list[socket.socket] = []


def reserve_client_port() -> int:
    """A UDP port on loopback for a client that will open it later; no other stub offers it while this process lives.

    The UDP port itself has to stay free for the client. What is held is the TCP port of the same number, as the sign
    to other stubs, and the number is below those that systems give to sockets of any port (Linux 32768, others 49152).

    Raises:
        AddressError: none is free.
    """
    numbers = range(*CLIENT_PORTS)
    first = os.getpid() * 7919 % len(numbers)
    for step in range(len(numbers)):
        number = numbers[(first + step) % len(numbers)]
        sign = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            sign.bind(("127.0.0.1", number))
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind(("127.0.0.1", number))
        except OSError:
            sign.close()
            continue
        _reserved.append(sign)
        return number
    raise AddressError(
        f"no UDP port from {CLIENT_PORTS[0]} to {CLIENT_PORTS[1]} is free; name one with --udp"
    )


def parse_address(text: str, what: str) -> Address:
    """`HOST:PORT` or `PORT` (loopback) as an address; raises AddressError."""
    host, _, port_text = text.rpartition(":")
    try:
        port = int(port_text)
    except ValueError:
        port = -1
    if not 0 <= port <= 65535:
        raise AddressError(
            f"{what} {text!r}: expected HOST:PORT with a port from 0 to 65535, for example 127.0.0.1:14540"
        )
    return (host or "127.0.0.1", port)
