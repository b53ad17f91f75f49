"""Addresses of autopilots, in pymavlink's spelling and in MAVSDK's.

| kind       | pymavlink                    | MAVSDK                             | we …                              |
|------------|------------------------------|------------------------------------|-----------------------------------|
| UDP_IN     | `udpin:0.0.0.0:14540`, `udp:…` | `udpin://0.0.0.0:14540`, `udp://:14540` | listen, answer who speaks first |
| UDP_OUT    | `udpout:192.168.1.2:14550`   | `udpout://192.168.1.2:14550`       | speak first to that address       |
| UDP_BROADCAST | `udpbcast:192.168.1.255:14550`, `udpcast:…` | none           | call all there, then speak to who answers |
| TCP_CLIENT | `tcp:127.0.0.1:5760`         | `tcpout://127.0.0.1:5760`, `tcp://…` | connect                         |
| TCP_SERVER | `tcpin:0.0.0.0:5760`         | `tcpin://0.0.0.0:5760`             | wait for one connection           |
| SERIAL     | `/dev/ttyACM0`, `/dev/ttyAMA0,921600` | `serial:///dev/ttyACM0:921600` | open the port            |

A host may be a name, an IPv4 address, or an IPv6 address in brackets: `udpin:[::]:14540`.
"""

from __future__ import annotations

import enum
import re
from dataclasses import dataclass

from companion.config.errors import UserError

DEFAULT_BAUD = 57600
_SERIAL_PREFIXES = ("/dev/", "COM", "/tmp/", "./")


class EndpointKind(enum.Enum):
    """How the bytes reach the autopilot."""

    UDP_IN = "udpin"
    UDP_OUT = "udpout"
    UDP_BROADCAST = "udpbcast"
    TCP_CLIENT = "tcp"
    TCP_SERVER = "tcpin"
    SERIAL = "serial"


_SCHEMES = {
    "udp": EndpointKind.UDP_IN,
    "udpin": EndpointKind.UDP_IN,
    "udpout": EndpointKind.UDP_OUT,
    "udpbcast": EndpointKind.UDP_BROADCAST,
    "udpcast": EndpointKind.UDP_BROADCAST,
    "tcp": EndpointKind.TCP_CLIENT,
    "tcpout": EndpointKind.TCP_CLIENT,
    "tcpin": EndpointKind.TCP_SERVER,
    "serial": EndpointKind.SERIAL,
    "serial_flowcontrol": EndpointKind.SERIAL,
}


_LISTENING = (EndpointKind.UDP_IN, EndpointKind.TCP_SERVER)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A parsed address. `host` is the serial device's path for SERIAL; `number` is a port, or the baud rate."""

    kind: EndpointKind
    host: str
    number: int

    def __str__(self) -> str:
        """Return pymavlink's spelling."""
        if self.kind is EndpointKind.SERIAL:
            return f"{self.host},{self.number}"
        return f"{self.kind.value}:{self._host_in_brackets}:{self.number}"

    @property
    def _host_in_brackets(self) -> str:
        return f"[{self.host}]" if ":" in self.host else self.host

    @property
    def mavsdk_url(self) -> str:
        """The same address as MAVSDK spells it."""
        if self.kind is EndpointKind.TCP_CLIENT:
            return f"tcpout://{self._host_in_brackets}:{self.number}"
        if self.kind is EndpointKind.SERIAL:
            return f"serial://{self.host}:{self.number}"
        return f"{self.kind.value}://{self._host_in_brackets}:{self.number}"


def parse_endpoint(text: str) -> Endpoint:
    """Parse an address in either spelling.

    Raises:
        UserError: naming what is wrong with the address and showing one that works.
    """
    text = text.strip()
    if text.startswith(_SERIAL_PREFIXES):
        return _serial(text, text)
    match = re.fullmatch(r"([a-zA-Z_]+):(?://)?(.*)", text)
    if match is None or match.group(1).lower() not in _SCHEMES:
        raise UserError(
            f"endpoint {text!r}: not an address I know; use for example udpin:0.0.0.0:14540, "
            "udpout:192.168.1.2:14550, tcp:127.0.0.1:5760 or /dev/ttyACM0,921600"
        )
    kind, rest = _SCHEMES[match.group(1).lower()], match.group(2)
    if kind is EndpointKind.SERIAL:
        return _serial(text, rest)
    if "@" in rest:
        listens, _, speaks = rest.rpartition("@")
        listens = listens if listens.partition(":")[0] else f"0.0.0.0{listens}"
        raise UserError(
            f"endpoint {text!r}: names two addresses, as MAVROS has them; give one: "
            f"udpin:{listens} to listen, or udpout:{speaks} to speak first"
        )
    host, colon, port = rest.rpartition(":")
    if not colon and not port.isdecimal():
        raise UserError(
            f"endpoint {text!r}: names no port; use for example {kind.value}:{rest or '127.0.0.1'}:14540"
        )
    host = checked_host(f"endpoint {text!r}", host) or ("0.0.0.0" if kind in _LISTENING else "127.0.0.1")
    return Endpoint(kind, host, _number(text, port, "port", 65535))


def checked_host(where: str, host: str) -> str:
    """A host by name or number, without brackets. Raises UserError, beginning with `where`, for what can be none."""
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
        if ":" in host:
            return host
    try:
        host.encode("idna")
        valid = host.isprintable() and " " not in host
    except UnicodeError:
        valid = False
    if not valid:
        raise UserError(f"{where}: {host!r} is no host name: the parts between its dots have 1 to 63 letters")
    return host


def host_and_port(text: str, what: str) -> tuple[str, int]:
    """`[HOST:]PORT`; without a host this machine only. Raises UserError, beginning with `what`, for anything else."""
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise UserError(f"{what} {text!r}: not [HOST:]PORT; use for example 0.0.0.0:14600")
    return checked_host(f"{what} {text!r}", host) or "127.0.0.1", int(port)


def _serial(text: str, rest: str) -> Endpoint:
    device, _, baud = rest.partition(",")
    if not baud and (match := re.fullmatch(r"(.*):(\d+)", rest)):
        device, baud = match.groups()
    if not device.strip(":/"):
        raise UserError(f"endpoint {text!r}: names no device; use for example /dev/ttyACM0,921600")
    return Endpoint(
        EndpointKind.SERIAL, device, _number(text, baud, "baud rate", 20_000_000) if baud else DEFAULT_BAUD
    )


def _number(text: str, digits: str, what: str, largest: int) -> int:
    if not digits.isdecimal() or not 1 <= int(digits) <= largest:
        raise UserError(f"endpoint {text!r}: the {what} {digits!r} is not a number from 1 to {largest}")
    return int(digits)
