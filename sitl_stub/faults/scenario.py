"""Scenario files: which faults happen when. TOML, checked whole, every error told at once.

seed = 1                      # of the faults' random numbers; left out: the stub's --seed
announce = true               # STATUSTEXT at begin and end of each

[[fault]]
kind = "link_delay"
after = "airborne"            # start (default), armed, airborne, offboard: at_s counts from when that first held
at_s = 12.0
for_s = 3.0                   # left out: it stays
delay_s = 0.2                 # parameters of the kind (sitl-stub --list-faults)
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sitl_stub.faults.fault import Fault, FaultError
from sitl_stub.faults.registry import KINDS

if TYPE_CHECKING:
    from sitl_stub.physics.vehicle import VehicleParameters

ANCHORS = ("start", "armed", "airborne", "offboard")
"""What `at_s` can count from: boot, and the first time armed, off the ground, in a mode that takes setpoints."""
LATEST_S = 86400.0
TIMING = ("kind", "after", "at_s", "for_s")
TOP_LEVEL = ("seed", "announce", "fault")
LARGEST_SEED = 2**63 - 1


@dataclass(frozen=True)
class Entry:
    """One fault and its time."""

    fault: Fault
    after: str = "start"
    at_s: float = 0.0
    """From the first time that `after` held."""
    for_s: float | None = None
    """None: momentary, or it stays."""


@dataclass(frozen=True)
class Scenario:
    """Everything of a scenario file."""

    entries: tuple[Entry, ...] = ()
    seed: int | None = None
    """None: the stub's own."""
    announce: bool = True


@dataclass(frozen=True)
class Target:
    """What the faults are for: not every firmware has every mode, not every vehicle a fifth rotor."""

    firmware: str
    vehicle: VehicleParameters


def read_scenario(path: str | Path, target: Target | None = None) -> Scenario:
    """The scenario of a TOML file. Raises FaultError with a line for everything that is wrong, or wrong for `target`."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise FaultError([f"{path}: cannot be read ({reason}): give a TOML file of faults"]) from None
    try:
        values = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise FaultError([f"{path}: not TOML: {error}; docs/faults.md has examples"]) from None
    return scenario_from(values, str(path), target)


def scenario_from(
    values: Mapping[str, Any], source: str = "scenario", target: Target | None = None
) -> Scenario:
    """The scenario of the values of a file. Raises FaultError with a line for everything that is wrong."""
    problems = [
        f"{source}: {key!r} is not known at the top; there are {', '.join(TOP_LEVEL)} (as [[fault]])"
        for key in values
        if key not in TOP_LEVEL
    ]
    seed = values.get("seed")
    if "seed" in values and (
        not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed <= LARGEST_SEED
    ):
        problems.append(f"{source}: seed is {seed!r}: give a whole number, not negative")
    announce = values.get("announce", True)
    if not isinstance(announce, bool):
        problems.append(f"{source}: announce is {announce!r}: give true or false")
    tables = values.get("fault", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        problems.append(f"{source}: fault must be an array of tables: begin each fault with [[fault]]")
        tables = []
    entries = []
    for number, table in enumerate(tables, 1):
        try:
            entries.append(entry_from(table, target))
        except FaultError as error:
            kind = table.get("kind")
            named = f" ({kind})" if isinstance(kind, str) and kind in KINDS else ""
            problems += [f"{source}: [[fault]] {number}{named}: {problem}" for problem in error.problems]
    if problems:
        raise FaultError(problems)
    return Scenario(tuple(entries), seed, announce)


def entry_from(table: Mapping[str, Any], target: Target | None = None) -> Entry:
    """One `[[fault]]`. Raises FaultError with everything that is wrong with it."""
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        return _refuse_kind(kind)
    cls = KINDS[kind]
    problems: list[str] = []
    after = table.get("after", "start")
    if after not in ANCHORS:
        problems.append(f"after is {after!r}: give one of {', '.join(ANCHORS)}")
    for name in ("at_s", "for_s"):
        if name in table and not _is_time(table[name]):
            problems.append(f"{name} is {table[name]!r}: give seconds from 0 to {LATEST_S:g}")
    if "for_s" in table and cls.momentary:
        problems.append(f"for_s is not for {kind}, which is momentary: leave it out")
    parameters = cls.parameters()
    values = {}
    for name, value in table.items():
        if name in TIMING:
            continue
        if name not in parameters:
            problems.append(f"{name!r} is no parameter of {kind}: {_what_there_is(name, list(parameters))}")
            continue
        problem = parameters[name].problem(value)
        if problem is not None:
            problems.append(f"{name} is {value!r}: {problem}")
        else:
            values[name] = parameters[name].converted(value)
    if problems:
        raise FaultError(problems)
    fault = cls(**values)
    refusal = None if target is None else fault.refusal(target.firmware, target.vehicle)
    if refusal is not None:
        raise FaultError([refusal])
    for_s = float(table["for_s"]) if "for_s" in table else None
    return Entry(fault, after, float(table.get("at_s", 0.0)), for_s)


def _is_time(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0.0 <= value <= LATEST_S


def _refuse_kind(kind: Any) -> Entry:
    if kind is None:
        raise FaultError(["kind is missing: name the fault (sitl-stub --list-faults shows all)"])
    close = difflib.get_close_matches(str(kind), KINDS, n=2, cutoff=0.4)
    meant = f"did you mean {' or '.join(close)}? " if close else ""
    raise FaultError([f"kind {kind!r} is not known: {meant}sitl-stub --list-faults shows all"])


def _what_there_is(name: str, known: Sequence[str]) -> str:
    if not known:
        return "it takes none"
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]}?" if close else f"it takes {', '.join(known)}"
