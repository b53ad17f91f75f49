"""The flight that gains are judged on, sampled once: hold, run-in, tracking, as `companion fly` flies them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.config.procedure import Procedure
from companion.control.structs import Reference, Vector
from companion.reference.registry import trajectory_from_text
from companion.reference.trajectory import placed
from companion.reference.transit import TransitLimits, run_in

PERIOD_S = 0.002
"""Grid of the plant: the stub's control period."""
REFERENCE_SIZE = 18
HEADING_RAD = math.pi / 2
"""Body x to the north, as the stub and both real simulators stand; so trajectory x is the vehicle's pitch axis."""


@dataclass(frozen=True, slots=True)
class ReferenceTable:
    """References at the control ticks. `ahead` are those of the moment at which a tick's setpoint acts."""

    periods: NDArray[np.int64]  # (n + 1,) plant period at which each tick falls; the last ends the flight
    now: Vector  # (n, 18): p, v, a, jerk, snap (ENU), yaw, its rate and acceleration
    ahead: Vector  # (n, 18)
    hold_ticks: int  # ticks before the run-in
    track_from: int  # first tick of the tracking
    start: Reference  # where the flight begins, at rest


def row_of(reference: Reference) -> list[float]:
    """A reference as a row of the table."""
    r = reference
    vectors = (r.position_enu, r.velocity_enu, r.acceleration_enu, r.jerk_enu, r.snap_enu)
    return [
        *(float(value) for vector in vectors for value in vector),
        r.yaw_rad,
        r.yaw_rate_rad_s,
        r.yaw_acceleration_rad_s2,
    ]


def reference_table(
    trajectory: str, rate_hz: float, ahead_s: float, track_s: float, hold_s: float = 6.0
) -> ReferenceTable:
    """Lay `trajectory` out 1 m above ground with a hold before it, and sample it. Raises UserError for unknown names."""
    procedure = Procedure()
    limits = TransitLimits(
        speed_m_s=procedure.transit_speed_m_s,
        acceleration_m_s2=procedure.transit_acceleration_m_s2,
        jerk_m_s3=procedure.transit_jerk_m_s3,
    )
    path = placed(trajectory_from_text(trajectory), np.array([0.0, 0.0, 1.0]), HEADING_RAD)
    entry = run_in(path, limits)
    start = entry.sample(0.0)
    track_at = hold_s + entry.duration_s
    track_s = min(track_s, path.duration_s)

    def sample(time_s: float) -> Reference:
        if time_s < hold_s:
            return start
        if time_s < track_at:
            return entry.sample(time_s - hold_s)
        return path.sample(time_s - track_at)

    end_s = track_at + track_s
    count = math.floor(end_s * rate_hz)
    periods = np.ceil(np.arange(count + 1) / (rate_hz * PERIOD_S) - 1e-9).astype(np.int64)
    times = periods[:-1] * PERIOD_S
    return ReferenceTable(
        periods,
        np.array([row_of(sample(float(t))) for t in times]),
        np.array([row_of(sample(float(t) + ahead_s)) for t in times]),
        int(np.searchsorted(times, hold_s)),
        int(np.searchsorted(times, track_at)),
        start,
    )
