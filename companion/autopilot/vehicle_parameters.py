"""What the autopilot's parameters tell of the vehicle: hover thrust, rotors, limits, and how it follows setpoints.

A cascade tuned with sense keeps its proportions, so a loop that is twice as slow has its gain halved: responses
identified on PX4's and ArduCopter's own simulations (docs/autopilots.md) are scaled with the gains that set them there.
How the loop really follows no parameter tells: gains keep `LAG_MARGIN`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from companion.config.provenance import Known
from companion.config.resolve import ring

LAG_MARGIN = 1.2
"""By how much a lag read off parameters may be too short: owners tune with a spread of this size."""
TILT_MAX_DEG = 35.0
RATE_MAX_DEG_S = (220.0, 220.0, 120.0)
"""Asked for at most, whatever more the autopilot allows: `Limits`' defaults."""

PX4_PARAMETERS = (
    "MPC_THR_HOVER", "THR_MDL_FAC", "MPC_TILTMAX_AIR", "MC_ROLL_P", "MC_PITCH_P", "MC_YAW_P",
    "MC_ROLLRATE_MAX", "MC_PITCHRATE_MAX", "MC_YAWRATE_MAX", "CA_ROTOR_COUNT",
)  # fmt: skip
_ACCELERATION = (("ATC_ACC_R_MAX", "ATC_ACCEL_R_MAX"), ("ATC_ACC_P_MAX", "ATC_ACCEL_P_MAX"))
"""Roll, pitch; the first name from 4.7 in °/s², the second before in centidegrees/s². 0: no limit."""
ARDUPILOT_PARAMETERS = (
    "MOT_THST_HOVER", "MOT_THST_EXPO", "FRAME_CLASS", "ATC_ANG_RLL_P", "ATC_ANG_PIT_P", "ATC_ANG_YAW_P", "ATC_INPUT_TC",
    "ATC_RATE_FF_ENAB", "ATC_RATE_R_MAX", "ATC_RATE_P_MAX", "ATC_RATE_Y_MAX",
    *(name for pair in _ACCELERATION for name in pair),
)  # fmt: skip

PX4_STOCK = {"MC_ROLL_P": 6.5, "MC_PITCH_P": 6.5, "MC_YAW_P": 2.8}
ARDUPILOT_STOCK = {"ATC_ANG_RLL_P": 4.5, "ATC_ANG_PIT_P": 4.5, "ATC_ANG_YAW_P": 4.5, "ATC_INPUT_TC": 0.15}
_ROTORS_OF_FRAME = {1: 4, 2: 6, 3: 8, 4: 8, 5: 6}
"""FRAME_CLASS: quad, hexa, octa, octaquad, Y6."""
_ROTORS_OF_TYPE = {2: 4, 13: 6, 14: 8}
"""MAV_TYPE of HEARTBEAT."""


def from_px4(parameters: Mapping[str, float], vehicle_type: int) -> list[Known]:
    """What PX4's parameters tell. Of those that do not exist on the vehicle PX4's stock value is taken, and said."""
    roll_p, from_roll = _slowest(parameters, ("MC_ROLL_P", "MC_PITCH_P"), PX4_STOCK)
    yaw_p, from_yaw = _slowest(parameters, ("MC_YAW_P",), PX4_STOCK)
    slower, yaw_slower = _bounded(6.5 / roll_p, 0.5, 6.0), _bounded(2.8 / yaw_p, 0.5, 6.0)
    known = [
        *_hover("MPC_THR_HOVER", parameters),
        *_rotors(parameters.get("CA_ROTOR_COUNT"), "CA_ROTOR_COUNT", {4: 4, 6: 6, 8: 8}, vehicle_type),
        *_tilt(parameters.get("MPC_TILTMAX_AIR"), "MPC_TILTMAX_AIR"),
        *_rates(parameters, ("MC_ROLLRATE_MAX", "MC_PITCHRATE_MAX", "MC_YAWRATE_MAX")),
    ]
    response = "responses.px4."
    sure = "within 20 %, until it is measured"
    # MC_ROLL_P 6.5 was seen with 0.07 s of dead time and ω 12. Beyond that a ramp lags by two thirds of what 1/MC_ROLL_P is
    # more, since the rate loop below has an integral; dead time is link, loop and motors, of which the last only grow
    dead_s = 0.06 + 0.01 * slower
    lag_s = 0.07 + 2.0 / 12.0 + 0.66 * (1.0 / roll_p - 1.0 / 6.5) - dead_s
    known += [
        Known(response + "dead_time_s", round(dead_s, 4), from_roll, sure),
        Known(response + "tilt.natural_frequency_rad_s", round(2.0 / lag_s, 3), from_roll, sure),
        Known(response + "tilt.damping", 1.0, from_roll, sure),
        Known(response + "rate_dead_time_s", round(0.02 + 0.03 * slower, 4), from_roll, sure),
        Known(response + "yaw.natural_frequency_rad_s", round(4.6 / yaw_slower, 3), from_yaw, sure),
        Known(response + "yaw.damping", 0.6, from_yaw, sure),
        Known(
            response + "rate_lag_s",
            [*[round(0.034 * slower, 4)] * 2, round(0.2 * yaw_slower, 4)],
            from_roll,
            sure,
        ),
    ]
    return [*known, *_common(from_roll, slower)]


