"""Reading TOML into settings: every error at once, each with file, key, what is wrong and what is allowed.

Overrides are dotted keys, `limits.tilt_max_deg=30`; a key that does not exist is answered with the nearest that does.
"""

from __future__ import annotations

import difflib
import re
import tomllib
import typing
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from companion.config.errors import UserError
from companion.config.foreign_files import known_foreign

Model = TypeVar("Model", bound=BaseModel)


def shipped_profiles() -> tuple[str, ...]:
    """Names of the profiles that come with the package."""
    folder = resources.files("companion.config") / "profiles"
    return tuple(sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")))


def read_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file. Raises UserError that names the file, and the line where there is one."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not UTF-8 text") from None
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path}: is not TOML: {error}") from None


def find_profile(name: str) -> Path:
    """Path of the profile `name`: a shipped one, or a file where it ends in .toml. Raises UserError."""
    if name.endswith(".toml"):
        return Path(name)
    if name in shipped_profiles():
        return Path(str(resources.files("companion.config") / "profiles" / f"{name}.toml"))
    if (foreign := known_foreign(Path(name))) is not None:
        raise UserError(
            f"{name} is no vehicle profile: {foreign}; a profile is a .toml file, see docs/real_px4.md"
        )
    raise UserError(
        f"there is no profile {name!r}{nearest(name, shipped_profiles())}; shipped are "
        f"{', '.join(shipped_profiles())}, or give the path of a .toml file"
    )


def nearest(word: str, known: Iterable[str]) -> str:
    """` (did you mean …?)`, or nothing when no known word is near."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f" (did you mean {close[0]!r}?)" if close else ""


def validated(
    model: type[Model], values: Mapping[str, Any], origin: str, overrides: Mapping[str, str] | None = None
) -> Model:
    """`values` as a `model`. Raises UserError with all that is wrong, a line each; `origin` names the file.

    `overrides` has the text of each `--set` by its key below the model: what is wrong there is its mistake.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as failure:
        errors = failure.errors(include_url=False)
        places = [error["loc"] for error in errors]
        # a list with a wrong entry is also reported as too short, counting the good ones: one mistake, one line
        lines = [
            _explain(model, error)
            for error in errors
            if error["type"] != "too_short"
            or not any(place[: len(error["loc"])] == error["loc"] != place for place in places)
        ]
        parts = [[str(part) for part in place] for place in places]
        set_wrong = [
            text
            for key, text in (overrides or {}).items()
            if any(_reaches(key.split("."), place) for place in parts)
        ]
        if overrides and any(
            not any(_reaches(key.split("."), place) for key in overrides) for place in parts
        ):  # a rule between several values, or the file's own mistake beside it
            origin = f"{origin} with {' and '.join(f'--set {text}' for text in overrides.values())}"
        elif set_wrong:
            origin = " and ".join(f"--set {text}" for text in set_wrong)
        if set_wrong:
            commas = any(re.search(r"=\s*-?\d+,\d+\s*$", text) for text in set_wrong)
            lines[-1] += "; write a decimal point, not a comma" if commas else ""
        if len(lines) == 1:
            raise UserError(f"{origin}: {lines[0]}") from None
        raise UserError(
            "\n".join([f"{origin}: {len(lines)} errors", *(f"  {line}" for line in lines)])
        ) from None


def _reaches(key: list[str], place: list[str]) -> bool:
    """Whether a mistake at `place` may come from setting `key`: one leads to the other."""
    shared = min(len(key), len(place))
    return shared > 0 and key[:shared] == place[:shared]


def _explain(model: type[BaseModel], error: Any) -> str:
    where = [str(part) for part in error["loc"]]
    key = ".".join(where) or "(the whole table)"
    if error["type"] == "extra_forbidden":
        holder = _model_at(model, where[:-1])
        known = list(holder.model_fields) if holder else []
        return f"{key}: unknown key{nearest(where[-1], known)}"
    if error["type"] == "missing":
        return f"{key}: missing"
    given = error.get("input")
    shown = f" (it is {given!r})" if isinstance(given, str | int | float | bool) else ""
    return f"{key}: {error['msg'].removeprefix('Value error, ')}{shown}"


def _inner(annotation: Any) -> list[Any]:
    """The models a field's type may hold, through unions, dicts and tuples."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in typing.get_args(annotation) for model in _inner(part)]


def _model_at(model: type[BaseModel], path: Iterable[str]) -> type[BaseModel] | None:
    """The model whose keys are written at the dotted `path`, None where there is no such table."""
    current: type[BaseModel] | None = model
    skip = False  # the key of a dict or the index of a list names no field
    for part in path:
        if skip:
            skip = False
            continue
        field = current.model_fields.get(part) if current else None
        if field is None:
            return None
        models = _inner(field.annotation)
        origin = typing.get_origin(field.annotation)
        skip = origin in (dict, tuple, list)
        current = models[0] if models else None
    return current


def parse_override(text: str) -> tuple[list[str], Any]:
    """`key=value` as dotted key and TOML value; a bare word is taken as text. Raises UserError."""
    key, sign, value = text.partition("=")
    if not sign or not key.strip():
        raise UserError(f"--set {text}: write key=value, for example --set profile.limits.tilt_max_deg=30")
    try:
        parsed = tomllib.loads(f"value = {value.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    return key.strip().split("."), parsed


def known_keys(model: type[BaseModel], values: Mapping[str, Any], prefix: str = "") -> list[str]:
    """All dotted keys that may be set: the model's, and those of the tables that `values` has."""
    keys = []
    for name, field in model.model_fields.items():
        inner = _inner(field.annotation)
        is_dict = typing.get_origin(field.annotation) is dict
        is_list = typing.get_origin(field.annotation) in (tuple, list)
        below = values.get(name) if isinstance(values.get(name), Mapping) else {}
        if inner and is_dict:
            for entry, table in (below or {}).items():
                keys += known_keys(inner[0], table, f"{prefix}{name}.{entry}.")
        elif inner and not is_list:
            keys += known_keys(inner[0], below or {}, f"{prefix}{name}.")
        else:
            keys.append(prefix + name)
    return keys


def apply_overrides(
    model: type[BaseModel], values: Mapping[str, Any], overrides: Iterable[tuple[list[str], Any]]
) -> dict[str, Any]:
    """A copy of `values` with the overrides set. Raises UserError for keys that do not exist, all at once."""
    merged = _deep_copy(values)
    known = known_keys(model, values)
    unknown = []
    for path, value in overrides:
        key = ".".join(path)
        if key not in known:
            unknown.append(f"--set {key}: there is no such setting{nearest(key, known)}")
            continue
        table = merged
        for part in path[:-1]:
            table = table.setdefault(part, {})
        table[path[-1]] = value
    if unknown:
        raise UserError("\n".join(unknown))
    return merged


def _deep_copy(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _deep_copy(inner) for key, inner in value.items()}
    return value
