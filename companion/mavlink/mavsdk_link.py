"""`--link mavsdk`: MAVSDK 4 holds the connection, and passes every frame on, both ways, as it came.

MAVSDK is used as a router. It opens the endpoint, finds the system and keeps the connection; beside it a `raw://`
connection of MAVSDK, with forwarding on for both, hands us the autopilot's frames and takes ours. So the flight, its log
and its checks are the same code with both libraries, and no field goes through Euler angles or text on its way.

MAVSDK's Offboard plugin, which repeats the last setpoint at 20 Hz by itself, is not used on purpose: a setpoint leaves
only when the control loop makes one, and when the loop hangs the autopilot notices as soon as with pymavlink. Nor does
MAVSDK answer TIMESYNC unless it is asked to, so a lockstep simulation still waits for the loop and for nothing else.
"""

from __future__ import annotations

import os
import select
from collections import deque
from contextlib import suppress
from typing import Any

from companion.config.errors import UserError
from companion.mavlink.endpoint import Endpoint
from companion.mavlink.transport import CHUNKS_PER_READ, Transport

QUEUE_FRAMES = 4096  # some 3 s of a fast link; when the loop hangs longer, the oldest frames go
MAVSDK_COMPONENT = 192  # MAV_COMP_ID_ONBOARD_COMPUTER2: we are 191, and each has its own sequence numbers
_WARN = 2  # MAVSDK's LogLevel.WARN

_REASONS = {
    "SOCKET_ERROR": "no such address on this machine, or no permission",
    "BIND_ERROR": "another program has this port; stop it (a ground station? an earlier run?) or use another port",
    "SOCKET_CONNECTION_ERROR": "nobody listens there; is the autopilot or simulator running?",
    "CONNECTION_ERROR": "check the address and the cable; for a serial port: is the user in the group dialout?",
    "DESTINATION_IP_UNKNOWN": "this host name is not known",
    "CONNECTION_URL_INVALID": "MAVSDK does not know this kind of address",
    "BAUDRATE_UNKNOWN": "MAVSDK does not know this baud rate; 57600, 115200, 460800, 921600 and others work",
}


class MavsdkTransport(Transport):
    """See the module. MAVSDK's own thread fills a bounded queue; all else happens in the caller's thread."""

    datagrams = True  # MAVSDK hands over whole frames

    def __init__(self, endpoint: Endpoint) -> None:
        """Open `endpoint` with MAVSDK.

        Raises:
            UserError: MAVSDK 4 is not installed, or cannot open it.
        """
        super().__init__()
        library = _mavsdk()
        self._frames: deque[bytes] = deque(maxlen=QUEUE_FRAMES)
        self._arrived = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        library.log_subscribe(self._take_log)  # standard output is for results
        configuration = library.Configuration.create_with_component_type(
            library.ComponentType.COMPANION_COMPUTER
        )
        configuration.component_id = MAVSDK_COMPONENT
        self._library, self._configuration = library, configuration
        self._mavsdk: Any = library.Mavsdk(configuration)
        # The raw connection first: whatever the autopilot says from the first frame on has somewhere to go.
        for url in ("raw://", endpoint.mavsdk_url):
            result = self._mavsdk.add_any_connection_with_forwarding(url, library.ForwardingOption.ON)
            if result != 0:
                self.close()
                raise UserError(
                    f"endpoint {endpoint}: MAVSDK says {result.name}; "
                    + _REASONS.get(result.name, "check the address and the cable")
                )
            if url == "raw://":
                self._mavsdk.subscribe_raw_bytes_to_be_sent(self._take_frame)

    def _take_frame(self, frame: bytes) -> None:
        self._frames.append(frame)
        os.eventfd_write(self._arrived, 1)

    def _take_log(self, level: int, text: str, _file: str | None, _line: int) -> bool:
        if level >= _WARN:
            self.notices.append(f"MAVSDK: {text}")
        return True

    def wait(self, timeout_s: float) -> bool:
        """See `Transport.wait`."""
        return bool(self._frames or select.select([self._arrived], [], [], max(0.0, timeout_s))[0])

    def receive(self) -> list[bytes]:
        """See `Transport.receive`."""
        with suppress(BlockingIOError):
            os.eventfd_read(self._arrived)  # before the queue is looked at, so that no arrival is forgotten
        frames: list[bytes] = []
        while self._frames and len(frames) < CHUNKS_PER_READ:
            frames.append(self._frames.popleft())
        return frames

    def send(self, data: bytes) -> bool:
        """See `Transport.send`. MAVSDK queues it for its own thread and does not tell what became of it."""
        self._mavsdk.pass_received_raw_bytes(data)
        return True

    def close(self) -> None:
        """Close the connection and end MAVSDK's threads."""
        self._mavsdk.destroy()
        self._library.log_unsubscribe()
        os.close(self._arrived)


def _mavsdk() -> Any:
    try:
        import mavsdk
    except ImportError as error:
        raise UserError(
            f"--link mavsdk: {error}; install it with `pip install 'dtlannc-companion[mavsdk]'`, "
            "or fly with --link pymavlink"
        ) from None
    if not hasattr(mavsdk, "Configuration"):
        raise UserError(
            f"--link mavsdk: MAVSDK {getattr(mavsdk, '__version__', 'of before 4')} has another interface; version 4.1 "
            "or later is needed: `pip install 'dtlannc-companion[mavsdk]'`"
        )
    return mavsdk
