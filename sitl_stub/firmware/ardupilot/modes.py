"""ArduCopter's flight modes: their numbers on the wire and what each needs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


@dataclass(frozen=True, slots=True)
class ModeFacts:
    """What is known of a mode."""

    number: int
    """HEARTBEAT.custom_mode and DO_SET_MODE's second parameter."""
    needs_position: bool = False
    can_arm: bool = True
    manual_throttle: bool = False
    """The throttle stick is thrust; else it is a climb rate or nothing."""
    takes_off: bool = False
    """Answers MAV_CMD_NAV_TAKEOFF."""
    takes_targets: bool = False
    """Listens to SET_ATTITUDE_TARGET and SET_POSITION_TARGET_..."""


class Mode(Enum):
    """A mode of ArduCopter that the stub flies; the value holds its facts."""

    STABILIZE = ModeFacts(0, manual_throttle=True)
    """Sticks to tilt, rate of heading and thrust. The mode after boot."""
    ACRO = ModeFacts(1, manual_throttle=True)
    """Sticks to body rates and thrust."""
    ALT_HOLD = ModeFacts(2, takes_off=True)
    """Sticks to tilt, rate of heading and climb rate."""
    AUTO = ModeFacts(3, needs_position=True, can_arm=False)
    """The mission; the stub keeps one and does not fly it, so this cannot be entered in the air."""
    GUIDED = ModeFacts(4, needs_position=True, takes_off=True, takes_targets=True)
    """Targets over MAVLink."""
    LOITER = ModeFacts(5, needs_position=True, takes_off=True)
    """Holds the place; sticks move it."""
    RTL = ModeFacts(6, needs_position=True, can_arm=False)
    """Climb, return, land."""
    LAND = ModeFacts(9, can_arm=False)
    """Land where it is."""
    POSHOLD = ModeFacts(16, needs_position=True, takes_off=True)
    """As LOITER with sticks to tilt; the stub flies it as LOITER."""
    BRAKE = ModeFacts(17, needs_position=True, can_arm=False)
    """Stop and stay, whatever the sticks."""
    GUIDED_NOGPS = ModeFacts(20, takes_targets=True)
    """Attitude targets over MAVLink without a position."""

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode."""
        return self.value.number


BY_WORD = {
    "position": Mode.LOITER,
    "altitude": Mode.ALT_HOLD,
    "manual": Mode.STABILIZE,
    "hold": Mode.BRAKE,
    "return": Mode.RTL,
    "land": Mode.LAND,
}
"""What both firmwares have under names of their own."""


def mode_named(name: str) -> Mode | None:
    """The mode of ArduCopter's own name (`ALT_HOLD`) or of a word both firmwares know (`altitude`)."""
    return BY_WORD.get(name.lower()) or Mode.__members__.get(name.upper())


BY_NUMBER: dict[int, Mode] = {mode.custom_mode: mode for mode in Mode}
