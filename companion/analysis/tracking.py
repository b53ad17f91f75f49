"""Errors over time while tracking: position, attitude and yaw, against truth and against the estimate.

Axes are the trajectory's own: a lemniscate laid out along a heading of north has its x along local y, and
only turned back are its errors those of the report's e_x and e_y. Signs as in the report: e_p = p_d - p,
e_η = η_d - η with the yaw wrapped. η_d is the attitude that the control law wanted (Eqs. (17), (18)) before
any lead was added for the autopilot's lag; where a log has no terms it is the attitude that was sent. The law reckons
with the moment at which its setpoint acts, so its η_d is for that moment, up to 0.1 s after the state it was made
of, and is compared with the attitude of that moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.analysis.interpolation import hermite, inside, linear, strictly_rising
from companion.analysis.resets import carried, resets
from companion.analysis.rotation import euler_from_quaternions, wrap_angle
from companion.config.errors import UserError
from companion.flightlog.law_channels import INPUT_TOPIC
from companion.flightlog.reader import FlightRecord, NumericChannel

Array = NDArray[np.float64]

TRACKING_PHASES = ("track", "tracking")


@dataclass(frozen=True, slots=True)
class ErrorSeries:
    """One source's errors. Every row is one of the source's own samples."""

    source: str  # truth or estimate
    tracking_time_s: Array  # (n,) since tracking started
    position_m: Array  # (n, 3) e_p along the trajectory's own axes
    attitude_rad: Array  # (n, 3) e_η; NaN where no η_d was logged
    yaw_rad: Array  # (n,) reference yaw - yaw


@dataclass(frozen=True, slots=True)
class Tracking:
    """The tracking part of a flight within a window."""

    start_s: float  # autopilot time at which tracking started
    window_s: tuple[float, float]  # since then
    heading_rad: float  # yaw, in local ENU, of the trajectory's x axis
    origin_enu: Array  # (3,) m, the trajectory's origin in local ENU
    series: dict[str, ErrorSeries]  # by source
    notes: list[str]  # what the reader of the figures has to know


def tracking_span(record: FlightRecord) -> tuple[float, float] | None:
    """Return autopilot times of the start and end of tracking, or None if the flight never tracked.

    Taken from the reference's own tracking time; from the events in a log that lacks it.
    """
    reference = record.channel("/reference")
    if reference is not None and "tracking_time_s" in reference:
        since = reference["tracking_time_s"]
        active = np.isfinite(since)
        if active.any():
            times = reference.time_s[active]
            return float(times[0] - since[active][0]), float(times[-1])
    start = end = None
    for event in record.events_of("phase"):
        if event.fields.get("phase") in TRACKING_PHASES:
            start, end = event.time_s, None
        elif start is not None and end is None:
            end = event.time_s
    if start is None or reference is None:
        return None
    return start, record.end_time_s if end is None else end


def tracking_errors(
    record: FlightRecord, from_s: float | None = None, to_s: float | None = None
) -> Tracking | None:
    """Return the errors within [from_s, to_s] seconds of tracking (default: all of it); None without tracking.

    Raises UserError for a window that is empty or outside the tracking.
    """
    span = tracking_span(record)
    if span is None:
        return None
    start, end = span
    window = (0.0 if from_s is None else from_s, end - start if to_s is None else to_s)
    if not 0.0 <= window[0] < window[1]:
        raise UserError(
            f"--from {window[0]:g} --to {window[1]:g}: the window must begin at 0 or later and not be empty"
        )
    if window[0] >= end - start:
        raise UserError(f"--from {window[0]:g}: {record.path.name} tracks for {end - start:.2f} s only")
    notes = []
    if record.cut:
        notes.append(
            f"the log was cut ({record.cut}); its last record is at {record.end_time_s - start:.2f} s of tracking"
        )
    if window[1] > end - start + 0.1:
        notes.append(f"--to {window[1]:g} is later than the end of tracking at {end - start:.2f} s")
    window = (window[0], min(window[1], end - start))
    heading, origin = layout(record)
    if heading is None:
        notes.append("the log does not say how the trajectory was laid out: x is east, y is north")
    if record.channel(INPUT_TOPIC) is not None and _meant_for(record) is None:
        notes.append(
            "the log does not say what time η_d is for: attitude errors have the prediction's lead in them"
        )
    series = {}
    for source, topic in (("truth", "/truth"), ("estimate", "/state")):
        channel = carried(record, topic)
        if channel is None:
            notes.append(f"no {source} in this log")
            continue
        found = _errors(record, channel, source, start, window, heading or 0.0)
        if found is None:
            notes.append(f"no sample of the {source} within the window")
        else:
            series[source] = found
    return Tracking(start, window, heading or 0.0, origin, series, notes)


def layout(record: FlightRecord) -> tuple[float | None, Array]:
    """Return heading (rad, None where it was not logged) and origin (3,) m of the trajectory in local ENU."""
    for event in reversed(record.events_of("layout")):
        try:
            origin = np.array(event.fields.get("origin_enu", (0.0, 0.0, 0.0)), dtype=np.float64).reshape(3)
            heading = float(event.fields["heading_rad"])
        except (KeyError, TypeError, ValueError):
            continue
        if np.isfinite(heading) and np.isfinite(origin).all():
            return heading, origin
    return None, np.zeros(3)


def along_trajectory(vectors_enu: Array, heading_rad: float) -> Array:
    """Turn vectors (n, 3) from local ENU to the axes of a trajectory laid out along `heading_rad`."""
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    return vectors_enu @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _errors(
    record: FlightRecord,
    channel: NumericChannel,
    source: str,
    start: float,
    window: tuple[float, float],
    heading_rad: float,
) -> ErrorSeries | None:
    reference = record.channels["/reference"]
    rows = strictly_rising(reference.time_s)
    if "tracking_time_s" in reference and np.isfinite(reference["tracking_time_s"]).any():
        rows = rows[
            np.isfinite(reference["tracking_time_s"][rows])
        ]  # never across the start or end of tracking
    known = reference.time_s[rows]
    times = channel.time_s
    chosen = (times >= start + window[0] - 1e-9) & (times <= start + window[1] + 1e-9) & inside(known, times)
    for reset_s in resets(record)[0]:  # a reference from either side of a jump is that of neither
        before_s = known[max(0, int(np.searchsorted(known, reset_s - 1e-9)) - 1)]
        chosen &= ~((times > before_s + 1e-9) & (times < reset_s - 1e-9))
    if not chosen.any():
        return None
    at = times[chosen]
    wanted = hermite(known, reference["position_enu"][rows], reference["velocity_enu"][rows], at)
    yaw = np.unwrap(reference["yaw_rad"][rows])[:, None]
    wanted_yaw = hermite(known, yaw, reference["yaw_rate_rad_s"][rows][:, None], at)[:, 0]
    euler = euler_from_quaternions(channel["quaternion_wxyz"][chosen])
    return ErrorSeries(
        source=source,
        tracking_time_s=at - start,
        position_m=along_trajectory(wanted - channel["position_enu"][chosen], heading_rad),
        attitude_rad=_attitude_error(record, at, euler),
        yaw_rad=wrap_angle(wanted_yaw - euler[:, 2]),
    )


def desired_euler(record: FlightRecord) -> tuple[Array, Array] | None:
    """Return the times (n,) it is for and η_d (n, 3) rad without jumps, or None in a log without either source of it."""
    terms, setpoint = record.channel("/terms"), record.channel("/setpoint")
    if terms is not None and "euler_desired" in terms:
        times, euler = terms.time_s, terms["euler_desired"]
        meant = _meant_for(record)
        if meant is not None:
            count = min(len(times), len(meant))  # a cut can fall between the two
            times, euler = meant[:count], euler[:count]
    elif setpoint is not None and "quaternion_wxyz" in setpoint:
        times, euler = setpoint.time_s, euler_from_quaternions(setpoint["quaternion_wxyz"])
    else:
        return None
    rows = strictly_rising(times)
    rows = rows[np.isfinite(euler[rows]).all(axis=1)]
    return (times[rows], np.unwrap(euler[rows], axis=0)) if len(rows) > 1 else None


def _meant_for(record: FlightRecord) -> Array | None:
    """Times (n,) that the rows of /terms are for; None in a log of before they were written down."""
    inputs = record.channel(INPUT_TOPIC)
    return inputs["time"] if inputs is not None and "time" in inputs else None


def _attitude_error(record: FlightRecord, at: Array, euler: Array) -> Array:
    desired = desired_euler(record)
    if desired is None:
        return np.full_like(euler, np.nan)
    times, wanted = desired
    error = wrap_angle(linear(times, wanted, at) - euler)
    error[~inside(times, at)] = np.nan
    return error
