"""Figures of what cannot be seen from outside: the force's terms, the networks, the loop's timing, the phases."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from companion.analysis.figures import (
    AXIS_COLORS,
    ESTIMATED,
    STYLE,
    TRUE,
    WANTED,
    Line,
    new_figure,
    thin,
    time_figure,
)
from companion.analysis.tracking import Tracking
from companion.flightlog.reader import FlightRecord

TERM_COLORS = {
    "proportional": "#1565c0",
    "integral": "#2e7d32",
    "network": "#c2185b",
    "sign": "#8e24aa",
}
PHASE_COLORS = ("#dbeafe", "#fef3c7", "#dcfce7", "#fce7f3", "#ede9fe", "#e0f2fe", "#ffedd5", "#f1f5f9")
MARKED_EVENTS = ("warning", "safety", "log", "ended")


def force_figure(record: FlightRecord, tracking: Tracking) -> Figure | None:
    """Return the terms of the position law, Eq. (13), axis by axis; the model's known part left out."""
    terms = record.channel("/terms")
    if terms is None or "position_proportional_term" not in terms:
        return None
    since = terms.time_s - tracking.start_s
    rows = (since >= tracking.window_s[0]) & (since <= tracking.window_s[1])
    lines = [
        Line(name, color, since[rows], terms[f"position_{name}_term"][rows])
        for name, color in TERM_COLORS.items()
        if np.any(terms[f"position_{name}_term"][rows])
    ]
    return time_figure(lines, ("f_x [N]", "f_y [N]", "f_z [N]")) if lines and rows.any() else None


def network_figure(record: FlightRecord) -> Figure | None:
    """Return the norm of both networks' weights and both Lyapunov functions over the whole flight."""
    terms = record.channel("/terms")
    names = ("position_weight_norm", "attitude_weight_norm", "position_lyapunov", "attitude_lyapunov")
    if terms is None or not all(name in terms for name in names):
        return None
    start = terms.time_s[0]
    columns = np.column_stack([terms[name] for name in names])
    labels = ("‖Ŵ_p‖ [N]", "‖Ŵ_η‖ [N m]", "V_p [J]", "V_η [J]")
    return time_figure([Line("", TRUE, terms.time_s - start, columns)], labels, "time of control [s]")


def timing_figure(record: FlightRecord) -> Figure | None:
    """Return the loop's period and the time from message to setpoint, worst of every stretch kept."""
    timing = record.channel("/timing")
    if timing is None or "period_s" not in timing or "compute_s" not in timing:
        return None
    figure, axes = new_figure(2)
    since = timing.time_s - timing.time_s[0]
    with matplotlib.rc_context(STYLE):
        rows = (("period_s", "period [ms]", TRUE), ("compute_s", "in to out [ms]", ESTIMATED))
        for axis, (name, label, color) in zip(axes, rows, strict=True):
            values = 1000.0 * timing[name]
            axis.plot(*thin(since, values), color=color, linewidth=0.7)
            good = values[np.isfinite(values)]
            if len(good):
                middle, late = np.percentile(good, [50, 99])
                text = f"median {middle:.2f}, 99 % {late:.2f}, worst {good.max():.2f} ms"
                axis.set_title(text, loc="right", color="#374151")
            axis.set_ylabel(label)
            axis.set_ylim(bottom=0.0)
            axis.margins(x=0.0)
        axes[-1].set_xlabel("time of control [s]")
    return figure


def phases_figure(record: FlightRecord) -> Figure | None:
    """Return the height over the whole flight, the phases behind it and the events that matter on it."""
    channel = record.channel("/truth") or record.channel("/state")
    if channel is None:
        return None
    phases = record.events_of("phase")
    start = min([channel.time_s[0], *(event.time_s for event in phases if np.isfinite(event.time_s))])
    end = max(record.end_time_s, channel.time_s[-1])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.2, 2.6), layout="constrained")
        axis = figure.subplots()
        axis.plot(*thin(channel.time_s - start, channel["position_enu"][:, 2]), color=TRUE)
        names = list(dict.fromkeys(str(event.fields.get("phase")) for event in phases))
        borders = [event.time_s for event in phases[1:]] + [end]
        for event, border in zip(phases, borders, strict=True):
            name = str(event.fields.get("phase"))
            color = PHASE_COLORS[names.index(name) % len(PHASE_COLORS)]
            axis.axvspan(event.time_s - start, border - start, color=color, linewidth=0)
            if border - event.time_s > 0.02 * (end - start):
                middle = (event.time_s + border) / 2 - start
                axis.annotate(
                    name.replace("_", " "),
                    (middle, 0.98),
                    xycoords=("data", "axes fraction"),
                    rotation=90,
                    ha="center",
                    va="top",
                    fontsize=7.5,
                    color="#374151",
                )
        for event in record.events:
            if event.kind in MARKED_EVENTS and np.isfinite(event.time_s):
                color = WANTED if event.kind == "ended" else AXIS_COLORS[0]
                axis.axvline(event.time_s - start, color=color, linestyle=":", linewidth=1.0)
        axis.set_xlim(0.0, end - start)
        low, high = axis.get_ylim()
        axis.set_ylim(low, high + 0.5 * (high - low))
        axis.set_ylabel("height [m]")
        axis.set_xlabel("time of flight [s]")
        axis.grid(False)
    return figure
