"""The report's figures: path, p(t) and ψ(t), e_p(t) and e_η(t), what was sent; and what the law did inside.

Each function returns a matplotlib Figure, or None where the log does not hold what it shows. Drawn 5.2 inches
wide with 9-point type, so that they can still be read at the width of a phone.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from companion.analysis.resets import carried
from companion.analysis.rotation import euler_from_quaternions
from companion.analysis.tracking import Tracking, along_trajectory, desired_euler
from companion.flightlog.reader import FlightRecord, NumericChannel

Array = NDArray[np.float64]

WIDTH_INCH = 5.2
ROW_INCH = 1.25
MOST_POINTS = 2500  # a line of more is only a bigger file
WANTED, TRUE, ESTIMATED = "#4b5563", "#1565c0", "#ef8f00"
AXIS_COLORS = ("#c2185b", "#2e7d32", "#1565c0")  # x, y, z
CONTROLLER_COLORS = {"tlmbc": "#2e7d32", "nnsmc": "#ef8f00", "dtlannc": "#1565c0"}
LEAST_SPAN = {"[m]": 0.1, "[cm]": 0.5, "[°]": 1.0, "[°/s]": 5.0, "[N]": 0.5, "[N m]": 0.02}
"""By unit: less than this is not zoomed into, so that rounding errors do not look like flying."""
STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.1,
    "axes.formatter.useoffset": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "svg.hashsalt": "companion",  # the same log gives the same file
}


@dataclass(frozen=True, slots=True)
class Line:
    """One curve: what it is called, its colour, and its samples."""

    label: str
    color: str
    time_s: Array  # (n,)
    values: Array  # (n, k), one column per row of the figure
    style: str = "-"


def new_figure(rows: int, height_inch: float | None = None) -> tuple[Figure, list[Axes]]:
    """Return a figure of `rows` plots above each other over one time axis."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_INCH, height_inch or ROW_INCH * rows + 0.6), layout="constrained")
        axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    return figure, list(axes)


def time_figure(
    lines: Sequence[Line], labels: Sequence[str], time_label: str = "time of tracking [s]"
) -> Figure:
    """Return one row per label with every line's column in it, and one legend on top."""
    figure, axes = new_figure(len(labels))
    with matplotlib.rc_context(STYLE):
        for row, (axis, label) in enumerate(zip(axes, labels, strict=True)):
            for line in lines:
                times, values = thin(line.time_s, line.values[:, row])
                axis.plot(times, values, line.style, color=line.color, label=line.label)
            axis.set_ylabel(label)
            axis.margins(x=0.0)
            _widen(axis, label)
        figure.align_ylabels(axes)
        axes[-1].set_xlabel(time_label)
        if len(lines) > 1:
            handles, names = axes[0].get_legend_handles_labels()
            figure.legend(handles, names, loc="outside upper center", ncols=min(4, len(lines)))
    return figure


def _widen(axis: Axes, label: str) -> None:
    least = LEAST_SPAN.get(label[label.find("[") :], 0.0)
    low, high = axis.get_ylim()
    if high - low < least:
        middle = (low + high) / 2
        axis.set_ylim(middle - least / 2, middle + least / 2)