def from_ardupilot(parameters: Mapping[str, float], vehicle_type: int, tilt_limit_deg: float) -> list[Known]:
    """What ArduCopter's parameters tell; the shaping of ATC_INPUT_TC sets the response where rates are fed forward."""
    tilt_p, from_tilt = _slowest(parameters, ("ATC_ANG_RLL_P", "ATC_ANG_PIT_P"), ARDUPILOT_STOCK)
    yaw_p, from_yaw = _slowest(parameters, ("ATC_ANG_YAW_P",), ARDUPILOT_STOCK)
    shaping_s, from_shaping = _slowest(parameters, ("ATC_INPUT_TC",), ARDUPILOT_STOCK)
    # the rate loop below follows the shaped rate: stock gains were seen with 0.016 s of dead time and 0.014 s of lag
    slower, yaw_slower = _bounded(4.5 / tilt_p, 0.25, 6.0), _bounded(4.5 / yaw_p, 0.25, 6.0)
    lag_s = 0.16 * max(0.05, shaping_s) / 0.15
    if parameters.get("ATC_RATE_FF_ENAB") == 0.0:
        lag_s += 1.0 / tilt_p
        from_shaping += ", ATC_RATE_FF_ENAB 0"
    acceleration, from_acceleration = _tilt_acceleration(parameters)
    # with the acceleration allowed a tilt of 10° takes 2 √(tilt / acceleration), and lags by half of it
    if acceleration > 0.0 and (ramp_s := 2.0 * math.sqrt(10.0 / acceleration)) > 2.0 * lag_s:
        lag_s, from_shaping = 0.5 * ramp_s, f"{from_shaping}, {from_acceleration}"
    known = [
        *_hover("MOT_THST_HOVER", parameters),
        *_rotors(parameters.get("FRAME_CLASS"), "FRAME_CLASS", _ROTORS_OF_FRAME, vehicle_type),
        *_tilt(tilt_limit_deg if math.isfinite(tilt_limit_deg) else None, "ATC_ANGLE_MAX (ANGLE_MAX)"),
        *_rates(parameters, ("ATC_RATE_R_MAX", "ATC_RATE_P_MAX", "ATC_RATE_Y_MAX")),
    ]
    response = "responses.ardupilot."
    sure = "within 20 %, until it is measured"
    known += [
        Known(response + "dead_time_s", round(max(0.0, 0.03 * (slower - 1.0)), 4), from_tilt, sure),
        Known(response + "tilt.natural_frequency_rad_s", round(2.0 * 0.97 / lag_s, 3), from_shaping, sure),
        Known(response + "tilt.damping", 0.97, from_shaping, sure),
        Known(response + "rate_dead_time_s", round(0.016 * slower, 4), from_tilt, sure),
        Known(response + "yaw.natural_frequency_rad_s", round(3.5 / max(1.0, yaw_slower), 3), from_yaw, sure),
        Known(response + "yaw.damping", 0.7, from_yaw, sure),
        Known(
            response + "rate_lag_s",
            [*[round(0.014 * slower, 4)] * 2, round(0.15 * yaw_slower, 4)],
            from_tilt,
            sure,
        ),
    ]
    return [*known, *_common(from_tilt, slower)]


