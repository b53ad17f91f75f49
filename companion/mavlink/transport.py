"""The wires: UDP, TCP and serial, all non-blocking, all with the same methods.

`receive` never blocks; `wait` blocks until there is something to receive or the time is over. What comes
back is a list of chunks; `datagrams` says whether a chunk stands alone (UDP) or continues a stream.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import termios
import time
from collections import deque
from typing import cast

from companion.config.errors import UserError
from companion.mavlink.endpoint import Endpoint, EndpointKind
from companion.mavlink.sender_filter import hear_everybody, hear_only

RECEIVE_BUFFER_BYTES = 1 << 20
CHUNKS_PER_READ = 64  # bounds how long one `receive` can keep the control thread under a flood


Address = tuple[str, int] | tuple[str, int, int, int]
"""IPv4: host, port; IPv6: flow label and scope, too."""
PEER_SILENT_S = 1.0  # after this the autopilot may speak from another address: it started again
RETRY_S = 0.2  # between attempts to open a broken TCP or serial connection again
ATTEMPT_S = 0.2  # how long one attempt may keep the caller
FIRST_ATTEMPT_S = 2.0  # the same while nothing flies yet


class Transport:
    """A wire to an autopilot. The base class says which of its methods may be left out."""

    datagrams: bool

    def __init__(self) -> None:
        self.notices: deque[str] = deque(maxlen=32)
        """What happened to the wire, in sentences for the pilot; taken away by whoever shows them."""
        self.sender: object = None
        """Whose the chunks of the last `receive` are: a frame cut in two goes on in the same sender's next one."""
        self.strangers: deque[bytes] = deque(maxlen=CHUNKS_PER_READ)
        """What came from others than the peer while they are looked at (`look_out`)."""

    def wait(self, timeout_s: float) -> bool:
        """Block until something can be received, at most `timeout_s`; say whether something can."""
        raise NotImplementedError

    def fileno(self) -> int:
        """What to wait on together with other wires; −1 while there is none, and `wait` tries to open it again."""
        return -1

    def receive(self) -> list[bytes]:
        """All chunks waiting now (bounded), without blocking."""
        raise NotImplementedError

    def send(self, data: bytes) -> bool:
        """Send one frame without blocking; False when it could not go out now."""
        raise NotImplementedError

    def believe_sender(self) -> None:
        """The last chunk held a good frame of our autopilot: whoever sent it is our peer."""

    def greet_sender(self) -> None:
        """The last chunk came from somebody worth an answer, but not worth believing yet."""

    @property
    def not_open(self) -> str:
        """Why there has been no connection yet, and the remedy; empty once there was one, and where none is needed."""
        return ""

    def look_out(self, wanted: bool) -> None:
        """Whether to keep what others than the peer send, in `strangers`. Where all come over one wire, nothing to do."""

    def close(self) -> None:
        """Close the wire."""
        raise NotImplementedError


