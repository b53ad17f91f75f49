"""Minimum-snap flight through waypoints, from rest to rest.

The file is TOML:

    [limits]                     # optional; the defaults are TransitLimits'
    speed_m_s = 1.5
    [[waypoint]]
    position = [0.0, 0.0, 1.0]   # m, in the trajectory's own axes
    yaw_deg = 0.0                # optional; the yaw of the waypoint before where it is missing
    time_s = 0.0                 # optional, but then for all of them

or CSV with the columns `x, y, z` and optionally `yaw` (rad) or `yaw_deg`, and `t`. Without times the
duration of each segment is found so that speed, acceleration and jerk keep to the limits.
"""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.config.errors import UserError
from companion.control.structs import Vector
from companion.reference.csv_file import check_times_increase, yaw_column
from companion.reference.spline import (
    Spline,
    minimum_snap_derivatives,
    peaks_by_segment,
    snap_integral,
    spline_through,
)
from companion.reference.table_file import LARGEST, read_table, read_text
from companion.reference.transit import TransitLimits

MOST_WAYPOINTS = 2000
LONGEST_S = 1e5
_CSV_COLUMNS = {"t": "t", "time_s": "t"} | {name: name for name in ("x", "y", "z", "yaw", "yaw_deg")}
_LIMIT_NAMES = tuple(
    field.name for field in dataclasses.fields(TransitLimits) if not field.name.startswith("height")
)
_ROUNDS = 60


@dataclass(frozen=True, slots=True)
class Waypoints:
    """What a waypoint file says."""

    positions: Vector  # (n, 3) m
    yaw_rad: Vector  # (n,) continuous
    times_s: Vector | None  # (n,) or None where they are to be found
    limits: TransitLimits


def waypoint_trajectory(path: Path, speed: float | None = None) -> Spline:
    """Read waypoints and return the minimum-snap trajectory through them.

    `speed` overrides the speed limit in m/s (only where the file gives no times). Raises UserError.
    """
    waypoints = read_waypoints(path)
    if speed is not None:
        if waypoints.times_s is not None:
            raise UserError(f"{path}: gives times, so there is no speed to choose; drop one of them")
        if not speed > 0.0:
            raise UserError(f"{path}: speed is {speed:g} m/s; it has to be above 0")
        limits = dataclasses.replace(waypoints.limits, speed_m_s=speed)
        waypoints = dataclasses.replace(waypoints, limits=limits)
    try:
        return minimum_snap(waypoints)
    except ArithmeticError as error:
        raise UserError(f"{path}: {error}") from None


def minimum_snap(waypoints: Waypoints) -> Spline:
    """Return the curve through the waypoints with the least integral of squared snap, from rest to rest.

    Raises ArithmeticError, with what to do, where distances or times differ too much for double precision.
    """
    return spline_through(*minimum_snap_knots(waypoints))


def minimum_snap_knots(waypoints: Waypoints) -> tuple[Vector, Vector]:
    """Return that curve's knots: times (n,) from 0 on, and derivatives (n, 4, 4) [p, v, a, j; x, y, z, yaw]."""
    points = np.column_stack([waypoints.positions, waypoints.yaw_rad])
    if waypoints.times_s is not None:
        times = waypoints.times_s - waypoints.times_s[0]
        return _checked_knots(times, points)
    limits = waypoints.limits
    bounds = np.array([getattr(limits, name) for name in _LIMIT_NAMES])[:, None]
    powers = np.array([1.0, 2.0, 3.0, 1.0, 2.0])[:, None]
    times = _best_times(points, limits)
    # From rest to rest, time stretched by k divides the n-th derivative by k^n exactly.
    with np.errstate(all="ignore"):
        need = (peaks_by_segment(times, _solve(times, points)) / bounds) ** (1.0 / powers)
        times = times * need.max()
    if times[-1] > LONGEST_S:
        raise ArithmeticError(f"the tour would take {times[-1]:.3g} s; raise its limits or shorten it")
    return _checked_knots(times, points)


def _checked_knots(times_s: Vector, points: Vector) -> tuple[Vector, Vector]:
    derivatives = _solve(times_s, points)
    if not (np.isfinite(derivatives).all() and np.isfinite(times_s).all()):
        raise ArithmeticError(
            "distances or times between the waypoints differ too much for one smooth curve; split the tour"
        )
    return times_s, derivatives


def _best_times(points: Vector, limits: TransitLimits) -> Vector:
    """(n,) times of the knots whose ratios give the least integral of squared snap for the total time.

    Descent on log(J total⁷), which does not depend on the total, in the logarithms of the lengths. Without
    it the curve swings wide wherever a guess gives a short segment too much time.
    """
    ways = np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1)
    turns = np.abs(np.diff(points[:, 3]))
    lengths = np.maximum.reduce(
        [
            ways / limits.speed_m_s,
            2.0 * np.sqrt(ways / limits.acceleration_m_s2),
            2.0 * turns / limits.yaw_rate_rad_s,
            np.full(ways.size, 0.1),
        ]
    )
    # The way shapes the times; a turn weighs a tenth of the way that takes as long, so that a turn on the
    # spot gets its time without bending the way elsewhere.
    weights = np.array([1.0, 1.0, 1.0, (0.1 * limits.speed_m_s / limits.yaw_rate_rad_s) ** 2])
    logs = np.log(lengths)

    def objective(logs: Vector) -> tuple[float, Vector]:
        lengths = np.exp(logs)
        total = lengths.sum()
        times = np.concatenate([[0.0], np.cumsum(lengths)])
        with np.errstate(all="ignore"):
            cost, slope = snap_integral(times, _solve(times, points), weights)
        if not (cost > 0.0 and np.isfinite(slope).all()):  # lengths too different for double precision
            return math.inf, np.zeros_like(logs)
        return math.log(cost) + 7.0 * math.log(total), lengths * slope / cost + 7.0 * lengths / total

    value, slope = objective(logs)
    stride = 0.05
    for _ in range(_ROUNDS):
        if np.abs(slope).max() < 1e-3:
            break
        move = np.clip(-stride * slope, -0.5, 0.5)
        tried, tried_slope = objective(logs + move)
        if tried < value:
            # Barzilai-Borwein: the stride that the last change of slope suggests.
            change = float(move @ (slope - tried_slope))
            stride = float(move @ move) / -change if change < 0.0 else 2.0 * stride
            logs, value, slope = logs + move, tried, tried_slope
        else:
            stride *= 0.3
    return np.concatenate([[0.0], np.cumsum(np.exp(logs))])


