"""Where every number of a vehicle came from, for the log and for `companion check`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from companion.config.common_gains import laws_with_common_gains, total_lag_s
from companion.config.resolve import merged, nested
from companion.config.settings import Given, Settings

_ROOMS = (
    "mass_kg",
    "mass_ratio",
    "inertia_kg_m2",
    "hover_thrust",
    "estimator_delay_s",
    "lag_margin",
    "rotors",
    "limits",
    "responses",
)
"""What of a profile a person looks at, in this order."""


@dataclass(frozen=True, slots=True)
class Known:
    """One value of the vehicle, where it came from and how sure it is."""

    key: str  # dotted, in VehicleProfile
    value: Any
    source: str
    sure: str = ""


def tables_of(known: Iterable[Known]) -> dict[str, Any]:
    """Nested tables of a profile from dotted keys."""
    out: dict[str, Any] = {}
    for item in known:
        out = merged(out, nested(item.key.split("."), item.value))
    return out


def is_given(given: Given, key: str) -> str:
    """Who wrote the value at a dotted `key` of the profile: `--set`, the file's name, or nobody (empty)."""
    if any(".".join(path) == key for path, _ in given.profile_overrides):
        return "--set"
    here: Any = given.profile
    for part in key.split("."):
        here = here.get(part) if isinstance(here, Mapping) else None
    return given.origin.rpartition("/")[2] if here is not None else ""


def provenance(settings: Settings, told: Iterable[Known], autopilot: str | None) -> list[Known]:
    """Every number of the vehicle that flies, gains last; `told` is what the autopilot's parameters told."""
    told_by_key = {item.key: item for item in told}
    tables = settings.profile.model_dump(mode="json")
    tables["responses"] = {key: value for key, value in tables["responses"].items() if key == autopilot}
    rows = []
    for room in _ROOMS:
        for key, value in _leaves(room, tables[room]):
            by, told_so = is_given(settings.given, key) if settings.given else "", told_by_key.get(key)
            if by:
                rows.append(Known(key, value, by))
            elif told_so is not None:
                rows.append(Known(key, value, told_so.source, told_so.sure))
            else:
                rows.append(Known(key, value, "default", "or what follows from the rest"))
    return [*rows, *_gains(settings, autopilot)]


def _gains(settings: Settings, autopilot: str | None) -> list[Known]:
    flight, profile = settings.flight, settings.profile
    head = f"controllers.{flight.controller}.{flight.level}"
    lag_s = total_lag_s(profile, settings.level, autopilot)
    common = flight.controller in laws_with_common_gains()
    source = f"common gains for a lag of {lag_s:.3f} s" if common else "profile"
    given = settings.given
    if given is not None and (is_given(given, head) or given.gains_overrides):
        source += ", single values by profile or --set"
    out = []
    for name, table in settings.gains.model_dump(mode="json").items():
        text = (
            ", ".join(f"{k} {short(v)}" for k, v in table.items())
            if isinstance(table, dict)
            else short(table)
        )
        out.append(Known(f"gains.{name}", text, source))
    return out


def _leaves(key: str, value: Any) -> Iterable[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(f"{key}.{name}", inner)
    elif key == "rotors.layout":
        yield key, [f"{rotor['x_m']:.3g} {rotor['y_m']:.3g} {rotor['spin']}" for rotor in value]
    else:
        yield key, value


def short(value: Any) -> str:
    """A value with four digits."""
    if isinstance(value, list | tuple):
        return "[" + " ".join(short(one) for one in value) + "]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def as_text(row: Known) -> str:
    """Value, source and certainty in one line, as the log holds them."""
    sure = f"; {row.sure}" if row.sure else ""
    return f"{short(row.value)} ({row.source}{sure})"
