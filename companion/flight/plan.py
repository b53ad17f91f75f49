"""The flight laid out in time, before anything is armed: climb, go to start, hold, run in, track, run out, return.

The parts meet in position, velocity and acceleration, so that the control law can look ahead across
their joints. Sampling is by time since the plan began, which is the moment of lift-off.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass

from companion.control.structs import Reference
from companion.flight.phases import Phase
from companion.reference.hold import Hold
from companion.reference.trajectory import Placed, Trajectory, resting, told_in_flight
from companion.reference.transit import TransitLimits, climb, run_in, run_out, transit

STANDS_S = 0.1


@dataclass(frozen=True, slots=True)
class Leg:
    """One part of the plan."""

    phase: Phase
    trajectory: Trajectory
    start_s: float  # since the plan began
    duration_s: float  # flown, which may be less than the trajectory's own

    @property
    def moves_s(self) -> float:
        """For how long there is something to look at: a vehicle may stand at one point for hours."""
        own = self.trajectory.trajectory if isinstance(self.trajectory, Placed) else self.trajectory
        stands = isinstance(own, Hold) or told_in_flight(own)
        return min(self.duration_s, STANDS_S) if stands else self.duration_s


class FlightPlan:
    """See the module."""

    def __init__(self, legs: list[tuple[Phase, Trajectory, float]]) -> None:
        self.legs: list[Leg] = []
        start_s = 0.0
        for phase, trajectory, duration_s in legs:
            self.legs.append(Leg(phase, trajectory, start_s, duration_s))
            start_s += duration_s
        self.duration_s = start_s
        self._starts = [leg.start_s for leg in self.legs]

    def leg_at(self, time_s: float) -> Leg:
        """The leg flown at `time_s` since the plan began; the first before, the last after."""
        return self.legs[max(0, bisect.bisect_right(self._starts, time_s) - 1)]

    def sample(self, time_s: float) -> Reference:
        """The reference at `time_s` since the plan began."""
        leg = self.leg_at(time_s)
        return leg.trajectory.sample(min(time_s - leg.start_s, leg.duration_s))

    def climbing_from(self, start: Reference, limits: TransitLimits) -> FlightPlan:
        """The same plan with its climb beginning at `start`, where the vehicle really left the ground."""
        legs = [(leg.phase, leg.trajectory, leg.duration_s) for leg in self.legs]
        up = transit(start, self.legs[0].trajectory.sample(self.legs[0].duration_s), limits)
        return FlightPlan([(Phase.CLIMB, up, up.duration_s), *legs[1:]])

    def change_from(self, time_s: float, legs: list[tuple[Phase, Trajectory, float]]) -> None:
        """End the leg flown at `time_s` then, and fly `legs` from there on: they begin as it ends."""
        index = self.legs.index(self.leg_at(time_s))
        flown = [(leg.phase, leg.trajectory, leg.duration_s) for leg in self.legs[:index]]
        cut = self.legs[index]
        changed = FlightPlan([*flown, (cut.phase, cut.trajectory, time_s - cut.start_s), *legs])
        self.legs, self.duration_s, self._starts = changed.legs, changed.duration_s, changed._starts

    def leg(self, phase: Phase) -> Leg:
        """The leg of a phase (each comes once)."""
        return next(leg for leg in self.legs if leg.phase is phase)


def lay_out(
    ground: Reference,
    trajectory: Trajectory,
    track_s: float,
    hold_s: float,
    height_m: float,
    limits: TransitLimits,
) -> FlightPlan:
    """Plan a whole flight.

    Args:
        ground: the vehicle at rest where it stands (local ENU).
        trajectory: what is to be tracked, already placed in local ENU.
        track_s: how long it is tracked; longer than the trajectory is cut to its duration.
        hold_s: how long to hold before the run-in.
        height_m: take-off height above the ground.
        limits: for everything but the tracking itself.
    """
    up = climb(ground, float(ground.position_enu[2]) + height_m, limits)
    top = up.sample(up.duration_s)
    legs = _there_and_back(top, trajectory, track_s, hold_s, limits)
    return FlightPlan([(Phase.CLIMB, up, up.duration_s), *legs])


def lay_out_in_air(
    stop: Trajectory, trajectory: Trajectory, track_s: float, hold_s: float, limits: TransitLimits
) -> FlightPlan:
    """Plan a flight that begins in the air with `stop`, which brings the vehicle to rest, and ends there; see `lay_out`."""
    legs = _there_and_back(stop.sample(stop.duration_s), trajectory, track_s, hold_s, limits)
    return FlightPlan([(Phase.STOP, stop, stop.duration_s), *legs])


def _there_and_back(
    top: Reference, trajectory: Trajectory, track_s: float, hold_s: float, limits: TransitLimits
) -> list[tuple[Phase, Trajectory, float]]:
    track_s = min(track_s, trajectory.duration_s)
    entry = run_in(trajectory, limits)
    start = entry.sample(0.0)
    go = transit(top, start, limits)
    x_m, y_m, height_m = start.position_enu.tolist()
    hold = Hold(x_m, y_m, height_m, start.yaw_rad)
    return [
        (Phase.GO_TO_START, go, go.duration_s),
        (Phase.HOLD, hold, hold_s),
        (Phase.RUN_IN, entry, entry.duration_s),
        (Phase.TRACK, trajectory, track_s),
        *way_back(trajectory.sample(track_s), resting(top.position_enu, top.yaw_rad), limits),
    ]


def way_back(
    now: Reference, above_home: Reference, limits: TransitLimits, stop_limits: TransitLimits | None = None
) -> list[tuple[Phase, Trajectory, float]]:
    """The legs after tracking: from a moving reference to rest (within `stop_limits`), and to rest at `above_home`."""
    leave = run_out(now, stop_limits or limits)
    back = transit(leave.sample(leave.duration_s), above_home, limits)
    return [(Phase.RUN_OUT, leave, leave.duration_s), (Phase.RETURN, back, back.duration_s)]


def stopping_plan(now: Reference, limits: TransitLimits, hold_s: float) -> FlightPlan:
    """From a moving reference to rest, then stand there: what the supervisor's HOLD flies. Takes about 1 ms to plan."""
    leave = run_out(now, limits)
    rest = leave.sample(leave.duration_s)
    x_m, y_m, height_m = rest.position_enu.tolist()
    return FlightPlan(
        [
            (Phase.RUN_OUT, leave, leave.duration_s),
            (Phase.HOLD, Hold(x_m, y_m, height_m, rest.yaw_rad), hold_s),
        ]
    )


def tracking_time(plan: FlightPlan, time_s: float) -> float:
    """Seconds since tracking began; nan while not tracking."""
    leg = plan.leg_at(time_s)
    return time_s - leg.start_s if leg.phase is Phase.TRACK else math.nan
