"""Faults of the autopilot's program: streams that stop, a restart."""

from __future__ import annotations

from dataclasses import dataclass

from sitl_stub.faults.fault import Effect, Fault, Site, hold, names, number
from sitl_stub.mavlink.codec import LAYOUTS


@dataclass(frozen=True)
class StreamStop(Fault):
    """The autopilot stops sending some messages, asked for or not."""

    kind = "stream_stop"
    messages: tuple[str, ...] = names(("LOCAL_POSITION_NED",), tuple(LAYOUTS), "MAVLink message names")

    def act(self, site: Site) -> Effect:
        """Mute them."""
        end = site.frames.mute(self.messages)
        try:
            yield from hold()
        finally:
            end()


@dataclass(frozen=True)
class Reboot(Fault):
    """The autopilot restarts, in flight or not: rotors stop, its time begins at 0; parameters are kept."""

    kind = "reboot"
    momentary = True
    silent_s: float = number(2.0, "s", "how long nothing is said or heard", 0.0, 60.0)

    def act(self, site: Site) -> Effect:
        """Restart it."""
        site.autopilot.restart(self.silent_s)
        yield from ()