class UdpTransport(Transport):
    """UDP, listening (the peer is whoever speaks MAVLink first) or speaking first to a fixed address.

    A listening one hears nobody but its peer while the peer speaks. Once that has been silent for PEER_SILENT_S, a good
    frame of the same autopilot from another address makes that one the peer: a restarted router has a new port. Others'
    datagrams are dropped by the kernel while the peer speaks, so that no flood of them reaches the control thread, unless
    `look_out` asks for them. A broadcast address is spoken to until somebody answers, then that one only.
    """

    datagrams = True

    def __init__(self, endpoint: Endpoint, chunks_per_read: int = CHUNKS_PER_READ) -> None:
        """`chunks_per_read`: how many datagrams one `receive` returns at most."""
        super().__init__()
        self._chunks_per_read = chunks_per_read
        self._fixed_peer = endpoint.kind is EndpointKind.UDP_OUT
        self._peer_heard_s = 0.0
        self._last_sender: Address | None = None
        self._greeted: Address | None = None
        self.peer: Address | None = None
        self._filtered = False
        self._looking_out = False
        listens = endpoint.kind is EndpointKind.UDP_IN
        try:
            family, address = resolve(endpoint.host, endpoint.number, socket.SOCK_DGRAM, listens)
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
        except OSError as error:
            raise _cannot_open(endpoint, error) from None
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self._socket.setblocking(False)
        self._arrivals = select.poll()
        self._arrivals.register(self._socket, select.POLLIN)
        try:
            if listens:
                self._socket.bind(address)
            else:
                self._socket.bind(("::" if family == socket.AF_INET6 else "0.0.0.0", 0))
        except OSError as error:
            self._socket.close()
            raise _cannot_open(endpoint, error) from None
        if self._fixed_peer:
            self.peer = address
        elif not listens:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._greeted = address
        if self.peer is not None:
            self._filtered = hear_only(self._socket, self.peer)

    def fileno(self) -> int:
        """See `Transport.fileno`."""
        return self._socket.fileno()

    def wait(self, timeout_s: float) -> bool:
        """See `Transport.wait`."""
        if self._filtered and not self._fixed_peer and time.monotonic() - self._peer_heard_s > PEER_SILENT_S:
            hear_everybody(self._socket)
            self._filtered = False
        return bool(self._arrivals.poll(max(0.0, 1e3 * timeout_s)))

    def receive(self) -> list[bytes]:
        """See `Transport.receive`. While the peer speaks, other senders' datagrams are dropped unread."""
        chunks = []
        now_s = time.monotonic()
        for _ in range(self._chunks_per_read):
            try:
                data, sender = self._socket.recvfrom(65535)
            except BlockingIOError:
                break
            except OSError:  # ICMP port unreachable: the peer is gone for now; silence is handled above
                continue
            if sender == self.peer:
                self._peer_heard_s = now_s
                if not self._filtered and not self._looking_out:
                    self._filtered = hear_only(self._socket, sender)
                self.sender = sender
                chunks.append(data)
            elif self.peer is None or (not self._fixed_peer and now_s - self._peer_heard_s > PEER_SILENT_S):
                self._last_sender = self.sender = sender
                chunks.append(data)
                break  # its frames have to be believed before this sender becomes the peer
            elif self._looking_out:
                self.strangers.append(data)
        return chunks

    def believe_sender(self) -> None:
        """See `Transport.believe_sender`: answer there, and hear nobody else."""
        if self._last_sender is None or self._fixed_peer:
            return
        if self.peer is not None:
            host, port, *_ = self._last_sender
            self.notices.append(f"the autopilot now speaks from {host}:{port}")
        self.peer, self._last_sender = self._last_sender, None
        self._peer_heard_s = time.monotonic()
        self._filtered = (
            self.peer is not None and not self._looking_out and hear_only(self._socket, self.peer)
        )

    def look_out(self, wanted: bool) -> None:
        """See `Transport.look_out`."""
        self._looking_out = wanted and not self._fixed_peer
        if self._looking_out and self._filtered:
            hear_everybody(self._socket)
            self._filtered = False
        self.strangers.clear()

    def greet_sender(self) -> None:
        """See `Transport.greet_sender`: our frames go there until we have a peer."""
        self._greeted = self._last_sender

    def send(self, data: bytes) -> bool:
        """See `Transport.send`."""
        address = self.peer or self._greeted
        if address is None:
            return False
        try:
            self._socket.sendto(data, address)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class StreamTransport(Transport):
    """TCP or serial: one file descriptor, bytes in order.

    A TCP connection need not be there at the beginning: the other side may be started later, as with UDP. One that is
    not there yet, or that breaks, is opened with an attempt every RETRY_S; until then nothing is received and nothing
    can be sent. Whether that has taken too long is for others to say. A serial port has to be there.
    """

    datagrams = False

    def __init__(self, endpoint: Endpoint) -> None:
        """Open the port, or begin to try.

        Raises:
            UserError: it cannot be opened, and waiting would not help.
        """
        super().__init__()
        self._listener: socket.socket | None = None
        self._unsent = bytearray()
        self._endpoint = endpoint
        self._file: int | None = None
        self._missing_since_s = time.monotonic()
        self._next_attempt_s = self._missing_since_s + RETRY_S
        self._not_open = ""
        try:
            if endpoint.kind is EndpointKind.TCP_SERVER:
                family, address = resolve(endpoint.host, endpoint.number, socket.SOCK_STREAM, True)
                self._listener = socket.create_server(
                    address, family=family, dualstack_ipv6=endpoint.host == "::"
                )
            self._file = self._open(0.0 if self._listener is not None else FIRST_ATTEMPT_S)
        except OSError as error:
            if endpoint.kind is EndpointKind.SERIAL or not _may_come(error):
                self.close()
                raise _cannot_open(endpoint, error) from None
            self._not_open = self._nobody(error)
            self.notices.append(f"endpoint {endpoint}: {self._not_open.partition(';')[0]} yet; waiting")

    def _nobody(self, error: OSError) -> str:
        if self._listener is not None:
            return "nobody has connected; point the autopilot's TCP client at this address"
        if isinstance(error, TimeoutError):
            return "no answer; is the address right?"
        return _REMEDIES.get(error.errno or 0, f"{error.strerror or error}; check the address")

    @property
    def not_open(self) -> str:
        """See `Transport.not_open`."""
        return self._not_open

    def _open(self, timeout_s: float) -> int:
        if self._endpoint.kind is EndpointKind.SERIAL:
            return _open_serial(self._endpoint)
        if self._listener is None:
            address = (self._endpoint.host, self._endpoint.number)
            return _detached(socket.create_connection(address, timeout=timeout_s))
        self._listener.settimeout(timeout_s)
        return _detached(self._listener.accept()[0])

    def fileno(self) -> int:
        """See `Transport.fileno`."""
        return -1 if self._file is None else self._file

    def wait(self, timeout_s: float) -> bool:
        """See `Transport.wait`."""
        if self._file is None and not self._open_again():
            time.sleep(min(max(0.0, timeout_s), RETRY_S))
            return False
        assert self._file is not None
        return bool(select.select([self._file], [], [], max(0.0, timeout_s))[0])

    def receive(self) -> list[bytes]:
        """See `Transport.receive`."""
        if self._file is None:
            return []
        try:
            data = os.read(self._file, 65536)
        except BlockingIOError:
            return []
        except OSError as error:
            self._broke(os.strerror(error.errno or 0))
            return []
        if not data:  # both kinds of descriptor say so when the other end is gone
            self._broke("the other side is gone")
            return []
        return [data]

    def send(self, data: bytes) -> bool:
        """See `Transport.send`. A frame once begun is finished first; one that finds no room is dropped whole."""
        if self._file is None or (self._unsent and not self._flush()):
            return False
        self._unsent += data
        self._flush()
        return self._file is not None

    def _flush(self) -> bool:
        assert self._file is not None
        try:
            del self._unsent[: os.write(self._file, self._unsent)]
        except BlockingIOError:
            return False
        except OSError as error:
            self._broke(os.strerror(error.errno or 0))
            return False
        return not self._unsent

    def _broke(self, why: str) -> None:
        assert self._file is not None
        os.close(self._file)
        self._file = None
        self._unsent.clear()
        self._missing_since_s = time.monotonic()
        self.notices.append(f"endpoint {self._endpoint}: {why}; trying to connect again")

    def _open_again(self) -> bool:
        now_s = time.monotonic()
        if now_s < self._next_attempt_s:
            return False
        self._next_attempt_s = now_s + RETRY_S
        try:
            self._file = self._open(FIRST_ATTEMPT_S if self._not_open and not self._listener else ATTEMPT_S)
        except OSError:
            return False
        again = "" if self._not_open else " again"
        waited_s = time.monotonic() - self._missing_since_s
        self.notices.append(f"endpoint {self._endpoint}: connected{again} after {waited_s:.1f} s")
        self._not_open = ""
        return True

    def close(self) -> None:
        """Close the connection."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
        if self._listener is not None:
            self._listener.close()


def open_transport(endpoint: Endpoint) -> UdpTransport | StreamTransport:
    """Open the wire of an endpoint. Nobody at the other end of a UDP or TCP address is no error: somebody may come.

    Raises:
        UserError: when it cannot be opened (port taken, no such device, no such host), with the remedy.
    """
    if endpoint.kind in (EndpointKind.UDP_IN, EndpointKind.UDP_OUT, EndpointKind.UDP_BROADCAST):
        return UdpTransport(endpoint)
    return StreamTransport(endpoint)


def resolve(host: str, port: int, kind: int, listens: bool) -> tuple[socket.AddressFamily, Address]:
    """Address family and address of a host by name or number, IPv4 where it has both.

    Raises:
        OSError: there is no such host.
    """
    flags = socket.AI_PASSIVE if listens else 0
    found = socket.getaddrinfo(host, port, type=socket.SocketKind(kind), flags=flags)
    family, _, _, _, address = min(found, key=lambda each: each[0] != socket.AF_INET)
    return family, cast(Address, address)


def _may_come(error: OSError) -> bool:
    """Whether what keeps a TCP connection from being opened may pass: a simulator started later, a network coming up."""
    return isinstance(error, TimeoutError | BlockingIOError) or error.errno in (
        errno.ECONNREFUSED,
        errno.ECONNRESET,
        errno.EHOSTUNREACH,
        errno.ENETUNREACH,
    )


def _detached(connection: socket.socket) -> int:
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setblocking(False)
    return connection.detach()


def _open_serial(endpoint: Endpoint) -> int:
    import serial  # pyserial: only who has a serial port needs it

    try:
        port = serial.Serial(endpoint.host, endpoint.number, timeout=0, exclusive=True)
    except serial.SerialException as error:
        number = error.errno or errno.EIO
        raise OSError(number, os.strerror(number) if error.errno else str(error)) from None
    file = os.dup(port.fileno())
    os.set_blocking(file, False)
    # pyserial asks for reads that return at once with nothing; then nothing could not be told from a pulled plug.
    attributes = termios.tcgetattr(file)
    attributes[6][termios.VMIN] = 1
    termios.tcsetattr(file, termios.TCSANOW, attributes)
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
