"""From the few lines that somebody wrote about a vehicle, and what its autopilot tells, to a complete profile.

Each value is the first of these that there is: `--set`, the profile's file, the autopilot's parameters, what follows
from the rest (hover thrust from rotors and mass, or the other way round; gains from mass and response), the default.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from companion.config.common_gains import common_gains, laws_with_common_gains
from companion.config.errors import UserError
from companion.config.load import apply_overrides
from companion.config.profile import LevelName, VehicleProfile

Override = tuple[list[str], Any]
"""Dotted key and value of a `--set`."""
LEVELS: tuple[LevelName, ...] = ("attitude", "body_rate", "actuator")
AUTOPILOTS = ("px4", "ardupilot")
HOVER_THRUST = 0.4
"""Of a vehicle of which nothing is known; flights find it out at lift-off."""
INERTIA_PER_KG_M2 = (0.01, 0.01, 0.018)
ARM_M = 0.2
TORQUE_PER_NEWTON_M = 0.02
ROTOR_LAG_RAD_S = 20.0
"""Not too slow: a lead against a lag that is not there amplifies noise, one that is too short only helps less."""
NEEDED_FOR_TORQUE = (
    "mass_kg",
    "inertia_kg_m2",
    "rotors.layout",
    "rotors.thrust_max_newton",
    "rotors.lag_rad_s",
)
"""What the actuator level flies by and no autopilot tells."""


def profile_values(
    given: Mapping[str, Any],
    overrides: Sequence[Override] = (),
    read: Mapping[str, Any] | None = None,
    autopilot: str | None = None,
) -> dict[str, Any]:
    """Complete tables of a `VehicleProfile`, to be validated.

    Args:
        given: a profile's file as parsed; may be empty.
        overrides: of `--set`, keys below the profile.
        read: tables of what the autopilot told, below the file's.
        autopilot: `px4` or `ardupilot` where it is known: gains are those for its response.

    Raises:
        UserError: overrides of keys that do not exist, all at once.
    """
    base = merged(read or {}, given)
    apply_overrides(VehicleProfile, _completed(base, autopilot), overrides)
    gains = [item for item in overrides if item[0][0] == "controllers"]
    for path, value in overrides:  # what follows from the rest follows from these, too
        if path[0] != "controllers":
            base = merged(base, nested(path, value))
    return apply_overrides(VehicleProfile, _completed(base, autopilot), gains)


def nested(path: Sequence[str], value: Any) -> dict[str, Any]:
    """`value` in the tables of a dotted key."""
    tables: Any = value
    for part in reversed(path):
        tables = {part: tables}
    return tables  # type: ignore[no-any-return]


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """`above` over `below`, table by table; where one of the two is no table, the upper one counts."""
    out = dict(below)
    for key, value in above.items():
        under = out.get(key)
        both = isinstance(value, Mapping) and isinstance(under, Mapping)
        out[key] = merged(under, value) if both else value  # type: ignore[arg-type]
    return out


def require_torque_numbers(given: Mapping[str, Any], overrides: Iterable[Override], origin: str) -> None:
    """Raise UserError where what the actuator level flies by was neither written nor set by anybody."""
    keys = {".".join(path) for path, _ in overrides}
    missing = [key for key in NEEDED_FOR_TORQUE if key not in keys and _at(given, key) is None]
    if missing:
        raise UserError(
            f"level actuator commands torques, and needs {', '.join(missing)}, which no autopilot tells ({origin}): "
            "write them into a profile and give it with --profile, or fly at --level attitude or body_rate"
        )


def _at(values: Mapping[str, Any], key: str) -> Any:
    here: Any = values
    for part in key.split("."):
        here = here.get(part) if isinstance(here, Mapping) else None
    return here


def _completed(values: Mapping[str, Any], autopilot: str | None) -> dict[str, Any]:
    """`values` with what follows from them: the vehicle's numbers, then every law's gains."""
    out = _with_vehicle(values)
    bare = {**out, "controllers": {"none": {}}}
    try:
        profile = VehicleProfile.model_validate(bare)
    except ValidationError:  # told in one with what is wrong with the gains, for which any vehicle will do
        profile = VehicleProfile.model_validate({**_with_vehicle({}), "controllers": {"none": {}}})
    common = {
        law: {level: common_gains(profile, law, level, autopilot) for level in LEVELS}
        for law in laws_with_common_gains()
    }
    out["controllers"] = merged(common, out.get("controllers") or {})
    return out


def _with_vehicle(values: Mapping[str, Any]) -> dict[str, Any]:
    """`values` with mass, inertia, rotors, hover thrust and responses; what cannot be reckoned with stays as it is."""
    out = merged({"rotors": {}, "responses": {}}, values)
    rotors, responses = out["rotors"], out["responses"]
    if isinstance(responses, Mapping):  # the file's own come first
        out["responses"] = {**responses, **{key: {} for key in AUTOPILOTS if key not in responses}}
    mass = out.setdefault("mass_kg", 1.0)
    known = isinstance(mass, int | float) and not isinstance(mass, bool) and mass > 0 and math.isfinite(mass)
    if not known:
        mass = 1.0
    out.setdefault("inertia_kg_m2", [one * mass for one in INERTIA_PER_KG_M2])
    if not isinstance(rotors, Mapping):
        return out
    rotors = out["rotors"] = dict(rotors)
    rotors.setdefault("layout", ring(4))
    rotors.setdefault("torque_per_newton_m", TORQUE_PER_NEWTON_M)
    rotors.setdefault("lag_rad_s", ROTOR_LAG_RAD_S)
    weight = mass * _number(out.get("gravity_m_s2"), 9.81)
    count = len(rotors["layout"]) if isinstance(rotors["layout"], list | tuple) else 4
    if "hover_thrust" not in out:
        full = _number(rotors.get("thrust_max_newton"), 0.0) * count
        out["hover_thrust"] = min(0.95, weight / full) if full > 0.0 else HOVER_THRUST
    hover = _number(out["hover_thrust"], HOVER_THRUST)
    rotors.setdefault("thrust_max_newton", weight / count / hover)
    return out


def ring(count: int) -> list[dict[str, Any]]:
    """A layout of `count` rotors about the centre, nose between two arms: all that a number of rotors tells."""
    angles = [(index + 0.5) * math.tau / count for index in range(count)]
    return [
        {
            "x_m": round(ARM_M * math.cos(angle), 6),
            "y_m": round(ARM_M * math.sin(angle), 6),
            "spin": "cw" if index % 2 else "ccw",
        }
        for index, angle in enumerate(angles)
    ]


def _number(value: Any, otherwise: float) -> float:
    usable = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if usable and value > 0 else otherwise
