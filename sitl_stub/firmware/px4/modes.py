"""PX4's flight modes: their numbers on the wire and what each needs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


@dataclass(frozen=True, slots=True)
class ModeFacts:
    """What is known of a mode."""

    main: int
    sub: int
    base_flags: int
    """HEARTBEAT.base_mode without the armed bit (OFFBOARD's stabilise bit depends on the setpoint)."""
    name: str
    """In PX4's texts."""
    needs_sticks: bool = False
    needs_position: bool = False
    can_arm: bool = True
    standard_mode: int = 0
    """MAV_STANDARD_MODE in CURRENT_MODE."""


class Mode(Enum):
    """A mode of PX4; the value holds its facts. Custom mode on the wire: main << 16 | sub << 24."""

    MANUAL = ModeFacts(1, 0, 81, "Manual", needs_sticks=True)
    """Sticks to attitude and thrust (a multirotor treats it as STABILIZED)."""
    ALTCTL = ModeFacts(2, 0, 81, "Altitude", needs_sticks=True, standard_mode=4)
    """Sticks to tilt and climb rate."""
    POSCTL = ModeFacts(3, 0, 81, "Position", needs_sticks=True, needs_position=True, standard_mode=1)
    """Sticks to velocity; holds position when they are centred."""
    ACRO = ModeFacts(5, 0, 65, "Acro", needs_sticks=True)
    """Sticks to body rates."""
    STABILIZED = ModeFacts(7, 0, 81, "Stabilized", needs_sticks=True)
    """Sticks to attitude and thrust."""
    OFFBOARD = ModeFacts(6, 0, 1, "Offboard")
    """Setpoints over MAVLink."""
    TAKEOFF = ModeFacts(4, 2, 29, "Takeoff", needs_position=True, standard_mode=8)
    """Climb to MIS_TAKEOFF_ALT, then hold."""
    LOITER = ModeFacts(4, 3, 29, "Hold", needs_position=True)
    """Hold the place."""
    MISSION = ModeFacts(4, 4, 29, "Mission", needs_position=True, standard_mode=6)
    """Fly the mission; needs one."""
    RTL = ModeFacts(4, 5, 29, "RTL", needs_position=True, can_arm=False, standard_mode=5)
    """Climb if far away, return to home, land."""
    LAND = ModeFacts(4, 6, 29, "Land", can_arm=False, standard_mode=7)
    """Land where it is."""
    ORBIT = ModeFacts(3, 1, 29, "Orbit", needs_position=True, can_arm=False, standard_mode=2)
    """Circle about a place (DO_ORBIT)."""
    PRECISION_LAND = ModeFacts(4, 9, 29, "Precision land", can_arm=False)
    """Lands where it is: the stub has no beacon."""

    @property
    def custom_mode(self) -> int:
        """HEARTBEAT.custom_mode."""
        return self.value.main << 16 | self.value.sub << 24

    @property
    def is_auto(self) -> bool:
        """Whether PX4's navigator flies."""
        return self.value.main == 4


BY_NUMBERS: dict[tuple[int, int], Mode] = {(mode.value.main, mode.value.sub): mode for mode in Mode}

FAILSAFE_ACTIONS: dict[int, Mode] = {
    # COM_OBL_RC_ACT; a mode that needs sticks falls through to RTL when there are none
    0: Mode.POSCTL,
    1: Mode.ALTCTL,
    2: Mode.STABILIZED,
    3: Mode.RTL,
    4: Mode.LAND,
    5: Mode.LOITER,
}
STICK_LOSS_ACTIONS: dict[int, Mode] = {1: Mode.LOITER, 2: Mode.RTL, 3: Mode.LAND}
"""NAV_RCL_ACT; where it asks for nothing, and the mode needs sticks, PX4 returns."""
FAILSAFE_TERMINATE = 6
FAILSAFE_DISARM = 7


BY_WORD = {
    "position": Mode.POSCTL,
    "altitude": Mode.ALTCTL,
    "manual": Mode.STABILIZED,
    "hold": Mode.LOITER,
    "return": Mode.RTL,
    "land": Mode.LAND,
}
"""What both firmwares have under names of their own."""


def mode_named(name: str) -> Mode | None:
    """The mode of PX4's own name (`POSCTL`) or of a word both firmwares know (`position`)."""
    return BY_WORD.get(name.lower()) or Mode.__members__.get(name.upper())


def mode_of(main: int, sub: int) -> Mode | None:
    """The mode of DO_SET_MODE's numbers; PX4 takes a sub mode only for AUTO and POSCTL."""
    if main == 4:
        return BY_NUMBERS.get((4, sub))
    if main == 3:
        return BY_NUMBERS.get((3, sub), Mode.POSCTL)
    return BY_NUMBERS.get((main, 0))


def mode_of_custom(custom_mode: int) -> Mode | None:
    """The mode of a HEARTBEAT-style custom mode number."""
    return mode_of(custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF)
