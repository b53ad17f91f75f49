"""What the commands do, as functions: `companion.fly(…)` is `companion fly …`, with results instead of printed tables."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.analysis.comparison import Comparison, compare_logs
from companion.analysis.metrics import FlightMetrics, flight_metrics
from companion.analysis.replay import Replay
from companion.analysis.replay import replay as replay_record
from companion.autopilot.adapter import Finding, Verdict
from companion.cli import check as check_command
from companion.cli import fly as fly_command
from companion.config.errors import UserError
from companion.control.law import ControlLaw
from companion.flight.outcome import Outcome
from companion.flightlog.reader import FlightRecord, read_log


@dataclass(frozen=True, slots=True)
class Flown:
    """How a flight ended, and where its log is."""

    outcome: Outcome
    text: str  # the last word, a sentence
    log: Path


@dataclass(frozen=True, slots=True)
class Checked:
    """What stands in the way of a flight, or might."""

    findings: tuple[Finding, ...]

    @property
    def flyable(self) -> bool:
        """Whether nothing is refused; warnings may be there."""
        return all(finding.verdict is not Verdict.REFUSAL for finding in self.findings)


def fly(
    endpoint: str | None = None,
    *,
    sitl: str | None = None,
    controller: str = "dtlannc",
    level: str = "attitude",
    trajectory: str = "lemniscate",
    duration_s: float = 40.0,
    seed: int = 1,
    log: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    settings: Sequence[str] = (),
    **options: Any,
) -> Flown:
    """Connect, check, take off, track, land, log: `companion fly`.

    Args:
        endpoint: the autopilot's address, as pymavlink or MAVSDK spell it; or
        sitl: the bundled stub to start, `px4`, `px4-1.13` or `ardupilot`.
        controller: a law's name, or the .py file of one's own (docs/adding_a_law.md).
        level: `attitude`, `body_rate` or `actuator`.
        trajectory: as `--trajectory` has it (docs/trajectories.md).
        duration_s: of tracking, s.
        seed: draws the networks, and the stub's noise.
        log: MCAP file; by default a new one in `flights/`.
        overwrite: whether `log` may be replaced.
        settings: as `--set` has them, for example `["profile.mass_ratio=1.0"]`.
        options: any other option of `companion fly`, with underscores: `profile="px4_sih"`, `arm=True`, `fix=True`.

    Returns:
        How it ended. A flight that was ended early is a result, not an error.

    Raises:
        UserError: it could not begin, for a reason that can be mended.
        TypeError: an option that `companion fly` does not have.
    """
    if (endpoint is None) == (sitl is None):
        raise UserError("fly: give either endpoint='ADDRESS' or sitl='px4'")
    where = ["--sitl", sitl] if sitl is not None else ["--endpoint", str(endpoint)]
    given = {
        "controller": controller,
        "level": level,
        "trajectory": trajectory,
        "duration": duration_s,
        "seed": seed,
    }
    arguments = _arguments(fly_command, where, **given, overrides=list(settings), **options)
    path, claimed = fly_command.log_path_of(arguments, os.fspath(log) if log is not None else None)
    outcome, text, _ = fly_command.fly_once(arguments, controller, seed, path, overwrite or claimed)
    return Flown(Outcome(outcome), text, path)


def check(endpoint: str, *, level: str = "attitude", settings: Sequence[str] = (), **options: Any) -> Checked:
    """Look at everything a flight depends on, and change nothing: `companion check`.

    Args:
        endpoint: the autopilot's address.
        level: of the flight.
        settings: as `--set` has them.
        options: any other option of `companion check`, with underscores.

    Raises:
        UserError: nobody there, or wrong input.
    """
    arguments = _arguments(
        check_command, ["--endpoint", endpoint], level=level, overrides=list(settings), **options
    )
    return Checked(tuple(check_command.findings_of(arguments)[0]))


def compare(
    logs: Sequence[str | os.PathLike[str]], from_s: float | None = None, to_s: float | None = None
) -> Comparison:
    """Flights side by side, averaged by controller, with P_imp against TLMBC. Raises UserError as `read_log`."""
    return compare_logs(logs, from_s, to_s)


def analyze(
    log: str | os.PathLike[str] | FlightRecord, from_s: float | None = None, to_s: float | None = None
) -> FlightMetrics:
    """A flight's errors in the window `from_s` to `to_s`, s of tracking.

    Raises UserError for what is no log, or holds no tracking.
    """
    return flight_metrics(_record(log), from_s, to_s)[0]


def replay(log: str | os.PathLike[str] | FlightRecord, law: ControlLaw | None = None) -> Replay:
    """Repeat every control step of a log with `law` (default: the one that flew), and compare the bits.

    Raises UserError where the log does not hold what that takes.
    """
    return replay_record(_record(log), law)


def _record(log: str | os.PathLike[str] | FlightRecord) -> FlightRecord:
    return log if isinstance(log, FlightRecord) else read_log(log)


class _OnlyParser:
    """Stands in for argparse's subparsers: keeps the one parser that a command makes."""

    parser: argparse.ArgumentParser

    def add_parser(self, name: str, help: str = "", **options: Any) -> argparse.ArgumentParser:
        self.parser = argparse.ArgumentParser(f"companion {name}", **options)
        return self.parser


def _arguments(command: Any, words: list[str], **given: Any) -> argparse.Namespace:
    """The command's options: `words`, its defaults, and `given`. Raises TypeError for one it does not have."""
    only = _OnlyParser()
    command.add_parser(only)
    arguments = only.parser.parse_args(words)
    for name, value in given.items():
        if not hasattr(arguments, name):
            raise TypeError(f"{only.parser.prog} has no option {name!r}; it has {', '.join(vars(arguments))}")
        setattr(arguments, name, value)
    return arguments
