"""From an address and a few wishes to a `Link`: which library carries the bytes, and whether they are signed."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from companion.mavlink.endpoint import Endpoint
from companion.mavlink.link import Link
from companion.mavlink.signing import Signer, open_to_others, read_key, state_path
from companion.mavlink.transport import open_transport


class LinkLibrary(enum.Enum):
    """What carries the bytes. Frames are made and read by the same code with both."""

    PYMAVLINK = "pymavlink"
    """Our own sockets and serial ports, in the control thread: the least delay, and repeatable in lockstep."""
    MAVSDK = "mavsdk"
    """MAVSDK 4 holds the connection and passes frames on: for who runs other MAVSDK code beside the flight."""


@dataclass(frozen=True, slots=True)
class Connection:
    """How to reach the autopilot."""

    endpoint: Endpoint
    library: LinkLibrary = LinkLibrary.PYMAVLINK
    signing_key: Path | None = None
    system: int | None = None  # of the autopilot that is meant; None: the only one there

    def open(self, say: Callable[[str], None] = lambda _: None) -> Link:
        """Open the link; `say` takes what the pilot should know.

        Raises:
            UserError: the key cannot be read, the library is not installed, or the endpoint cannot be opened.
        """
        signer = self.signer(say)
        if self.library is LinkLibrary.MAVSDK:
            from companion.mavlink.mavsdk_link import MavsdkTransport

            return Link(MavsdkTransport(self.endpoint), signer=signer, system=self.system)
        return Link(open_transport(self.endpoint), signer=signer, system=self.system)

    def signer(self, say: Callable[[str], None] = lambda _: None) -> Signer | None:
        """What signs and judges with our key; None without one. Raises UserError where the key cannot be read."""
        if self.signing_key is None:
            return None
        key = read_key(self.signing_key)
        if open_to_others(self.signing_key):
            say(f"warning: other users can read {self.signing_key}; run `chmod 600 {self.signing_key.name}`")
        return Signer(key, remembered=state_path(key))
