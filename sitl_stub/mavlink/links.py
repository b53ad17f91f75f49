"""Clients and sockets of the stub, whatever carries the bytes (`udp.py`, `tcp.py`), and their addresses.

A `Link` is one client; a `Port` is one socket that may carry several. Only loopback and local addresses are
sensible here; nothing is encrypted or signed.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Mapping
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
LARGEST_DATAGRAM = 65535
MOST_AT_ONCE = 1000
"""Datagrams read before anything else is looked at."""
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
