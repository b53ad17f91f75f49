"""UDP that speaks first (as PX4 does), and UDP that waits for clients."""

from __future__ import annotations

import contextlib
import socket
from typing import Any

from sitl_stub.mavlink.codec import FrameReader, Received
from sitl_stub.mavlink.links import LARGEST_DATAGRAM, MOST_AT_ONCE, Address, AddressError, Link

IP_RECVERR = 11  # Linux: report a refused datagram of an unconnected socket; Python names no constant for it
FULL_DATAGRAM = 1400
"""Bytes gathered into one: no network cuts it into pieces."""
MOST_CLIENTS_OF_A_PORT = 16


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
