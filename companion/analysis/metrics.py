"""One flight in numbers: RMS, maximum and 95 % of every error, and what the flight was."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.analysis.published import PUBLISHED_RMS
from companion.analysis.streams import stream_delays
from companion.analysis.tracking import Tracking, tracking_errors
from companion.config.safety import Reaction
from companion.control.laws import AUTOPILOT
from companion.flightlog.reactions import in_words, reaction_times
from companion.flightlog.reader import FlightRecord

STATISTICS = ("rms", "max", "p95")
Triple = tuple[float, ...]
REACTED = "not flown as asked throughout"


@dataclass(frozen=True, slots=True)
class Part:
    """What one law reached while it was its turn."""

    controller: str
    window_s: tuple[float, float]  # of tracking
    position_rms_m: Triple  # by the source that the flight is judged by
    attitude_rms_deg: Triple  # NaN where no attitude was asked for


@dataclass(frozen=True, slots=True)
class FlightMetrics:
    """What one flight reached. `values[statistic][error]` is [x, y, z], or [ψ] for the yaw."""

    log: str
    controller: str
    level: str
    firmware: str
    trajectory: str
    mass_ratio: float | None
    seed: int | None
    ended: str
    reactions_s: dict[str, float]  # of the supervisor: seconds under each, softest first
    cut: str
    window_s: tuple[float, float] | None
    heading_deg: float | None  # yaw of the trajectory's x axis: errors are along its axes
    samples: dict[str, int]  # by source
    values: dict[str, dict[str, Triple]]
    notes: list[str]
    streams: dict[str, dict[str, float | None]]  # by message: see `stream_delays`
    parts: tuple[Part, ...] = ()  # of a flight in which laws took turns while tracking

    def get(self, statistic: str, error: str) -> Triple | None:
        """Return one triple, or None where the log does not give it."""
        return self.values.get(statistic, {}).get(error)

    @property
    def judged_by(self) -> str:
        """`truth` where the log has it, else `estimate`."""
        return "truth" if "truth" in self.samples else "estimate"

    def to_json(self) -> dict[str, Any]:
        """Return what `companion analyze --json` prints; numbers that are not known are null."""
        out: dict[str, Any] = {
            name: {key: _plain(item) for key, item in self.values.get(name, {}).items()}
            for name in STATISTICS
        }
        for name in STATISTICS:
            for error in ("position_truth_m", "position_estimate_m", "attitude_deg", "yaw_deg"):
                out[name].setdefault(error, None)
        return out | {
            "window_s": None if self.window_s is None else list(self.window_s),
            "parts": [
                {
                    "controller": part.controller,
                    "window_s": list(part.window_s),
                    "position_rms_m": _plain(part.position_rms_m),
                    "attitude_rms_deg": _plain(part.attitude_rms_deg),
                }
                for part in self.parts
            ],
            "controller": self.controller,
            "level": self.level,
            "firmware": self.firmware,
            "trajectory": self.trajectory,
            "mass_ratio": self.mass_ratio,
            "seed": self.seed,
            "ended": self.ended,
            "reactions_s": self.reactions_s,
            "worst_reaction": next(reversed(self.reactions_s), None),
            "judged_by": self.judged_by if self.samples else None,
            "axes": "the trajectory's own",
            "trajectory_heading_deg": self.heading_deg,
            "samples": self.samples,
            "published_rms": PUBLISHED_RMS.get(self.controller),
            "log": self.log,
            "cut": self.cut or None,
            "streams": self.streams,
            "notes": self.notes,
        }


def flight_metrics(
    record: FlightRecord, from_s: float | None = None, to_s: float | None = None
) -> tuple[FlightMetrics, Tracking | None]:
    """Return a flight's metrics and the errors they come from. Raises UserError for a window outside the tracking."""
    tracking = tracking_errors(record, from_s, to_s)
    values: dict[str, dict[str, Triple]] = {name: {} for name in STATISTICS}
    notes = ["this flight never tracked a trajectory"] if tracking is None else list(tracking.notes)
    if tracking is None and record.cut:
        notes.append(f"the log was cut ({record.cut}); its last record is at {record.end_time_s:.2f} s")
    spent = _reactions(record)
    if reacted := in_words(spent):
        notes.append(f"{REACTED}: {reacted}")
    notes += _losses(record)
    for source, series in (tracking.series if tracking else {}).items():
        columns = {
            f"position_{source}_m": series.position_m,
            f"attitude_{source}_deg": np.degrees(series.attitude_rad),
            f"yaw_{source}_deg": np.degrees(series.yaw_rad)[:, None],
        }
        for name, column in columns.items():
            for statistic, numbers in _statistics(column).items():
                values[statistic][name] = numbers
    sources = tracking.series if tracking else {}
    best = "truth" if "truth" in sources else "estimate"
    for statistic in STATISTICS:
        for angle in ("attitude", "yaw"):
            if (numbers := values[statistic].get(f"{angle}_{best}_deg")) is not None:
                values[statistic][f"{angle}_deg"] = numbers
    facts = record.flight
    metrics = FlightMetrics(
        log=str(record.path),
        controller=facts.get("controller", "unknown"),
        level=facts.get("level", "unknown"),
        firmware=facts.get("firmware", "unknown"),
        trajectory=facts.get("trajectory", "unknown"),
        mass_ratio=_number(facts.get("mass_ratio")),
        seed=None if (seed := _number(facts.get("seed"))) is None else int(seed),
        ended=how_it_ended(record),
        reactions_s={reaction.setting: time_s for reaction, time_s in spent.items()},
        cut=record.cut,
        window_s=tracking.window_s if tracking else None,
        heading_deg=float(np.degrees(tracking.heading_rad)) if tracking else None,
        samples={source: len(series.tracking_time_s) for source, series in sources.items()},
        values=values,
        notes=notes,
        streams=stream_delays(record),
        parts=_parts(record, tracking, best),
    )
    return metrics, tracking


