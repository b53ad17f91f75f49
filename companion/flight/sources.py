"""Which message tells what a flight rests on, and what follows where it was never heard, or is heard no more.

What was not heard is not known. Each row names its message, what is *blind* without it, whether a flight begins without it,
and the age whose ladder (`companion.config.safety`) acts when it falls silent in flight. `docs/safety.md` shows the table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.autopilot.adapter import Adapter, Finding, VehicleStatus, Verdict
from companion.config.safety import Reaction, SafetyLimits
from companion.mavlink.link import mav
from companion.mavlink.timesync import TimeSync

SILENT_S = 3.0
"""Without the message for so long, autopilot's clock, what it tells is not known any more. None is asked for below 5 Hz."""


@dataclass(frozen=True, slots=True)
class Source:
    """One message, and what rests on it."""

    message: str
    message_id: int
    tells: str
    quantities: tuple[str, ...] = ()  # watched ones that nothing else tells
    age: str = ""  # the watched quantity that grows while the message is silent; empty: it is only said
    needed: bool = False  # a flight does not begin without it
    instead: str = ""  # what takes its place
    only: str = ""  # the autopilot that sends it, where the other does not

    def reaction(self, limits: SafetyLimits) -> Reaction:
        """The hardest that follows when it falls silent in flight."""
        rungs = limits.ladder(self.age).rungs() if self.age else []
        return max((reaction for reaction, _, _ in rungs), default=Reaction.WARN)

    def verdict(self, limits: SafetyLimits) -> Verdict:
        """What follows where it was never heard: whoever switches the end off that its silence means flies blind."""
        ends = self.needed and self.reaction(limits) >= Reaction.LAND
        return Verdict.REFUSAL if ends or (self.needed and not self.age) else Verdict.WARNING


SOURCES = (
    Source(
        "HEARTBEAT",
        mav.MAVLINK_MSG_ID_HEARTBEAT,
        "which autopilot it is, its mode, whether it is armed",
        age="mode_age_s",
        needed=True,
        instead="the mode also by CURRENT_MODE; that it was disarmed by nothing else",
    ),
    Source(
        "ATTITUDE_QUATERNION",
        mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
        "attitude and body rates: every control step",
        quantities=("attitude_age_s", "tilt_deg", "body_rate_deg_s", "attitude_error_deg", "yaw_error_deg"),
        age="attitude_age_s",
        needed=True,
    ),
    Source(
        "LOCAL_POSITION_NED",
        mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        "position and velocity: every control step",
        quantities=("position_age_s", "position_error_m", "velocity_error_m_s", "fence_margin_m"),
        age="position_age_s",
        needed=True,
    ),
    Source(
        "ESTIMATOR_STATUS",
        mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
        "whether the estimator still knows attitude, velocity and position",
        quantities=("estimator_lost", "innovation_ratio"),
        age="estimator_age_s",
        needed=True,
        only="PX4",
    ),
    Source(
        "EKF_STATUS_REPORT",
        mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
        "whether the estimator still knows attitude, velocity and position",
        quantities=("estimator_lost", "innovation_ratio"),
        age="estimator_age_s",
        instead="the attitude estimate's bit in SYS_STATUS; ArduPilot sends LOCAL_POSITION_NED only with a position",
        only="ArduPilot",
    ),
    Source(
        "SYS_STATUS",
        mav.MAVLINK_MSG_ID_SYS_STATUS,
        "health of gyroscope, accelerometer and attitude estimate, battery, pre-arm checks, the receiver",
        quantities=("sensors_unhealthy", "battery_remaining", "battery_voltage_v"),
        age="sys_status_age_s",
        needed=True,
    ),
    Source(
        "EXTENDED_SYS_STATE",
        mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
        "whether it stands on the ground, before anything idle is sent; ground contact while tracking",
        needed=True,
        instead="in flight, thrust against acceleration (`ground_support`)",
    ),
    Source(
        "TIMESYNC",
        mav.MAVLINK_MSG_ID_TIMESYNC,
        "the link's delay, and how far states are predicted ahead",
        quantities=("round_trip_s",),
    ),
    Source(
        "RC_CHANNELS",
        mav.MAVLINK_MSG_ID_RC_CHANNELS,
        "the pilot's sticks, and a lost transmitter",
        instead="the pilot's mode switch and disarming are seen all the same",
    ),
)

_VALUES = {
    "estimator_lost": "estimator_flags",
    "innovation_ratio": "innovation_ratio",
    "sensors_unhealthy": "sensors_unhealthy",
    "battery_remaining": "battery_remaining",
    "battery_voltage_v": "battery_voltage_v",
}
"""Quantities whose value a message may leave open, and where `VehicleStatus` keeps it."""


@dataclass(frozen=True, slots=True)
class Blind:
    """Something that is not known."""

    source: Source
    heard: bool  # the message comes, but leaves the value open
    quantities: tuple[str, ...]

    def __str__(self) -> str:
        what = ", ".join(self.quantities) or self.source.tells
        return f"{self.source.message} {'does not tell' if self.heard else 'is not heard: blind for'} {what}"


def blind(
    adapter: Adapter, status: VehicleStatus, timesync: TimeSync, limits: SafetyLimits, now_s: float
) -> list[Blind]:
    """What of `SOURCES` is not known at `now_s` (autopilot's clock), in their order."""
    found = []
    for source in SOURCES:
        if source.only not in ("", adapter.name):
            continue
        asked = source.message_id == mav.MAVLINK_MSG_ID_TIMESYNC
        heard_s = timesync.answered_s if asked else status.heard_s.get(source.message_id, -math.inf)
        used = tuple(name for name in source.quantities if limits.ladder(name).rungs())
        if not now_s - heard_s <= SILENT_S:
            found.append(Blind(source, False, used))
            continue
        open_ = tuple(n for n in used if n in _VALUES and getattr(status, _VALUES[n]) is None)
        if open_:
            found.append(Blind(source, True, open_))
    return found


def blind_findings(unknown: list[Blind], limits: SafetyLimits) -> list[Finding]:
    """What is not known, as findings before a flight."""
    return [
        Finding(
            Verdict.WARNING if item.heard else item.source.verdict(limits),
            item.source.message,
            "heard, but does not tell all" if item.heard else "not heard",
            f"blind: {', '.join(item.quantities) or item.source.tells}"
            + (f" (instead: {item.source.instead})" if item.source.instead else ""),
            "mend what it measures, or fly by your own eyes"
            if item.heard
            else f"let message {item.source.message_id} pass routers and filters"
            + (f"; set flight.safety.{item.source.age}.land=off to fly blind" if item.source.age else ""),
        )
        for item in unknown
    ]


def sources_table() -> str:
    """The table of docs/safety.md."""
    limits = SafetyLimits()
    lines = [
        "| message | what rests on it | watched by it | never heard | silent in flight | instead |",
        "|---|---|---|---|---|---|",
    ]
    for source in SOURCES:
        before = "refused" if source.verdict(limits) is Verdict.REFUSAL else "said"
        rungs = limits.ladder(source.age).rungs() if source.age else []
        ends = [f"`{reaction.setting}` after {at:g} s" for reaction, at, _ in rungs]
        during = f"{', '.join(ends)} (`{source.age}`)" if ends else f"said after {SILENT_S:g} s"
        name = f"`{source.message}`" + (f" ({source.only})" if source.only else "")
        watched = ", ".join(f"`{quantity}`" for quantity in source.quantities)
        lines.append(f"| {name} | {source.tells} | {watched} | {before} | {during} | {source.instead} |")
    return "\n".join(lines) + "\n"
