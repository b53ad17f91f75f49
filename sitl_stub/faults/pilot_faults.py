"""What a pilot does: takes the mode, moves the sticks, disarms, kills. He does so by radio, whatever the link does."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sitl_stub.faults.fault import Effect, Fault, Site, choice, hold, number, switch
from sitl_stub.firmware.ardupilot import modes as ardupilot_modes
from sitl_stub.firmware.common.radio import APPEARANCES
from sitl_stub.firmware.px4 import modes as px4_modes

if TYPE_CHECKING:
    from sitl_stub.physics.vehicle import VehicleParameters


def _modes() -> tuple[str, ...]:
    """Words both firmwares know, then the names of each, once."""
    every: Iterable[str] = (
        *px4_modes.BY_WORD,
        *px4_modes.Mode.__members__,
        *ardupilot_modes.Mode.__members__,
    )
    return tuple(dict.fromkeys(every))


@dataclass(frozen=True)
class PilotMode(Fault):
    """The pilot switches to another mode, sticks centred, and back at the end where there is one."""

    kind = "pilot_mode"
    mode: str = choice("position", _modes(), "the firmware's own name, or a word that both know")

    def refusal(self, firmware: str, vehicle: VehicleParameters) -> str | None:
        """A mode of the other firmware."""
        of = ardupilot_modes if firmware == "ardupilot" else px4_modes
        if of.mode_named(self.mode) is not None:
            return None
        there = ", ".join((*of.BY_WORD, *of.Mode.__members__))
        return f"mode {self.mode!r} is none of firmware {firmware}: give one of {there}"

    def act(self, site: Site) -> Effect:
        """Switch."""
        before = site.autopilot.mode_name
        site.autopilot.pilot_mode(self.mode)
        try:
            yield from hold()
        finally:
            site.autopilot.pilot_mode(before)


@dataclass(frozen=True)
class PilotSticks(Fault):
    """The pilot moves the sticks, and lets go at the end; PX4 hands over by COM_RC_OVERRIDE."""

    kind = "pilot_sticks"
    roll: float = number(0.0, "", "right positive", -1.0, 1.0)
    pitch: float = number(0.5, "", "forward positive", -1.0, 1.0)
    yaw: float = number(0.0, "", "clockwise positive", -1.0, 1.0)
    throttle: float = number(0.5, "", "0.5 is the middle", 0.0, 1.0)

    def act(self, site: Site) -> Effect:
        """Move them."""
        before = site.autopilot.sticks_now
        try:
            while True:
                site.autopilot.pilot_sticks(self.roll, self.pitch, self.yaw, self.throttle)
                yield
        finally:
            site.autopilot.pilot_sticks(*before)


@dataclass(frozen=True)
class PilotDisarm(Fault):
    """The pilot disarms; the rotors stop for good."""

    kind = "pilot_disarm"
    momentary = True
    forced: bool = switch(True, "also in the air; false: refused there")

    def act(self, site: Site) -> Effect:
        """Disarm."""
        site.autopilot.pilot_disarm(self.forced)
        yield from ()


@dataclass(frozen=True)
class PilotKill(Fault):
    """The pilot's kill switch stops the rotors of an armed vehicle until the end; PX4 then disarms (COM_KILL_DISARM)."""

    kind = "pilot_kill"

    def act(self, site: Site) -> Effect:
        """Switch."""

        def use(let: float) -> None:
            site.autopilot.pilot_kill(let < 1.0)

        with site.setting("kill switch", 0.0, use, otherwise=1.0):
            yield from hold()


@dataclass(frozen=True)
class TransmitterLost(Fault):
    """The pilot's transmitter is lost, which each receiver shows in its way; no RC failsafe of the autopilot acts."""

    kind = "transmitter_lost"
    appearance: str = choice("throttle_low", APPEARANCES, "what RC_CHANNELS or SYS_STATUS show")

    def act(self, site: Site) -> Effect:
        """Lose it."""
        site.autopilot.radio.lost = self.appearance
        try:
            yield from hold()
        finally:
            site.autopilot.radio.lost = ""
