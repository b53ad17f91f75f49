"""A trajectory sampled in a file, interpolated so that a drone can fly it.

Columns: `t, x, y, z` in s and m, increasing in t; optionally `yaw` (rad) or `yaw_deg`; optionally all of
`vx, vy, vz` (m/s), which are then met exactly; optionally `yaw_rate` (rad/s). The curve goes through every
row with the least integral of squared snap, continuous through the 6th derivative (the 5th where
velocities are given). A header that begins with `duration` is one of polynomial pieces, flown as they are.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from companion.config.errors import UserError
from companion.reference.polynomial import ORDER
from companion.reference.spline import Spline, minimum_snap_derivatives, spline_of, spline_through
from companion.reference.table_file import Table, read_table, read_text

SHORTEST_STEP_S = 1e-3  # rows closer than that are noise: their differences are no velocities
LEAST_ROWS = 5  # fewer leave a 7th-order curve undetermined, and are waypoints rather than samples
_ALIASES = (
    dict.fromkeys(("t", "time", "time_s", "t_s", "timestamp_s", "time_sec", "seconds"), "t")
    | {
        spelled: axis
        for axis in "xyz"
        for spelled in (axis, f"{axis}_m", f"p{axis}", f"p_{axis}", f"pos_{axis}", f"position_{axis}")
    }
    | {
        spelled: f"v{axis}"
        for axis in "xyz"
        for spelled in (f"v{axis}", f"v_{axis}", f"vel_{axis}", f"velocity_{axis}", f"{axis}_dot")
    }
    | dict.fromkeys(("yaw", "yaw_rad", "psi"), "yaw")
    | dict.fromkeys(("yaw_deg", "psi_deg"), "yaw_deg")
    | dict.fromkeys(("yaw_rate", "yaw_rate_rad_s", "yawrate", "yaw_dot"), "yaw_rate")
)
_POWERS = tuple(f"{axis}^{power}" for axis in ("x", "y", "z", "yaw") for power in range(ORDER + 1))
_VELOCITY = ("vx", "vy", "vz")


def csv_trajectory(path: Path, speed: float = 1.0) -> Spline:
    """Read a sampled trajectory; time runs from the first row. `speed` flies it that much faster.

    Raises UserError with file and line for anything wrong in the file.
    """
    if not speed > 0.0:
        raise UserError(f"{path}: speed is {speed:g}; it has to be above 0")
    header = next((line for line in read_text(path).splitlines() if line.strip(" \t#")), "")
    if header.strip(' \t#"').lower().startswith("duration"):
        return _polynomial_trajectory(path, speed)
    table = read_table(path, _ALIASES, required=("t", "x", "y", "z"))
    times = table.columns["t"]
    if times.size < LEAST_ROWS:
        raise UserError(
            f"{path}: {times.size} rows; a sampled trajectory needs at least {LEAST_ROWS}. "
            "For a few points use a waypoint file (waypoints:FILE)"
        )
    check_times_increase(table)
    _check_steps(table, times / speed)
    n = times.size
    values = np.zeros((n, 4, 4))
    values[:, 0, :3] = table.stacked(("x", "y", "z"))
    values[:, 0, 3] = yaw_column(table)
    fixed_position = np.zeros((n, 4), dtype=np.bool_)
    fixed_position[:, 0] = True
    fixed_yaw = fixed_position.copy()
    given = [name for name in _VELOCITY if name in table.columns]
    if given:
        if len(given) < 3:
            missing = ", ".join(name for name in _VELOCITY if name not in given)
            raise UserError(f"{path}: velocity needs all of vx, vy, vz; missing: {missing}")
        values[:, 1, :3] = table.stacked(_VELOCITY) * speed
        fixed_position[:, 1] = True
    if "yaw_rate" in table.columns:
        values[:, 1, 3] = table.columns["yaw_rate"] * speed
        fixed_yaw[:, 1] = True
    times = (times - times[0]) / speed
    try:
        with np.errstate(all="ignore"):
            motion = minimum_snap_derivatives(times, values[:, :, :3], fixed_position)
            turning = minimum_snap_derivatives(times, values[:, :, 3:], fixed_yaw)
    except np.linalg.LinAlgError:
        motion = turning = np.full((n, 4, 1), np.nan)
    if not (np.isfinite(motion).all() and np.isfinite(turning).all()):
        raise UserError(f"{path}: time steps differ too much to draw a smooth curve; sample it evenly")
    return spline_through(times, np.concatenate([motion, turning], axis=2))


def _polynomial_trajectory(path: Path, speed: float) -> Spline:
    """Pieces as swarm planners write them: `duration`, then x^0 … x^7, y^0 …, z^0 …, yaw^0 … in powers of seconds."""
    names = ("duration", *_POWERS)
    table = read_table(path, {name: name for name in names}, names)
    lengths = table.columns["duration"]
    if not lengths.size:
        raise UserError(f"{path}: holds no piece")
    short = np.flatnonzero(lengths / speed < SHORTEST_STEP_S)
    if short.size:
        raise UserError(
            f"{table.place(int(short[0]))}: lasts {lengths[short[0]]:g} s; a piece lasts {SHORTEST_STEP_S:g} s or more"
        )
    coefficients = table.stacked(_POWERS).reshape(-1, 4, ORDER + 1)
    coefficients = coefficients * lengths[:, None, None] ** np.arange(
        ORDER + 1.0
    )  # in powers of t / duration
    for i in range(1, len(coefficients)):  # yaw runs on where a planner lets it jump by a turn
        jump = coefficients[i - 1, 3].sum() - coefficients[i, 3, 0]
        coefficients[i, 3, 0] += math.tau * round(jump / math.tau)
    if not np.isfinite(coefficients).all():
        raise UserError(f"{path}: its numbers are too large")
    return spline_of(lengths / speed, coefficients)


def check_times_increase(table: Table) -> None:
    """Raise UserError naming the first row whose time is not above the one before."""
    times = table.columns["t"]
    late = np.flatnonzero(np.diff(times) <= 0.0)
    if late.size:
        row = int(late[0]) + 1
        raise UserError(
            f"{table.place(row)}: time {times[row]:g} s does not come after {times[row - 1]:g} s "
            "of the row before; sort the rows and drop repeated ones"
        )


def _check_steps(table: Table, times_s: np.ndarray) -> None:
    short = np.flatnonzero(np.diff(times_s) < SHORTEST_STEP_S * (1.0 - 1e-6))
    if short.size:
        raise UserError(
            f"{table.place(int(short[0]) + 1)}: only {np.diff(times_s)[short[0]]:.3g} s after the row before; "
            f"rows have to be {SHORTEST_STEP_S:g} s apart or more"
        )


def yaw_column(table: Table) -> np.ndarray:
    """(n,) yaw in rad, continuous (the short way from row to row); zeros where the table has none."""
    if "yaw" in table.columns and "yaw_deg" in table.columns:
        raise UserError(f"{table.path}: has both yaw and yaw_deg; keep one")
    if "yaw_deg" in table.columns:
        return np.unwrap(np.radians(table.columns["yaw_deg"]))
    if "yaw" in table.columns:
        return np.unwrap(table.columns["yaw"])
    return np.zeros(len(table.lines))