def _solve(times_s: Vector, points: Vector) -> Vector:
    values = np.zeros((times_s.size, 4, 4))
    values[:, 0] = points
    fixed = np.zeros((times_s.size, 4), dtype=np.bool_)
    fixed[:, 0] = True
    fixed[[0, -1]] = True
    try:
        with np.errstate(all="ignore"):
            return minimum_snap_derivatives(times_s, values, fixed)
    except np.linalg.LinAlgError:
        return np.full_like(values, np.nan)


def read_waypoints(path: Path) -> Waypoints:
    """Read a waypoint file, TOML by its ending, CSV otherwise. Raises UserError with file and line."""
    waypoints = _from_toml(path) if path.suffix.lower() == ".toml" else _from_csv(path)
    n = len(waypoints.positions)
    if not 2 <= n <= MOST_WAYPOINTS:
        raise UserError(f"{path}: {n} waypoints; from 2 to {MOST_WAYPOINTS} are possible")
    if waypoints.times_s is None:
        same = np.flatnonzero(
            (np.diff(waypoints.positions, axis=0) == 0.0).all(axis=1) & (np.diff(waypoints.yaw_rad) == 0.0)
        )
        if same.size:
            raise UserError(
                f"{path}: waypoints {same[0] + 1} and {same[0] + 2} are the same; drop one, or give times"
            )
    return waypoints


def _from_csv(path: Path) -> Waypoints:
    table = read_table(path, _CSV_COLUMNS, required=("x", "y", "z"))
    times = table.columns.get("t")
    if times is not None:
        check_times_increase(table)
    return Waypoints(table.stacked(("x", "y", "z")), yaw_column(table), times, TransitLimits())


def _from_toml(path: Path) -> Waypoints:
    text = read_text(path)
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        line = re.search(r"at line (\d+)", str(error))
        where = f"{path}:{line.group(1)}" if line else str(path)
        raise UserError(f"{where}: not valid TOML: {error}") from None
    unknown = sorted(set(content) - {"limits", "waypoint"})
    if unknown:
        raise UserError(f"{path}: unknown entry '{unknown[0]}'; there may be [limits] and [[waypoint]]")
    entries = content.get("waypoint", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise UserError(f"{path}: waypoints are written as one [[waypoint]] table each")
    headers = [
        number
        for number, line in enumerate(text.splitlines(), start=1)
        if re.match(r"\s*\[\[\s*waypoint\s*\]\]", line)
    ]
    places = [
        f"{path}:{headers[i]}" if len(headers) == len(entries) else f"{path}: waypoint {i + 1}"
        for i in range(len(entries))
    ]
    positions: list[list[float]] = []
    yaws: list[float] = []
    times: list[float] = []
    for place, entry in zip(places, entries, strict=True):
        unknown = sorted(set(entry) - {"position", "yaw_deg", "time_s"})
        if unknown:
            raise UserError(
                f"{place}: unknown entry '{unknown[0]}'; a waypoint has position, yaw_deg, time_s"
            )
        position = entry.get("position")
        if not isinstance(position, list) or len(position) != 3:
            raise UserError(f"{place}: position has to be three numbers [x, y, z] in metres")
        positions.append([_finite(place, "position", value) for value in position])
        previous = yaws[-1] if yaws else 0.0
        yaws.append(_finite(place, "yaw_deg", entry.get("yaw_deg", previous)))
        if ("time_s" in entry) != bool(times) and len(positions) > 1:
            raise UserError(f"{place}: time_s is given for some waypoints only; give it for all or for none")
        if "time_s" in entry:
            times.append(_finite(place, "time_s", entry["time_s"]))
            if len(times) > 1 and times[-1] <= times[-2]:
                raise UserError(f"{place}: time_s {times[-1]:g} does not come after {times[-2]:g}")
    return Waypoints(
        np.array(positions, dtype=np.float64).reshape(-1, 3),
        np.unwrap(np.radians(yaws)),
        np.array(times) if times else None,
        _limits(path, content.get("limits", {})),
    )


def _limits(path: Path, entry: Any) -> TransitLimits:
    if not isinstance(entry, dict):
        raise UserError(f"{path}: [limits] has to be a table")
    unknown = sorted(set(entry) - set(_LIMIT_NAMES))
    if unknown:
        raise UserError(f"{path}: [limits] has no '{unknown[0]}'; there may be {', '.join(_LIMIT_NAMES)}")
    values = {name: _finite(f"{path}: [limits]", name, value) for name, value in entry.items()}
    try:
        return TransitLimits(**values)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None


def _finite(place: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise UserError(f"{place}: {name} has to be a finite number (at most {LARGEST:g}), not {value!r}")
    return float(value)
