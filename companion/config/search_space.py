"""The gains as a flat vector of named, bounded numbers, for whoever searches them (`companion.tuning`).

Each parameter may stand for several entries (roll and pitch go together), and is counted per kg of mass or per kg·m² of
inertia where it grows with them, so that one table serves every vehicle and every comparison between controllers has
the same room to search.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from companion.config.gains import ControllerGains
from companion.config.profile import LevelName, VehicleProfile
from companion.control.structs import Vector

Per = Literal["one", "mass", "inertia"]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of a search."""

    key: str  # dotted path in ControllerGains
    axes: tuple[int, ...]  # entries that it sets; () for a plain number
    low: float
    high: float
    per: Per = "one"
    linear: bool = False  # searched on a linear scale; else on a logarithmic one

    @property
    def name(self) -> str:
        """As `--set` would write it, with the axes behind it."""
        return self.key + "".join(f"[{axis}]" for axis in self.axes)


POSITION = "position_loop."
ATTITUDE = "attitude_loop."
HORIZONTAL, VERTICAL, TILT, YAW = (0, 1), (2,), (0, 1), (2,)

LOOP_PARAMETERS = (
    Parameter(POSITION + "K_e", HORIZONTAL, 0.5, 6.0),
    Parameter(POSITION + "K_e", VERTICAL, 0.5, 6.0),
    Parameter(POSITION + "K_U", HORIZONTAL, 0.3, 8.0, "mass"),
    Parameter(POSITION + "K_U", VERTICAL, 1.0, 10.0, "mass"),
)
LOOP_INTEGRAL = (
    Parameter(POSITION + "K_i", HORIZONTAL, 0.05, 5.0, "mass"),
    Parameter(POSITION + "K_i", VERTICAL, 0.3, 15.0, "mass"),
)
LOOP_NETWORK = (
    Parameter(POSITION + "alpha", (), 0.05, 1.5, "mass"),
    Parameter(POSITION + "boundary_width", (), 0.15, 1.0),
    Parameter(POSITION + "N", (), 0.1, 10.0, "mass"),
    Parameter(POSITION + "kappa", (), 0.001, 1.0),
)
ATTITUDE_LEVEL = (Parameter("lead.feedback_s", (), 0.0, 0.35, linear=True),)
RATE_LEVEL = (
    Parameter(ATTITUDE + "K_e", TILT, 2.0, 15.0),
    Parameter(ATTITUDE + "K_e", YAW, 1.0, 8.0),
    Parameter("command_filter_rad_s", (), 4.0, 40.0),
)
ACTUATOR_LEVEL = (
    Parameter(ATTITUDE + "K_U", TILT, 2.0, 20.0, "inertia"),
    Parameter(ATTITUDE + "K_U", YAW, 1.0, 12.0, "inertia"),
    Parameter("lead.rotor_filter_s", (), 0.005, 0.06),
)
ACTUATOR_INTEGRAL = (
    Parameter(ATTITUDE + "K_i", TILT, 0.5, 60.0, "inertia"),
    Parameter(ATTITUDE + "K_i", YAW, 0.2, 20.0, "inertia"),
)
ACTUATOR_NETWORK = (
    Parameter(ATTITUDE + "alpha", (), 0.05, 5.0, "inertia"),
    Parameter(ATTITUDE + "boundary_width", (), 0.1, 3.0),
    Parameter(ATTITUDE + "N", (), 0.05, 20.0, "inertia"),
    Parameter(ATTITUDE + "kappa", (), 0.01, 3.0),
)


def search_space(level: LevelName, *, has_network: bool, has_integral: bool) -> tuple[Parameter, ...]:
    """The parameters that matter for a controller at an output level."""
    space = LOOP_PARAMETERS
    space += LOOP_INTEGRAL if has_integral else ()
    space += LOOP_NETWORK if has_network else ()
    space += ATTITUDE_LEVEL if level == "attitude" else RATE_LEVEL
    if level == "actuator":
        space += ACTUATOR_LEVEL
        space += ACTUATOR_INTEGRAL if has_integral else ()
        space += ACTUATOR_NETWORK if has_network else ()
    return space


def _unit(parameter: Parameter, profile: VehicleProfile) -> float:
    if parameter.per == "mass":
        return profile.mass_kg
    if parameter.per == "inertia":
        return profile.inertia_kg_m2[parameter.axes[0] if parameter.axes else 0]
    return 1.0


def to_vector(space: tuple[Parameter, ...], gains: ControllerGains, profile: VehicleProfile) -> Vector:
    """Where `gains` lie in the search space, each entry in [0, 1] between its bounds (clipped)."""
    tables = gains.model_dump()
    out = np.empty(len(space))
    for k, parameter in enumerate(space):
        value = _get(tables, parameter.key)
        value = (value[parameter.axes[0]] if parameter.axes else value) / _unit(parameter, profile)
        value = min(parameter.high, max(parameter.low, value))
        if parameter.linear:
            out[k] = (value - parameter.low) / (parameter.high - parameter.low)
        else:
            out[k] = math.log(value / parameter.low) / math.log(parameter.high / parameter.low)
    return out


def with_vector(
    space: tuple[Parameter, ...], gains: ControllerGains, profile: VehicleProfile, vector: Vector
) -> ControllerGains:
    """`gains` with the searched entries set from `vector` (n,) in [0, 1]; the rest stays."""
    tables = gains.model_dump()
    for parameter, share in zip(space, np.clip(vector, 0.0, 1.0), strict=True):
        if parameter.linear:
            value = parameter.low + float(share) * (parameter.high - parameter.low)
        else:
            value = parameter.low * (parameter.high / parameter.low) ** float(share)
        value = float(f"{value * _unit(parameter, profile):.4g}")
        *path, last = parameter.key.split(".")
        table = _get(tables, ".".join(path)) if path else tables
        if parameter.axes:
            entries = list(table[last])
            for axis in parameter.axes:
                # entries counted per inertia follow each axis' own
                scale = (
                    profile.inertia_kg_m2[axis] / _unit(parameter, profile)
                    if parameter.per == "inertia"
                    else 1.0
                )
                entries[axis] = float(f"{value * scale:.4g}")
            table[last] = tuple(entries)
        else:
            table[last] = value
    return ControllerGains.model_validate(tables)


def _get(tables: dict[str, Any], key: str) -> Any:
    for part in key.split("."):
        tables = tables[part]
    return tables