def thin(time_s: Array, values: Array, most: int = MOST_POINTS) -> tuple[Array, Array]:
    """Return fewer points that look the same: of every stretch the least and the greatest."""
    if len(time_s) <= most:
        return time_s, values
    size = 2 * -(-len(time_s) // most)
    whole = len(time_s) // size * size
    blocks = np.where(np.isfinite(values[:whole]), values[:whole], 0.0).reshape(-1, size)
    starts = np.arange(0, whole, size)
    chosen = np.unique(
        np.concatenate((starts + blocks.argmin(1), starts + blocks.argmax(1), [len(time_s) - 1]))
    )
    return time_s[chosen], values[chosen]


def _within(channel: NumericChannel | None, tracking: Tracking) -> tuple[Array, NDArray[np.bool_]] | None:
    """Return time of tracking and the rows inside the window, or None without any."""
    if channel is None:
        return None
    since = channel.time_s - tracking.start_s
    rows = (since >= tracking.window_s[0]) & (since <= tracking.window_s[1])
    return (since[rows], rows) if rows.any() else None


def _sources(
    record: FlightRecord, tracking: Tracking
) -> Iterable[tuple[str, str, NumericChannel, Array, Array]]:
    for label, color, topic in (("flown (estimate)", ESTIMATED, "/state"), ("flown (truth)", TRUE, "/truth")):
        channel = carried(record, topic)
        found = _within(channel, tracking)
        if channel is not None and found is not None:
            yield label, color, channel, found[0], found[1]


def on_trajectory(position_enu: Array, tracking: Tracking) -> Array:
    """Return positions (n, 3) m in the trajectory's own frame, where the report draws it."""
    return along_trajectory(position_enu - tracking.origin_enu, tracking.heading_rad)


def path_figure(record: FlightRecord, tracking: Tracking) -> Figure | None:
    """Return the 3D path, desired and flown."""
    reference = record.channel("/reference")
    found = _within(reference, tracking)
    if reference is None or found is None:
        return None
    flown = list(_sources(record, tracking))[-1:]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_INCH, 4.3))
        axes = figure.add_axes((0.0, 0.02, 0.9, 0.92), projection="3d")
        wanted = on_trajectory(reference["position_enu"][found[1]], tracking)
        axes.plot(
            *wanted[:: max(1, len(wanted) // MOST_POINTS)].T, "--", color=WANTED, label="desired", zorder=3
        )
        points = [wanted]
        for label, color, channel, _, rows in flown:
            position = on_trajectory(channel["position_enu"][rows], tracking)
            axes.plot(*position[:: max(1, len(position) // MOST_POINTS)].T, color=color, label=label)
            points.append(position)
        cloud = np.concatenate(points)
        low, high = cloud.min(axis=0), cloud.max(axis=0)
        span = np.maximum(high - low, 0.25 * max(float((high - low).max()), 0.4))
        middle = (low + high) / 2
        for setter, center, size in zip(
            (axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, span, strict=True
        ):
            setter(center - 0.55 * size, center + 0.55 * size)
        axes.set_box_aspect(span, zoom=0.95)
        axes.set_xlabel("x [m]", labelpad=6)
        axes.set_ylabel("y [m]", labelpad=8)
        axes.set_zlabel("z [m]")
        axes.locator_params(nbins=5)
        axes.view_init(elev=28, azim=-55)
        figure.legend(loc="upper center", ncols=2)
    return figure


def position_figure(record: FlightRecord, tracking: Tracking) -> Figure | None:
    """Return p(t) and ψ(t), desired and flown."""
    reference = record.channel("/reference")
    found = _within(reference, tracking)
    if reference is None or found is None:
        return None
    lines = []
    for label, color, channel, since, rows in _sources(record, tracking):
        yaw = _yaw_deg(euler_from_quaternions(channel["quaternion_wxyz"][rows])[:, 2], tracking)
        lines.append(
            Line(
                label,
                color,
                since,
                np.column_stack((on_trajectory(channel["position_enu"][rows], tracking), yaw)),
            )
        )
    rows = found[1]
    yaw = _yaw_deg(reference["yaw_rad"][rows], tracking)
    lines.append(
        Line(
            "desired",
            WANTED,
            found[0],
            np.column_stack((on_trajectory(reference["position_enu"][rows], tracking), yaw)),
            "--",
        )
    )
    return time_figure(lines, ("x [m]", "y [m]", "z [m]", "ψ [°]"))


def _yaw_deg(yaw_rad: Array, tracking: Tracking) -> Array:
    """Return yaw from the trajectory's heading, without jumps, starting within half a turn."""
    yaw = np.unwrap(yaw_rad - tracking.heading_rad)
    return np.degrees(yaw - 2 * np.pi * np.round(yaw[0] / (2 * np.pi)))


def position_error_figure(tracking: Tracking) -> Figure | None:
    """Return e_p(t) in centimetres, by source."""
    lines = [
        Line(
            source, ESTIMATED if source == "estimate" else TRUE, item.tracking_time_s, 100.0 * item.position_m
        )
        for source, item in sorted(tracking.series.items())
    ]
    return time_figure(lines, ("e_x [cm]", "e_y [cm]", "e_z [cm]")) if lines else None


def attitude_error_figure(tracking: Tracking) -> Figure | None:
    """Return e_η(t) in degrees, by source."""
    lines = [
        Line(
            source,
            ESTIMATED if source == "estimate" else TRUE,
            item.tracking_time_s,
            np.degrees(item.attitude_rad),
        )
        for source, item in sorted(tracking.series.items())
        if np.isfinite(item.attitude_rad).any()
    ]
    return time_figure(lines, ("e_φ [°]", "e_θ [°]", "e_ψ [°]")) if lines else None


def command_figure(record: FlightRecord, tracking: Tracking) -> Figure | None:
    """Return the thrust F and what went with it: torque τ, body rates or attitude, by the level flown."""
    setpoint = record.channel("/setpoint")
    found = _within(setpoint, tracking)
    if setpoint is None or found is None:
        return None
    since, rows = found
    level = record.flight.get("level", "")
    thrust = setpoint["thrust_newton"][rows][:, None]
    if level == "actuator":
        rest, labels = setpoint["torque_flu"][rows], ("τ_x [N m]", "τ_y [N m]", "τ_z [N m]")
    elif level == "body_rate":
        rest, labels = np.degrees(setpoint["body_rate_flu"][rows]), ("ω_x [°/s]", "ω_y [°/s]", "ω_z [°/s]")
    else:
        euler = np.unwrap(euler_from_quaternions(setpoint["quaternion_wxyz"][rows]), axis=0)
        rest, labels = np.degrees(euler), ("φ sent [°]", "θ sent [°]", "ψ sent [°]")
    line = Line("sent", TRUE, since, np.column_stack((thrust, rest)))
    return time_figure([line], ("F [N]", *labels))


def attitude_figure(record: FlightRecord, tracking: Tracking) -> Figure | None:
    """Return η(t): the attitude the law wanted and the one flown."""
    wanted = desired_euler(record)
    flown = list(_sources(record, tracking))[-1:]
    if wanted is None or not flown:
        return None
    label, color, channel, since, rows = flown[0]
    euler = np.unwrap(euler_from_quaternions(channel["quaternion_wxyz"][rows]), axis=0)
    time = wanted[0] - tracking.start_s
    inside = (time >= tracking.window_s[0]) & (time <= tracking.window_s[1])
    turns = np.round((wanted[1][inside][:1, 2] - euler[:1, 2]) / (2 * np.pi))
    euler[:, 2] += 2 * np.pi * (turns[0] if len(turns) else 0.0)
    lines = [
        Line(label, color, since, np.degrees(euler)),
        Line("wanted", WANTED, time[inside], np.degrees(wanted[1][inside]), "--"),
    ]
    return time_figure(lines, ("φ [°]", "θ [°]", "ψ [°]"))
