"""What a flight left, read into the form that invariants are judged on."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from campaign.draw import PlannedFlight
from campaign.flying import Flown
from campaign.tape import ARMED, MODE, POSITION, QUATERNION, TIME, FloatArray
from campaign.wire import SETPOINTS, Frame, Wire, read_wire

OUTCOMES = {
    "completed": 0,
    "link lost": 1,
    "refused": 2,
    "pilot took over": 3,
    "interrupted": 3,
    "aborted": 3,
    "handed back": 3,
    "left flying": 1,
}
"""What the last line begins with, and the exit code that goes with it (docs, `companion fly --help`)."""


@dataclass(frozen=True)
class LogEvent:
    """One record of `/events`."""

    kind: str
    time_s: float
    fields: dict[str, Any]


@dataclass(frozen=True)
class Evidence:
    """A flight as it is judged. Arrays as in `campaign.tape`."""

    planned: PlannedFlight
    code: int | None
    words: tuple[str, ...] = ()
    stub_code: int = 0
    stub_words: str = ""
    wall_s: float = 0.0
    box: FloatArray = field(default_factory=lambda: np.empty((0, 16)))
    ticks: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    companion_ended_s: float = float("nan")
    armed_at_s: float = float("nan")
    wire: Wire = field(default_factory=lambda: Wire((), True, 0.0))
    events: tuple[LogEvent, ...] = ()
    log_trouble: str = ""
    """Why the log could not be read; empty when it could."""
    log_losses: str = ""
    """Records that the log itself says were lost."""
    log_cut: str = ""
    tracked_s: float = 0.0
    """Longest time in tracking that the log's references reach."""
    position_error_m: float = float("nan")
    """Largest distance of the true position from the reference while tracking."""
    rms_error_m: float = float("nan")

    @property
    def killed(self) -> bool:
        """Whether it was ended by SIGKILL, as planned."""
        return self.planned.kill_at_s is not None and self.code == -9

    @cached_property
    def ending(self) -> tuple[str, str]:
        """Outcome and text of the last word; empty when there is none."""
        for line in reversed(self.words):
            outcome, colon, text = line.partition(": ")
            if colon and outcome in OUTCOMES:
                return outcome, text
            if not line.startswith(("no table: ", "log: ", "put ", "warning: could not put ")):
                break
        return "", ""

    @cached_property
    def setpoints(self) -> list[Frame]:
        """Everything that asked the autopilot for an attitude, rates or actuator values."""
        return [frame for frame in self.wire.frames if frame.outgoing and frame.message_id in SETPOINTS]

    @cached_property
    def tilt_deg(self) -> FloatArray:
        """(n,) true angle between the thrust axis and the vertical."""
        _, x, y, _ = self.box[:, QUATERNION].T
        degrees: FloatArray = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))
        return degrees

    @cached_property
    def height_m(self) -> FloatArray:
        """(n,) above where it stood first."""
        down = self.box[:, POSITION][:, 2]
        return down[0] - down if len(down) else down

    def at(self, time_s: float) -> int:
        """Row of the black box at a simulated time: the last that is not later."""
        return max(0, int(np.searchsorted(self.box[:, TIME], time_s, "right")) - 1)

    @property
    def armed(self) -> FloatArray:
        """(n,) 0 or 1."""
        return self.box[:, ARMED]

    @property
    def modes(self) -> FloatArray:
        """(n,) custom modes."""
        return self.box[:, MODE]


def gather(flown: Flown) -> Evidence:
    """Read the log and put everything together. Never raises on what a flight left."""
    known: dict[str, Any] = {
        "planned": flown.planned,
        "code": flown.code,
        "words": flown.words,
        "stub_code": flown.stub_code,
        "stub_words": flown.stub_words,
        "wall_s": flown.wall_s,
        "box": flown.box,
        "ticks": flown.ticks,
        "companion_ended_s": flown.companion_ended_s,
        "armed_at_s": flown.armed_at_s,
    }
    try:
        known |= _from_log(flown)
    except Exception as error:  # whatever a log does to a reader is a finding, not an end of the campaign
        known["log_trouble"] = f"{type(error).__name__}: {error}"
    return Evidence(**known)


def _from_log(flown: Flown) -> dict[str, Any]:
    from companion.flightlog.reader import read_log

    record = read_log(flown.log)
    losses = record.metadata.get("log", {})
    lost = {name: count for name, count in losses.items() if name != "trouble" and count != "0"}
    found: dict[str, Any] = {
        "wire": read_wire(flown.log, record.utc_offset_ns),
        "events": tuple(LogEvent(event.kind, event.time_s, event.fields) for event in record.events),
        "log_losses": json.dumps(lost) if lost else "",
        "log_cut": record.cut,
    }
    reference, truth = record.channel("/reference"), record.channel("/truth")
    if reference is not None:
        tracking = reference["tracking_time_s"]
        during = np.isfinite(tracking)
        if during.any():
            found["tracked_s"] = float(np.nanmax(tracking))
        if truth is not None and during.sum() > 2 and np.all(np.diff(truth.time_s) > 0):
            times = reference.time_s[during]
            inside = (times >= truth.time_s[0]) & (times <= truth.time_s[-1])
            there = np.column_stack(
                [np.interp(times, truth.time_s, axis) for axis in truth["position_enu"].T]
            )
            error = np.linalg.norm(reference["position_enu"][during] - there, axis=1)[inside]
            if len(error):
                found["position_error_m"] = float(error.max())
                found["rms_error_m"] = float(np.sqrt(np.mean(error**2)))
    return found
