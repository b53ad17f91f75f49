"""EVENT messages of PX4 1.17: what it says instead of STATUSTEXT.

An event's number is made of its name (`events.h`: FNV-1a, 24 bits, component 1 above); names, levels and arguments are
those of `Commander.cpp` and `failsafe/framework.cpp`, and the capture has six of them.
"""

from __future__ import annotations

from enum import Enum, IntEnum

FNV_OFFSET, FNV_PRIME = 0x811C9DC5, 0x01000193
COMPONENT = 1 << 24


def event_number(name: str) -> int:
    """Number of the event of that name."""
    value = FNV_OFFSET
    for character in name.encode():
        value = (value ^ character) * FNV_PRIME & 0xFFFFFFFF
    return COMPONENT | value & 0xFFFFFF


class Reason(IntEnum):
    """Why it was armed or disarmed: argument of both events (arm_disarm_reason_t), words of 1.13's texts."""

    STICK_GESTURE = 1
    COMMAND = 4
    LANDING = 6
    PREFLIGHT_INACTION = 7
    KILL_SWITCH = 8
    RC_SWITCH = 2
    FAILSAFE = 14

    @property
    def words(self) -> str:
        """`Armed by ...`, `Disarmed by ...`."""
        return {
            Reason.STICK_GESTURE: "RC",
            Reason.COMMAND: "external command",
            Reason.LANDING: "landing",
            Reason.PREFLIGHT_INACTION: "auto preflight disarming",
            Reason.KILL_SWITCH: "kill-switch",
            Reason.RC_SWITCH: "RC switch",
            Reason.FAILSAFE: "failsafe",
        }[self]


class Event(Enum):
    """An event: name, log levels (internal << 4 | external)."""

    ARMING_DENIED = ("commander_arm_denied_resolve_failures", 0x62)
    """Arming denied: resolve system health failures first."""
    ARMED = ("commander_armed_by", 0x66)
    """Argument: why."""
    DISARMED = ("commander_disarmed_by", 0x66)
    """Argument: why."""
    DISARMING_DENIED = ("commander_disarm_denied_not_landed", 0x62)
    """Not landed."""
    TAKEOFF_DETECTED = ("commander_takeoff_detected", 0x66)
    """The land detector saw the take-off."""
    LANDING_DETECTED = ("commander_landing_detected", 0x66)
    """The land detector saw the landing."""
    KILL_IN_AIR = ("commander_kill_sw_engaged", 0x62)
    """The kill switch, off the ground."""
    KILL_ON_GROUND = ("commander_kill_sw_engaged", 0x66)
    """The kill switch, on the ground."""
    KILL_OVER = ("commander_kill_sw_disengaged", 0x66)
    """The kill switch is back."""
    STICKS = ("commander_rc_override", 0x66)
    """The pilot took over using sticks."""
    FAILSAFE = ("commander_failsafe_enter_generic", 0x42)
    """Arguments: custom mode that was meant to fly, failsafe_action_t."""
    FAILSAFE_CAUSED = ("commander_failsafe_enter", 0x42)
    """The same and failsafe_cause_t."""
    FAILSAFE_HOLDS = ("commander_failsafe_enter_hold", 0x42)
    """Hold first. Arguments: custom mode, action, seconds (16 bits), cause."""
    BATTERY_LOW = ("commander_failsafe_enter_low_bat", 0x64)
    """A warning."""
    BATTERY_CRITICAL = ("commander_failsafe_enter_crit_bat_warn", 0x62)
    """A warning where COM_LOW_BAT_ACT asks for no more."""
    BATTERY_EMERGENCY = ("commander_failsafe_enter_crit_low_bat_warn", 0x60)
    """The same."""

    @property
    def number(self) -> int:
        """Event id with the component in its top byte."""
        return event_number(self.value[0])

    @property
    def log_levels(self) -> int:
        """Internal and external level, four bits each."""
        return self.value[1]
