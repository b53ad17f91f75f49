"""Several flights side by side, as the report prints them: RMS by controller and P_imp against TLMBC.

Flights of one controller are averaged over their seeds; they have to share m̂, level, firmware and
trajectory to be compared at all, and where they do not, the table says so.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table
from rich.text import Text

from companion.analysis.metrics import REACTED, FlightMetrics, flight_metrics
from companion.analysis.published import BASELINE, CONTROLLER_ORDER, PUBLISHED_RMS, improvement_percent
from companion.analysis.table import AXES
from companion.analysis.tracking import Tracking
from companion.config.errors import UserError
from companion.flightlog.reader import FlightRecord, read_log

ERRORS = {"position": "position_{}_m", "attitude": "attitude_{}_deg"}
UNITS = {"position": "m", "attitude": "°"}
COMPARED = ("mass_ratio", "level", "firmware", "trajectory")


@dataclass(frozen=True, slots=True)
class Flight:
    """One log of a comparison."""

    record: FlightRecord
    metrics: FlightMetrics
    tracking: Tracking | None


@dataclass(frozen=True, slots=True)
class ControllerResult:
    """One controller's flights together."""

    controller: str
    seeds: tuple[int | None, ...]
    rms: dict[str, tuple[float, ...]]  # by position and attitude: mean over flights, NaN where unknown
    spread: dict[str, tuple[float, ...]]  # standard deviation over flights
    improvement: dict[str, tuple[float, ...]]  # P_imp in %, NaN without a baseline


@dataclass(frozen=True, slots=True)
class Comparison:
    """Several controllers on the same task."""

    flights: list[Flight]
    results: list[ControllerResult]  # in the report's order
    judged_by: str  # truth or estimate: one for all
    notes: list[str]

    def to_json(self) -> dict[str, Any]:
        """Return what `companion compare --json` prints."""
        return {
            "judged_by": self.judged_by,
            "baseline": BASELINE,
            "controllers": {
                item.controller: {
                    "seeds": list(item.seeds),
                    "rms": _named(item.rms),
                    "spread": _named(item.spread),
                    "improvement_percent": _named(item.improvement),
                    "published_rms": PUBLISHED_RMS.get(item.controller),
                }
                for item in self.results
            },
            "flights": [item.metrics.to_json() for item in self.flights],
            "notes": self.notes,
        }


def compare_logs(
    paths: Sequence[str | os.PathLike[str]], from_s: float | None = None, to_s: float | None = None
) -> Comparison:
    """Read and compare flight logs over one window. Raises UserError as `read_log`, or when none of them tracked."""
    flights = []
    for path in paths:
        record = read_log(path)
        flights.append(Flight(record, *flight_metrics(record, from_s, to_s)))
    return compare_flights(flights)


def compare_flights(flights: Sequence[Flight]) -> Comparison:
    """Compare flights already read. Raises UserError when none of them tracked."""
    used = [item for item in flights if item.metrics.samples]
    if not used:
        raise UserError("none of these logs holds tracking that can be compared; see `companion analyze LOG`")
    notes = [
        f"{item.record.path.name}: not compared, no tracking in it"
        for item in flights
        if not item.metrics.samples
    ]
    judged_by = "truth" if all("truth" in item.metrics.samples for item in used) else "estimate"
    if judged_by == "estimate":
        notes.append("judged by the estimate: not every log holds the truth")
    for name in COMPARED:
        values = {getattr(item.metrics, name) for item in used}
        if len(values) > 1:
            notes.append(f"not the same task: {name} is {', '.join(sorted(map(str, values)))}")
    for item in used:
        if item.metrics.ended not in ("completed", "unknown"):
            notes.append(f"{item.record.path.name} ended as {item.metrics.ended!r}")
    for item in used:
        if reacted := [n for n in item.metrics.notes if n.startswith(REACTED)]:
            notes.append(f"{item.record.path.name}: {reacted[0]}")
    groups: dict[str, list[FlightMetrics]] = {}
    for item in used:
        groups.setdefault(item.metrics.controller, []).append(item.metrics)
    if len({tuple(sorted(map(str, (m.seed for m in group)))) for group in groups.values()}) > 1:
        notes.append("the controllers were not flown with the same seeds")
    if BASELINE not in groups:
        notes.append(f"no P_imp: no flight with {BASELINE}")
    columns = {name: _collect(group, judged_by) for name, group in groups.items()}
    baseline = {key: rows.mean(axis=0) for key, rows in columns.get(BASELINE, {}).items()}
    results = []
    for name in sorted(groups, key=_rank):
        mean = {key: tuple(rows.mean(axis=0).tolist()) for key, rows in columns[name].items()}
        spread = {key: tuple(rows.std(axis=0).tolist()) for key, rows in columns[name].items()}
        improvement = {
            key: tuple(
                improvement_percent(float(base), value)
                for base, value in zip(baseline.get(key, [float("nan")] * 3), mean[key], strict=True)
            )
            for key in mean
        }
        seeds = tuple(item.seed for item in groups[name])
        results.append(ControllerResult(name, seeds, mean, spread, improvement))
    return Comparison(list(used), results, judged_by, notes)


def _collect(group: Sequence[FlightMetrics], judged_by: str) -> dict[str, np.ndarray]:
    nothing = (float("nan"),) * 3
    return {
        key: np.array([item.get("rms", pattern.format(judged_by)) or nothing for item in group])
        for key, pattern in ERRORS.items()
    }


def _rank(controller: str) -> tuple[int, str]:
    known = controller in CONTROLLER_ORDER
    return (CONTROLLER_ORDER.index(controller) if known else len(CONTROLLER_ORDER), controller)


def _named(values: dict[str, tuple[float, ...]]) -> dict[str, list[float | None]]:
    return {
        f"{key}_{'m' if key == 'position' else 'deg'}": [None if np.isnan(item) else item for item in row]
        for key, row in values.items()
    }


def comparison_table(comparison: Comparison) -> Group:
    """Return the table as the report prints it: RMS and P_imp by controller, the report's figure in brackets."""
    table = Table(
        title=f"RMS against the {comparison.judged_by} (the report's in brackets), P_imp against {BASELINE.upper()}",
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1),
        collapse_padding=True,
        title_justify="left",
        title_style="bold",
    )
    table.add_column("RMS", no_wrap=True)
    for item in comparison.results:
        count = f"\n{len(item.seeds)} flights" if len(item.seeds) > 1 else ""
        table.add_column(item.controller.upper() + count, justify="right", no_wrap=True)
        if item.controller != BASELINE:
            table.add_column("P_imp %", justify="right", no_wrap=True)
    for key, labels in AXES.items():
        for axis, label in enumerate(labels):
            cells: list[str | Text] = [Text(f"{label} [{UNITS[key]}]")]
            for item in comparison.results:
                goal = PUBLISHED_RMS.get(item.controller, {}).get(
                    f"{key}_{'m' if key == 'position' else 'deg'}"
                )
                value = item.rms[key][axis]
                text = "–" if np.isnan(value) else f"{value:.4f}"
                cells.append(text + (f" ({goal[axis]:.4f})" if goal else ""))
                if item.controller != BASELINE:
                    gain = item.improvement[key][axis]
                    cells.append("–" if np.isnan(gain) else f"{gain:.2f}")
            table.add_row(*cells, end_section=axis == 2)
    return Group(table, *(Text(f"note: {note}", style="yellow") for note in comparison.notes))