def _parts(record: FlightRecord, tracking: Tracking | None, source: str) -> tuple[Part, ...]:
    """Each law's turn within the window that is looked at; none where one law flew it all."""
    if tracking is None or source not in tracking.series:
        return ()
    from_s, to_s = tracking.window_s
    changes = [
        (event.time_s - tracking.start_s, str(event.fields["controller"]))
        for event in record.events_of("law")
    ]
    before = [change for change in changes if change[0] <= from_s]
    turns = [*before[-1:], *(change for change in changes if from_s < change[0] < to_s)]
    if len(turns) < 2:
        return ()
    series, found = tracking.series[source], []
    for (begins_s, name), (ends_s, _) in zip(turns, [*turns[1:], (to_s, "")], strict=True):
        begins_s = max(from_s, begins_s)
        rows = (series.tracking_time_s >= begins_s) & (series.tracking_time_s < ends_s)
        none = (math.nan,) * 3
        position = _statistics(series.position_m[rows]).get("rms", none)
        asked = _statistics(np.degrees(series.attitude_rad[rows])).get("rms", none)
        attitude = none if name == AUTOPILOT else asked
        found.append(Part(name, (begins_s, ends_s), position, attitude))
    return tuple(found)


def how_it_ended(record: FlightRecord) -> str:
    """Return the outcome the flight logged last, or what its absence means."""
    ends = record.events_of("ended")
    if ends:
        fields = ends[-1].fields
        return str(fields.get("outcome") or fields.get("text") or fields.get("reason") or "unknown")
    return "log cut" if record.cut else "unknown"


def _reactions(record: FlightRecord) -> dict[Reaction, float]:
    """Seconds under each of the supervisor's reactions, up to the last reference that was followed."""
    changes = [
        (event.time_s, Reaction[name])
        for event in record.events_of("safety")
        if "before" in event.fields
        and (name := str(event.fields["reaction"]).upper()) in Reaction.__members__
    ]
    reference = record.channel("/reference")
    end_s = record.end_time_s if reference is None or not len(reference) else float(reference.time_s[-1])
    return reaction_times(changes, end_s)


def _losses(record: FlightRecord) -> list[str]:
    """Say what the log itself says that it misses."""
    counts: dict[str, Any] = dict(record.metadata.get("log", {}))
    if not counts and (accounts := record.events_of("log")):  # a cut log has no closing account
        counts = accounts[-1].fields  # each counts from the log's beginning
    missing = sum(int(_number(str(counts.get(name, 0))) or 0) for name in ("dropped", "rejected", "lost"))
    return (
        [f"the log misses {missing} records: {counts.get('trouble') or 'see its events'}"] if missing else []
    )


def _statistics(column: NDArray[np.float64]) -> dict[str, Triple]:
    """Return RMS, maximum and 95 % of the size of each column (n, k), NaN rows left out."""
    good = column[np.isfinite(column).all(axis=1)]
    if not len(good):
        return {}
    size = np.abs(good)
    return {
        "rms": tuple(np.sqrt(np.mean(good**2, axis=0)).tolist()),
        "max": tuple(size.max(axis=0).tolist()),
        "p95": tuple(np.percentile(size, 95.0, axis=0).tolist()),
    }


def _number(text: str | None) -> float | None:
    try:
        value = float(text) if text is not None else math.nan
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _plain(numbers: Triple) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in numbers]
