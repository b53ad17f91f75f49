"""The HTML reports: one flight with the report's own figures, and several flights over each other."""

from __future__ import annotations

import math
import os

from companion.analysis.comparison import UNITS, Comparison
from companion.analysis.metrics import FlightMetrics, Triple
from companion.analysis.page import Cell, HtmlTable, Page, require_report_extra
from companion.analysis.published import BASELINE, PUBLISHED_RMS
from companion.analysis.table import AXES
from companion.analysis.tracking import Tracking
from companion.flightlog.reader import Event, FlightRecord

SHOWN_EVENTS = 400


def write_flight_report(
    record: FlightRecord, metrics: FlightMetrics, tracking: Tracking | None, path: str | os.PathLike[str]
) -> None:
    """Write one flight's report. Raises UserError without the report extra or where `path` cannot be written."""
    require_report_extra()
    from companion.analysis import figures, inside_figures

    facts = [metrics.firmware, f"{metrics.level} level"]
    if metrics.mass_ratio is not None:
        facts.append(f"m̂ = {100 * metrics.mass_ratio:.0f} % of m")
    if metrics.seed is not None:
        facts.append(f"seed {metrics.seed}")
    if metrics.window_s is not None:
        facts.append("{:.1f} to {:.1f} s of tracking".format(*metrics.window_s))
    facts.append(f"ended: {metrics.ended}")
    page = Page(
        f"{metrics.controller.upper()} on the {metrics.trajectory}", ", ".join(facts), list(metrics.notes)
    )
    if metrics.samples:
        page.tables.append(_error_table(metrics))
    if tracking is not None:
        page.add_figures(
            "The report's figures",
            [
                ("Path, desired and flown", figures.path_figure(record, tracking)),
                ("Position p(t) and yaw ψ(t)", figures.position_figure(record, tracking)),
                ("Position error e_p(t)", figures.position_error_figure(tracking)),
                ("Attitude error e_η(t)", figures.attitude_error_figure(tracking)),
                ("Thrust and command", figures.command_figure(record, tracking)),
                ("Attitude η(t), wanted and flown", figures.attitude_figure(record, tracking)),
            ],
        )
    page.add_figures(
        "Inside the flight",
        [
            (
                "Terms of the position law",
                inside_figures.force_figure(record, tracking) if tracking else None,
            ),
            ("Networks and Lyapunov functions", inside_figures.network_figure(record)),
            ("Phases and events", inside_figures.phases_figure(record)),
            ("Timing of the control loop", inside_figures.timing_figure(record)),
        ],
    )
    start = tracking.start_s if tracking is not None else 0.0
    page.events = [_event_row(event, start) for event in record.events[:SHOWN_EVENTS]]
    if len(record.events) > SHOWN_EVENTS:
        page.notes.append(f"only the first {SHOWN_EVENTS} of {len(record.events)} events are listed")
    page.facts = [(name, sorted(values.items())) for name, values in sorted(record.metadata.items())]
    page.files = [
        (name, data.decode("utf-8", "replace")) for name, data in sorted(record.attachments.items())
    ]
    page.write(path)


def write_comparison_report(comparison: Comparison, path: str | os.PathLike[str]) -> None:
    """Write several flights' report. Raises UserError without the report extra or where `path` cannot be written."""
    require_report_extra()
    from companion.analysis import overlay_figures

    names = ", ".join(item.controller.upper() for item in comparison.results)
    first = comparison.flights[0].metrics
    mass = "" if first.mass_ratio is None else f", m̂ = {100 * first.mass_ratio:.0f} % of m"
    subtitle = (
        f"{first.trajectory} on {first.firmware}, {first.level} level{mass}; judged by {comparison.judged_by}"
    )
    page = Page(f"Compared: {names}", subtitle, list(comparison.notes), [_comparison_table(comparison)])
    page.add_figures(
        "One flight of each controller",
        [
            ("Path in the plane", overlay_figures.plane_figure(comparison)),
            ("Position error e_p(t)", overlay_figures.position_error_figure(comparison)),
            ("Attitude error e_η(t)", overlay_figures.attitude_error_figure(comparison)),
            ("RMS by controller and flight", overlay_figures.rms_figure(comparison)),
        ],
    )
    page.write(path)


def _error_table(metrics: FlightMetrics) -> HtmlTable:
    source = metrics.judged_by
    published = PUBLISHED_RMS.get(metrics.controller, {})
    header = ["error", f"RMS ({source})", "the report's", "RMS (estimate)", "maximum", "95 %"]
    rows = []
    for group, unit, report, digits in (
        ("position", "m", "position_m", 4),
        ("attitude", "deg", "attitude_deg", 3),
    ):
        judged, estimate = f"{group}_{source}_{unit}", f"{group}_estimate_{unit}"
        for axis, label in enumerate(AXES[group]):
            goal, reached = published.get(report), metrics.get("rms", judged)
            judgement = ""
            if goal is not None and reached is not None:
                judgement = "good" if reached[axis] < goal[axis] else "bad"
            rows.append(
                [
                    Cell(f"{label} [{'m' if unit == 'm' else '°'}]"),
                    Cell(_number(reached, axis, digits), judgement),
                    Cell(_number(goal, axis, 4)),
                    Cell(_number(metrics.get("rms", estimate), axis, digits)),
                    Cell(_number(metrics.get("max", judged), axis, digits)),
                    Cell(_number(metrics.get("p95", judged), axis, digits)),
                ]
            )
    return HtmlTable("Tracking error", header, rows)


def _comparison_table(comparison: Comparison) -> HtmlTable:
    header = ["RMS"]
    for item in comparison.results:
        header.append(
            f"{item.controller.upper()} ({len(item.seeds)} flight{'s' if len(item.seeds) > 1 else ''})"
        )
        header.append("the report's")
        if item.controller != BASELINE:
            header.append("P_imp")
    rows = []
    for key, labels in AXES.items():
        for axis, label in enumerate(labels):
            row = [Cell(f"{label} [{UNITS[key]}]")]
            for item in comparison.results:
                goal = PUBLISHED_RMS.get(item.controller, {}).get(
                    f"{key}_{'m' if key == 'position' else 'deg'}"
                )
                row += [Cell(_number(item.rms[key], axis, 4)), Cell(_number(goal, axis, 4))]
                if item.controller != BASELINE:
                    gain = item.improvement[key][axis]
                    judgement = "" if math.isnan(gain) else "good" if gain > 0 else "bad"
                    row.append(Cell("–" if math.isnan(gain) else f"{gain:.2f} %", judgement))
            rows.append(row)
    return HtmlTable("RMS and improvement", header, rows)


def _event_row(event: Event, start_s: float) -> dict[str, str]:
    fields = {key: value for key, value in event.fields.items() if value is not None}
    text = ", ".join(
        str(value) if key in ("text", event.kind) else f"{key} {value}" for key, value in fields.items()
    )
    time = "" if math.isnan(event.time_s) else f"{event.time_s - start_s:.2f}"
    return {"time": time, "kind": event.kind.replace("_", " "), "text": text}


def _number(numbers: Triple | None, axis: int, digits: int) -> str:
    return "–" if numbers is None or math.isnan(numbers[axis]) else f"{numbers[axis]:.{digits}f}"
