"""What a flight tells of its vehicle, each with how sure it is, and the short profile that follows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.analysis.identify import VAGUE, AxisResponse, identify
from companion.autopilot.drag import SPREAD_1_S, DragMeter
from companion.config.errors import UserError
from companion.flightlog.reader import FlightRecord

EXPLAINED = 0.9
"""Share of an axis' motion that its model has to account for, to be believed."""


@dataclass(frozen=True, slots=True)
class Adopted:
    """What was found; None or empty where the flight does not tell."""

    autopilot: str  # the profile's key
    axes: tuple[AxisResponse, ...]  # that are believed
    drag: tuple[float, float] | None  # 1/s, and its standard deviation
    hover: tuple[float, float] | None  # thrust setpoint, and by how much it moved in the flight
    unknown: tuple[str, ...]  # sentences

    @property
    def tilt(self) -> tuple[float, float, float] | None:
        """Dead time s, ω rad/s, ζ of roll and pitch together, the better known one counting more."""
        found = [axis for axis in self.axes if axis.axis != "yaw"]
        if not found:
            return None
        weights = [1.0 / max(axis.spread[1] / axis.natural_frequency_rad_s, 1e-3) ** 2 for axis in found]
        rows = [(axis.dead_time_s, axis.natural_frequency_rad_s, axis.damping) for axis in found]
        dead_s, omega, zeta = np.average(rows, axis=0, weights=weights)
        return float(dead_s), float(omega), float(zeta)

    def profile_text(self, lag_margin: float, source: str) -> str:
        """The profile as TOML: only what was found. Raises UserError where that is no response."""
        if self.tilt is None:
            raise UserError(f"{source}: tells no response of roll or pitch, so there is nothing to write")
        dead_s, omega, zeta = self.tilt
        lines = [f"# found by companion adopt in {source}", f"lag_margin = {lag_margin:g}"]
        if self.hover is not None:
            lines.append(f"hover_thrust = {self.hover[0]:.3f}")
        lines += [
            "",
            f"[responses.{self.autopilot}]",
            f"dead_time_s = {dead_s:.3f}",
            f"tilt = {{ natural_frequency_rad_s = {omega:.2f}, damping = {zeta:.2f} }}",
        ]
        lines += [
            f"yaw = {{ natural_frequency_rad_s = {axis.natural_frequency_rad_s:.2f}, damping = {axis.damping:.2f} }}"
            for axis in self.axes
            if axis.axis == "yaw"
        ]
        return "\n".join(lines) + "\n"


def adopted(record: FlightRecord) -> Adopted:
    """What `record` tells. Raises UserError for what is no flight at the attitude level."""
    level = record.flight.get("level", "attitude")
    if level != "attitude":
        raise UserError(f"{record.path}: flown at level {level}; adopt takes flights at level attitude")
    autopilot = "ardupilot" if record.flight.get("firmware", "").startswith("ArduPilot") else "px4"
    unknown: list[str] = []
    try:
        found = identify(record)
    except UserError as error:
        found, unknown = [], [str(error)]
    believed = []
    for axis in ("roll", "pitch", "yaw"):
        mine = next((one for one in found if one.axis == axis), None)
        if mine is None:
            unknown.append(f"{axis} did not move enough")
        elif mine.explained < EXPLAINED:
            unknown.append(f"{axis}: the model explains {100 * mine.explained:.0f} % of its motion only")
        elif axis == "yaw" and mine.spread[1] > VAGUE * mine.natural_frequency_rad_s:
            unknown.append("yaw moved too little to tell its lag")
        else:
            believed.append(mine)
    drag = _drag(record)
    if drag is None:
        unknown.append("drag: it never moved fast enough; measured anew in each flight")
    unknown.append("mass and inertia: not needed at the attitude and body-rate levels")
    return Adopted(autopilot, tuple(believed), drag, _hover(record), tuple(unknown))


def _flown(record: FlightRecord) -> tuple[float, float]:
    """From the law's taking over to the landing, autopilot's clock."""
    times = {str(event.fields["phase"]): event.time_s for event in record.events_of("phase")}
    begun = times.get("climb", -math.inf)
    return begun, min(
        (t for name, t in times.items() if name in ("land", "watch", "done") and t > begun), default=math.inf
    )


def _drag(record: FlightRecord) -> tuple[float, float] | None:
    state = record.channel("/state")
    if state is None:
        return None
    begun, ended = _flown(record)
    meter = DragMeter()
    for k in np.flatnonzero((state.time_s >= begun) & (state.time_s < ended)):
        meter.update(float(state.time_s[k]), state["velocity_enu"][k], state["quaternion_wxyz"][k])
    drag, deviation = meter.measured()
    return (drag, deviation) if deviation < 0.5 * SPREAD_1_S else None


def _hover(record: FlightRecord) -> tuple[float, float] | None:
    estimates = record.channel("/estimates")
    if estimates is None:
        return None
    begun, ended = _flown(record)
    flown = estimates["hover_thrust"][(estimates.time_s > begun + 5.0) & (estimates.time_s < ended)]
    return (float(np.median(flown)), float(np.std(flown))) if flown.size else None
