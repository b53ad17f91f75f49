"""Figures of a comparison: one flight of each controller over the others, and the RMS of all."""

from __future__ import annotations

from collections.abc import Iterator

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from companion.analysis.comparison import Comparison, Flight
from companion.analysis.figures import (
    CONTROLLER_COLORS,
    MOST_POINTS,
    STYLE,
    WANTED,
    WIDTH_INCH,
    Line,
    on_trajectory,
    time_figure,
)
from companion.analysis.published import PUBLISHED_RMS
from companion.analysis.resets import carried
from companion.analysis.tracking import ErrorSeries

OTHER_COLORS = ("#2e7d32", "#c2185b", "#8e24aa", "#00838f")


def _color(controller: str, rank: int) -> str:
    return CONTROLLER_COLORS.get(controller, OTHER_COLORS[rank % len(OTHER_COLORS)])


def _first_flights(comparison: Comparison) -> Iterator[tuple[Flight, ErrorSeries, str, str]]:
    """One flight of each controller, the first given: with its errors, a label and a colour."""
    for rank, item in enumerate(comparison.results):
        flight = next(one for one in comparison.flights if one.metrics.controller == item.controller)
        if flight.tracking is not None:
            seed = "" if flight.metrics.seed is None else f" (seed {flight.metrics.seed})"
            label = f"{item.controller.upper()}{seed}"
            yield flight, flight.tracking.series[comparison.judged_by], label, _color(item.controller, rank)


def position_error_figure(comparison: Comparison) -> Figure:
    """Return e_p(t) of one flight of each controller, cm."""
    lines = [
        Line(label, color, series.tracking_time_s, 100.0 * series.position_m)
        for _, series, label, color in _first_flights(comparison)
    ]
    return time_figure(lines, ("e_x [cm]", "e_y [cm]", "e_z [cm]"))


def attitude_error_figure(comparison: Comparison) -> Figure | None:
    """Return e_η(t) of one flight of each controller, degrees."""
    lines = [
        Line(label, color, series.tracking_time_s, np.degrees(series.attitude_rad))
        for _, series, label, color in _first_flights(comparison)
        if np.isfinite(series.attitude_rad).any()
    ]
    return time_figure(lines, ("e_φ [°]", "e_θ [°]", "e_ψ [°]")) if lines else None


def plane_figure(comparison: Comparison) -> Figure:
    """Return the paths seen from above, with the desired one."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_INCH, 4.4), layout="constrained")
        axis = figure.subplots()
        topic = "/truth" if comparison.judged_by == "truth" else "/state"
        for number, (flight, _, label, color) in enumerate(_first_flights(comparison)):
            assert flight.tracking is not None
            start, window = flight.tracking.start_s, flight.tracking.window_s
            for source, style, name in (("/reference", "--", "desired"), (topic, "-", label)):
                if source == "/reference" and number:
                    continue
                channel = carried(flight.record, source)
                assert channel is not None
                since = channel.time_s - start
                rows = (since >= window[0]) & (since <= window[1])
                position = on_trajectory(channel["position_enu"][rows], flight.tracking)
                position = position[:: max(1, len(position) // MOST_POINTS)]
                line_color = WANTED if source == "/reference" else color
                order = 3 if source == "/reference" else 2
                axis.plot(position[:, 0], position[:, 1], style, color=line_color, label=name, zorder=order)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel("x [m]")
        axis.set_ylabel("y [m]")
        figure.legend(loc="outside upper center", ncols=2)
    return figure


def rms_figure(comparison: Comparison) -> Figure:
    """Return the RMS of e_p: mean over flights as bars, single flights as dots, the report's as a line."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_INCH, 3.2), layout="constrained")
        axis = figure.subplots()
        count = len(comparison.results)
        width = 0.8 / count
        for rank, item in enumerate(comparison.results):
            places = np.arange(3) - 0.4 + width * (rank + 0.5)
            color = _color(item.controller, rank)
            axis.bar(places, 100.0 * np.array(item.rms["position"]), 0.9 * width, color=color, alpha=0.75)
            axis.plot([], [], "s", color=color, label=item.controller.upper())
            for flight in comparison.flights:
                if flight.metrics.controller == item.controller:
                    rms = flight.metrics.get("rms", f"position_{comparison.judged_by}_m")
                    if rms is not None:
                        axis.plot(places, 100.0 * np.array(rms), ".", color="black", markersize=4)
            goal = PUBLISHED_RMS.get(item.controller)
            if goal is not None:
                axis.hlines(
                    100.0 * np.array(goal["position_m"]),
                    places - 0.45 * width,
                    places + 0.45 * width,
                    color="#b91c1c",
                    linewidth=1.6,
                )
        axis.plot([], [], "-", color="#b91c1c", label="the report's")
        axis.set_xticks(np.arange(3), ("e_x", "e_y", "e_z"))
        axis.set_ylabel("RMS [cm]")
        axis.grid(axis="x", visible=False)
        figure.legend(loc="outside upper center", ncols=4)
    return figure