def summary(known: Iterable[Known]) -> str:
    """What was read, in one line for the pilot."""
    by_key = {item.key: item for item in known}

    def text(key: str, form: str) -> str:
        item = by_key.get(key)
        return form.format(item.value, item.source) if item is not None else ""

    rotors = by_key.get("rotors.layout")
    parts = [
        text("hover_thrust", "hovers at {0:.3g} ({1})"),
        f"{len(rotors.value)} rotors ({rotors.source})" if rotors is not None else "",
        text("limits.tilt_max_deg", "tilt up to {0:.3g}° ({1})"),
    ]
    for item in by_key.values():
        if item.key.endswith("tilt.natural_frequency_rad_s"):
            stem = item.key.rsplit(".", 2)[0]
            dead_s, damping = by_key[stem + ".dead_time_s"].value, by_key[stem + ".tilt.damping"].value
            total_s = dead_s + 2.0 * damping / item.value
            parts.append(
                f"attitude answers within {total_s:.2f} s, {dead_s:.2f} of it dead time ({item.source})"
            )
    defaults = sorted({item.source for item in by_key.values() if "not on this vehicle" in item.source})
    return "; ".join([*(part for part in parts if part), *defaults])


def _hover(name: str, parameters: Mapping[str, float]) -> list[Known]:
    value = parameters.get(name)
    if value is None or not 0.05 <= value <= 0.7:
        return []  # a value out of this range is judged by the preflight check
    return [Known("hover_thrust", round(value, 4), f"{name} {value:.3g}", "estimated on from lift-off")]


def _rotors(value: float | None, name: str, rotors_of: Mapping[int, int], vehicle_type: int) -> list[Known]:
    count = rotors_of.get(int(value)) if value is not None else None
    source = f"{name} {value:.0f}" if value is not None else ""
    if count is None:
        count, source = _ROTORS_OF_TYPE.get(vehicle_type), f"HEARTBEAT type {vehicle_type}"
    if count is None:
        return []
    return [Known("rotors.layout", ring(count), source, "their number only")]


def _tilt(limit_deg: float | None, name: str) -> list[Known]:
    if limit_deg is None or not 1.0 <= limit_deg < TILT_MAX_DEG:
        return [Known("limits.tilt_max_deg", TILT_MAX_DEG, "default", "")]
    return [Known("limits.tilt_max_deg", round(limit_deg, 2), f"{name} {limit_deg:g}", "")]


def _rates(parameters: Mapping[str, float], names: tuple[str, str, str]) -> list[Known]:
    limits, sources = [], []
    for name, default in zip(names, RATE_MAX_DEG_S, strict=True):
        value = parameters.get(name, 0.0)  # 0: no limit
        limits.append(min(default, round(value, 1)) if value > 0.0 else default)
        sources.append(f"{name} {value:g}" if 0.0 < value < default else "default")
    return [Known("limits.body_rate_max_deg_s", limits, ", ".join(dict.fromkeys(sources)))]


def _common(source: str, slower: float) -> list[Known]:
    # the rotors' lag is a good part of what an attitude loop has to live with, and not told by anything else
    lag = Known("rotors.lag_rad_s", round(_bounded(20.0 / slower, 10.0, 25.0), 2), source, "a guess")
    margin = Known("lag_margin", LAG_MARGIN, "default", "until the response is measured")
    return [lag, margin]


def _tilt_acceleration(parameters: Mapping[str, float]) -> tuple[float, str]:
    """The lower of the accelerations allowed about roll and pitch, °/s²; 0: no limit; and what said so."""
    found = []
    for newest, older in _ACCELERATION:
        if parameters.get(newest, 0.0) > 0.0:
            found.append((parameters[newest], newest))
        elif newest not in parameters and parameters.get(older, 0.0) > 0.0:
            found.append((parameters[older] / 100.0, older))
    value, name = min(found, default=(0.0, ""))
    return value, f"{name} {value:g}°/s²"


def _slowest(
    parameters: Mapping[str, float], names: tuple[str, ...], stock: Mapping[str, float]
) -> tuple[float, str]:
    """The lowest of parameters that are gains, and where it came from."""
    found = [(parameters[name], name) for name in names if parameters.get(name, 0.0) > 0.0]
    if not found:
        return stock[names[0]], f"stock {names[0]} {stock[names[0]]:g}, not on this vehicle"
    value, name = min(found)
    return value, f"{name} {value:.3g}"


def _bounded(value: float, least: float, most: float) -> float:
    return min(most, max(least, value))
