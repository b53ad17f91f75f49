"""What is asked of a flight, how it ended, and what its parts share while it goes on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from companion.autopilot.adapter import Intent
from companion.control.structs import ControlLevel
from companion.flight.control_loop import ControlLoop
from companion.flight.outcome import Outcome
from companion.flight.phases import Phase
from companion.flight.plan import FlightPlan
from companion.flight.recorder import Recorder
from companion.flight.reporter import Reporter
from companion.flight.vehicle import Vehicle
from companion.reference.trajectory import Frame, Trajectory


@dataclass(frozen=True, slots=True)
class FlightRequest:
    """What is asked of a flight."""

    level: ControlLevel
    trajectory: Trajectory  # in its own axes
    frame: Frame
    duration_s: float  # of tracking
    may_arm: bool  # whether we may arm a vehicle that is not a simulation
    fix: bool  # whether parameters that stand in the way may be set for the flight
    wait_for_offboard: bool  # whether the mode switch is the pilot's
    then: Intent = Intent.LAND  # what the autopilot is asked for once the plan is flown


@dataclass(frozen=True, slots=True)
class FlightResult:
    """How it ended."""

    outcome: Outcome
    text: str


class Interrupts:
    """Counts requests to stop (Ctrl-C, SIGTERM); set from a signal handler, read by the flight."""

    ONE_WISH_S = 0.5
    """Signals closer than this are one wish: `timeout` and some terminals send theirs twice."""

    def __init__(self) -> None:
        self.count = 0
        self._last_s = -math.inf

    def ask(self, now_s: float) -> None:
        """Note a request made at `now_s` (any clock)."""
        if now_s - self._last_s > self.ONE_WISH_S:
            self.count += 1
        self._last_s = now_s


@dataclass
class Stage:
    """Where a flight stands: the one place for what both its way up and its way down go by."""

    vehicle: Vehicle
    recorder: Recorder
    reporter: Reporter
    phase: Phase = Phase.CONNECT
    loop: ControlLoop | None = None  # none before the autopilot is known
    plan: FlightPlan | None = None  # none before the vehicle stands ready
    engaged: bool = False  # our mode was confirmed and we count on it
    ending: bool = False  # what counts from here on is who has the vehicle next
    airborne: bool = False
    nobody_has_it: Callable[[], str] = lambda: ""
    """After a hand-over to the sticks: why nobody is believed to have the vehicle; empty while somebody is."""
    then: Intent = Intent.LAND  # what the autopilot is asked for once the plan is flown
    ground_m: float = 0.0  # height of the place of take-off in the local frame

    def enter(self, phase: Phase) -> None:
        """Begin a phase: the log and the pilot are told."""
        self.phase = phase
        self.recorder.log.event("phase", self.vehicle.link.autopilot_time_s, phase=phase.value)
        self.reporter.progress(phase, math.nan, math.nan, "")

    def stop_setpoints(self) -> None:
        """Send none any more."""
        if self.loop is not None:
            self.loop.stop()
