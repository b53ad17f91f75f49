"""From what the user wrote to a trajectory: `lemniscate,scale=0.5`, `hover`, `waypoints:tour.toml`.

A new trajectory is one new file and one line in `CATALOGUE`: anything callable that returns a
`Trajectory`. Its parameters are its options, read from its signature; a first parameter called `path`
makes it one that reads a file.
"""

from __future__ import annotations

import difflib
import inspect
import math
import re
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

from companion.config.errors import UserError
from companion.config.foreign_files import known_foreign
from companion.reference.circle import Circle
from companion.reference.csv_file import csv_trajectory
from companion.reference.hold import Hold
from companion.reference.lemniscate import Lemniscate
from companion.reference.minimum_snap import waypoint_trajectory
from companion.reference.mission_file import mission_trajectory
from companion.reference.step import Step
from companion.reference.steps import Steps
from companion.reference.trajectory import Trajectory

CATALOGUE: dict[str, Callable[..., Trajectory]] = {
    "lemniscate": Lemniscate,
    "hover": Hold,
    "circle": Circle,
    "step": Step,
    "steps": Steps,
    "waypoints": waypoint_trajectory,
    "csv": csv_trajectory,
    "mission": mission_trajectory,
}
_MISSION_ENDINGS = (".plan", ".waypoints", ".mission")
_BY_ENDING = {".toml": "waypoints", ".csv": "csv"} | dict.fromkeys(_MISSION_ENDINGS, "mission")
_UNITS = ("_m_s", "_m", "_s", "_rad")
LARGEST_OPTION = 1e6
SMALLEST_OPTION = 1e-6
_WORDS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


def trajectory_from_text(text: str) -> Trajectory:
    """Return the trajectory that `NAME[:FILE][,OPTION=VALUE...]` or the name of a file stands for.

    Options may be written without their unit (`height` for `height_m`), angles in degrees with `_deg`.
    Raises UserError, with suggestions, for names, options and values that are not known.
    """
    head, *pairs = re.split(r",(?=\s*\w+\s*=)", text.strip())
    name, colon, file = head.partition(":")
    name = name.strip()
    if name not in CATALOGUE:
        ending = Path(head).suffix.lower()
        if ending not in _BY_ENDING:
            if (foreign := known_foreign(Path(head))) is not None:
                raise UserError(
                    f"{head} is no trajectory: {foreign}; see docs/trajectories.md for what can be flown"
                )
            raise UserError(_unknown_name(text, name))
        name, colon, file = _BY_ENDING[ending], ":", head
    build = CATALOGUE[name]
    kinds = _options(build)
    reads_file = "path" in kinds
    kinds.pop("path", None)
    if reads_file and not file.strip():
        raise UserError(f"trajectory '{name}' reads a file: write {name}:FILE")
    if colon and not reads_file:
        raise UserError(f"trajectory '{name}' reads no file; options follow a comma: {name},option=value")
    given: dict[str, Any] = {}
    for pair in pairs:
        key, _, value = (part.strip() for part in pair.partition("="))
        option, factor = _option(name, key, kinds)
        if option in given:
            raise UserError(f"trajectory '{name}': option '{option}' is given twice")
        given[option] = _value(name, key, value, kinds[option] is bool, factor)
    return build(_path(file.strip()), **given) if reads_file else build(**given)


def _path(file: str) -> Path:
    try:
        return Path(file).expanduser()
    except (RuntimeError, ValueError) as error:  # ~NAME of nobody; a null byte
        raise UserError(f"{file!r} is no path of a file: {error}") from None


def describe_trajectories() -> str:
    """Return one line for each trajectory with its options and their defaults, for `--help`."""
    lines = []
    for name, build in CATALOGUE.items():
        parameters = dict(inspect.signature(build).parameters)
        shown = f"{name}:FILE" if parameters.pop("path", None) else name
        options = ", ".join(f"{key}={_shown(parameter.default)}" for key, parameter in parameters.items())
        lines.append(f"{shown}  {options}")
    return "\n".join(lines)


def _shown(default: object) -> str:
    if isinstance(default, bool):
        return str(default).lower()
    return "..." if default is None else f"{default:g}" if isinstance(default, float) else str(default)


def _options(build: Callable[..., Trajectory]) -> dict[str, Any]:
    """Name and type of each parameter of a catalogue entry."""
    target = build.__init__ if inspect.isclass(build) else build
    hints = typing.get_type_hints(target)
    return {name: hints[name] for name in inspect.signature(build).parameters}


def _unknown_name(text: str, name: str) -> str:
    near = difflib.get_close_matches(name, CATALOGUE, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return (
        f"no trajectory is called '{name or text}'; {hint}Known are {', '.join(CATALOGUE)}, "
        "and files ending in .toml (waypoints), .csv (samples), .plan or .waypoints (missions)"
    )


def _option(name: str, key: str, kinds: dict[str, Any]) -> tuple[str, float]:
    """Return the parameter that `key` means and the factor its value is multiplied with."""
    if key in kinds:
        return key, 1.0
    if key.endswith("_deg") and f"{key[:-4]}_rad" in kinds:
        return f"{key[:-4]}_rad", math.pi / 180.0
    for unit in _UNITS:
        if f"{key}{unit}" in kinds:
            return f"{key}{unit}", 1.0
    near = difflib.get_close_matches(key, kinds, n=1, cutoff=0.5)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    raise UserError(f"trajectory '{name}' has no option '{key}'{hint} It has {', '.join(kinds) or 'none'}")


def _value(name: str, key: str, value: str, is_flag: bool, factor: float) -> float | bool:
    if is_flag:
        if value.lower() not in _WORDS:
            raise UserError(f"trajectory '{name}': {key} has to be true or false, not '{value}'")
        return _WORDS[value.lower()]
    try:
        number = float(value) * factor
    except ValueError:
        raise UserError(f"trajectory '{name}': {key} has to be a number, not '{value}'") from None
    if key.startswith("duration") and number == math.inf:
        return number
    # NaN fails this too; beyond it derivatives would overflow instead of being refused as infeasible.
    if not (number == 0.0 or SMALLEST_OPTION <= abs(number) <= LARGEST_OPTION):
        raise UserError(
            f"trajectory '{name}': {key}={value} is out of range ({SMALLEST_OPTION:g} to {LARGEST_OPTION:g})"
        )
    return number
