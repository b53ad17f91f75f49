"""Tables for the terminal: one flight beside the report's figures, and several controllers with P_imp."""

from __future__ import annotations

from rich.console import Group
from rich.table import Table
from rich.text import Text

from companion.analysis.metrics import FlightMetrics, Triple
from companion.analysis.published import PUBLISHED_RMS

AXES = {"position": ("e_x", "e_y", "e_z"), "attitude": ("e_φ", "e_θ", "e_ψ")}


def flight_table(metrics: FlightMetrics) -> Group:
    """Return one flight's table: RMS beside the report's, maximum and 95 %, truth and estimate."""
    source = metrics.judged_by
    window = (
        "no tracking" if metrics.window_s is None else "{:.1f}–{:.1f} s of tracking".format(*metrics.window_s)
    )
    mass = "" if metrics.mass_ratio is None else f", m̂ = {100 * metrics.mass_ratio:.0f} %"
    title = f"{metrics.controller.upper()} at {metrics.level} level on {metrics.firmware}{mass}, {window}"
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("error", no_wrap=True)
    for name in (f"RMS ({source})", "report", "RMS (estimate)", "max", "95 %"):
        table.add_column(name, justify="right", no_wrap=True)
    published = PUBLISHED_RMS.get(metrics.controller, {})
    rows = (("position", "m", f"position_{source}_m", "position_estimate_m", "position_m", 4),)
    angles = (("attitude", "°", f"attitude_{source}_deg", "attitude_estimate_deg", "attitude_deg", 3),)
    for group, unit, judged, estimate, report, digits in rows + angles:
        for axis, label in enumerate(AXES[group]):
            goal = published.get(report)
            table.add_row(
                Text(f"{label} [{unit}]"),
                _judged(metrics.get("rms", judged), axis, digits, goal),
                _cell(goal, axis, 4),
                _cell(metrics.get("rms", estimate), axis, digits),
                _cell(metrics.get("max", judged), axis, digits),
                _cell(metrics.get("p95", judged), axis, digits),
                end_section=axis == 2,
            )
    lines = [Text(f"ended: {metrics.ended}", style="green" if metrics.ended == "completed" else "yellow")]
    lines += [_stream_line(name, numbers) for name, numbers in metrics.streams.items()]
    lines += [Text(f"note: {note}", style="yellow") for note in metrics.notes]
    if metrics.parts:
        return Group(table, parts_table(metrics), *lines)
    return Group(table, *lines) if metrics.samples else Group(*lines)


def parts_table(metrics: FlightMetrics) -> Table:
    """One row for each law's turn: RMS over it."""
    title = f"laws in turn, RMS in m and ° ({metrics.judged_by})"
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("law", no_wrap=True)
    table.add_column("tracking", justify="right", no_wrap=True)
    for label in (*AXES["position"], *AXES["attitude"]):
        table.add_column(label, justify="right", no_wrap=True)
    for part in metrics.parts:
        numbers = (*(f"{value:.4f}" for value in part.position_rms_m),)
        angles = ("–" if value != value else f"{value:.3f}" for value in part.attitude_rms_deg)
        table.add_row(part.controller, "{:.1f}–{:.1f} s".format(*part.window_s), *numbers, *angles)
    return table


def _stream_line(name: str, numbers: dict[str, float | None]) -> Text:
    """How one stream of the autopilot arrived."""
    rate, jitter, age, age_95 = (numbers[key] for key in ("rate_hz", "jitter_s", "age_s", "age_95_s"))
    text = f"stream {name}: {rate or 0.0:.0f} Hz"
    if age is not None and age_95 is not None and jitter is not None:
        text += f", {age * 1e3:.1f} ms old (95 %: {age_95 * 1e3:.1f}), jitter {jitter * 1e3:.1f} ms"
    return Text(text)


def _cell(numbers: Triple | None, axis: int, digits: int) -> str:
    return "–" if numbers is None else f"{numbers[axis]:.{digits}f}"


def _judged(numbers: Triple | None, axis: int, digits: int, goal: Triple | None) -> Text:
    """Return the figure, green where it is better than the report's and red where it is not."""
    if numbers is None or goal is None:
        return Text(_cell(numbers, axis, digits))
    return Text(_cell(numbers, axis, digits), style="green" if numbers[axis] < goal[axis] else "red")
