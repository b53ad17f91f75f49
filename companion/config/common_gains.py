"""A vehicle's gains from the common set (`gains.toml`): counted per kilogram, in the time of the response's own lag.

The linear part of a loop whose plant answers after a total lag T keeps its shape, margins included, when T changes by
1/s and its gains are scaled so: K_e, K_U times s; K_i, N times s²; times divided by s. α and the bounds are
accelerations and stay, so that the conditions of Propositions 1 and 2, α ≥ κ W_max²/4 + ε_max, hold for every vehicle
if they hold for one: κ is counted in 1/N.
"""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any

from companion.config.profile import LevelName, SecondOrder, VehicleProfile
from companion.control.structs import ControlLevel

_MASS = ("K_U", "K_i", "alpha", "N", "weight_bound", "integral_bound", "residual_bound")
"""Counted per kilogram, or per kg·m²."""
_POWER = {"K_e": 1, "K_U": 1, "K_i": 2, "N": 2, "boundary_width": -1}
"""Of s, of the gains that depend on the lag."""
ESTIMATE_S = 0.01
"""Age of the estimate that the common gains were found with: what is more counts as lag."""
_AT_QUARTER_TURN = 1.687
"""Lag times that frequency of the response that the attitude gains were found on: 0.07 s, 12 rad/s, ζ 1."""
LONGEST_LAG_S = 1.5
"""Slower than that no loop is made: below a natural frequency of 1 rad/s nothing would be tracked at all."""


@functools.cache
def _common() -> dict[str, Any]:
    text = (resources.files("companion.config") / "gains.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def laws_with_common_gains() -> tuple[str, ...]:
    """Names of the laws that fly any vehicle."""
    return tuple(name for name in _common() if name != "every")


def total_lag_s(profile: VehicleProfile, level: ControlLevel, autopilot: str | None) -> float:
    """What the position loop has to live with at `level`, s: dead time, lag, estimate's delay, times `lag_margin`."""
    response = profile.response(autopilot)
    lag_s = response.dead_time(level) + max(0.0, profile.estimator_delay_s - ESTIMATE_S)
    if level is ControlLevel.ATTITUDE:
        lag_s = max(lag_s + response.tilt.lag_s, _AT_QUARTER_TURN / _quarter_turn_rad_s(lag_s, response.tilt))
    elif level is ControlLevel.BODY_RATE:
        lag_s += max(response.rate_lag_s[:2])
    else:
        lag_s += 1.0 / profile.rotors.lag_rad_s
    return min(LONGEST_LAG_S, lag_s * profile.lag_margin)


def _quarter_turn_rad_s(dead_time_s: float, response: SecondOrder) -> float:
    """Frequency at which dead time and response together lag by 90°, rad/s.

    A response that overshoots lags little behind a ramp, and yet turns as far as a slow one where it counts, and amplifies.
    """
    low, high = 0.0, response.natural_frequency_rad_s
    for _ in range(40):
        middle = 0.5 * (low + high)
        ratio = middle / response.natural_frequency_rad_s
        lagging = dead_time_s * middle + math.atan2(2.0 * response.damping * ratio, 1.0 - ratio * ratio)
        low, high = (middle, high) if lagging < 0.5 * math.pi else (low, middle)
    return high


def common_gains(
    profile: VehicleProfile, controller: str, level: LevelName, autopilot: str | None
) -> dict[str, Any]:
    """The tables of `ControllerGains` for a law of `laws_with_common_gains` at `level` on this vehicle."""
    table = _common()[controller][level]
    s = min(table["most_s"], table["at_lag_s"] / total_lag_s(profile, ControlLevel(level), autopilot))
    least_z, most_z = table["vertical_s"]
    along = (s, s, min(most_z, max(least_z, s)))
    still = (1.0, 1.0, 1.0)
    mass, inertia = (profile.mass_kg,) * 3, profile.inertia_kg_m2
    attitude = {**_common()["every"]["attitude_loop"], **table.get("attitude_loop", {})}
    position_loop = _scaled(table["position_loop"], mass, along)
    # torque gains belong to the rotors, and have no slower loop of the autopilot's below them
    attitude_loop = _scaled(attitude, inertia, still)
    if level == "body_rate":
        attitude_loop["K_e"] = [_rounded(k * s) for k in attitude["K_e"]]
    gains: dict[str, Any] = {"position_loop": position_loop, "attitude_loop": attitude_loop}
    if "lead" in table:
        gains["lead"] = {name: _rounded(value / s) for name, value in table["lead"].items()}
    if "command_filter_rad_s" in table:
        gains["command_filter_rad_s"] = _rounded(table["command_filter_rad_s"] * s)
    return gains


def _scaled(
    table: Mapping[str, Any], per: tuple[float, ...], s: tuple[float, float, float]
) -> dict[str, Any]:
    """One loop's gains in N or N·m: `per` (3,) kg or kg·m², `s` (3,) by axis; scalars go with the first axis."""
    out: dict[str, Any] = {}
    for name, value in table.items():
        power = _POWER.get(name, 0)
        if name == "input_scales":
            out[name] = value
        elif isinstance(value, list):
            out[name] = [
                _rounded(one * (per[i] if name in _MASS else 1.0) * s[i] ** power)
                for i, one in enumerate(value)
            ]
        else:
            scale = per[0] if name in _MASS else 1.0 / per[0] if name == "kappa" else 1.0
            out[name] = _rounded(value * scale * s[0] ** power)
    return out


def _rounded(value: float) -> float:
    """Four digits: what a person reads in a log is what flies."""
    return float(f"{value:.4g}")
