"""Figures that the ArduPilot session leaves on the wire, read alike off the capture and off a session with the stub.

The capture was flown at four times real time with an autopilot that took our setpoints in bursts, some 25 ms of its time
late. A step therefore begins where the autopilot's own attitude target begins to move (ATTITUDE_TARGET): its rate then
grows with ATC_ACCEL_R_MAX and its like, which gives the instant between two messages.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import wire_figures

CAPTURE = wire_figures.CAPTURES / "arducopter_sitl.tlog.gz"
FIGURES = Path(__file__).parent / "ardupilot_capture_figures.json"
ASKED_WINDOW_S = (60.0, 110.0)
STEPS = {
    # name in the scenario: (axis, kind, size, seconds watched)
    "roll +0.2": (0, "angle", 0.2, 0.75),
    "roll -0.2": (0, "angle", -0.2, 0.75),
    "pitch +0.2": (1, "angle", 0.2, 0.75),
    "pitch -0.2": (1, "angle", -0.2, 0.75),
    "yaw +0.8": (2, "angle", 0.8, 3.9),
    "yaw -0.8": (2, "angle", -0.8, 3.9),
    "roll rate 0.6": (0, "rate", 0.6, 0.4),
    "pitch rate 0.6": (1, "rate", 0.6, 0.4),
    "yaw rate 0.6": (2, "rate", 0.6, 0.6),
}
TARGET_ACCEL = (math.radians(1100.0), math.radians(1100.0), math.radians(270.0))
"""ATC_ACCEL_R_MAX, ..._P_MAX, ..._Y_MAX of the capture, rad/s²."""
MOVING_RAD_S = 0.02


def _phases(messages: list[tuple[float, bool, Any]]) -> dict[str, float]:
    found: dict[str, float] = {}
    for t, out, m in messages:
        if out and m.get_type() == "STATUSTEXT" and m.text.startswith("scenario: step "):
            found[m.text.removeprefix("scenario: step ")] = t
    return found


def _euler(q: Any) -> tuple[float, float, float]:
    w, x, y, z = q
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(min(max(2 * (w * y - z * x), -1), 1)),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def _reaches(times: np.ndarray, share: np.ndarray, level: float) -> float:
    above = np.flatnonzero(share >= level)
    if not above.size or above[0] == 0:
        return math.nan
    i = int(above[0])
    part = (level - share[i - 1]) / (share[i] - share[i - 1])
    return float(times[i - 1] + part * (times[i] - times[i - 1]))


def step_responses(messages: list[tuple[float, bool, Any]]) -> dict[str, list[float]]:
    """[seconds to 10 %, to 63 %, peak as a ratio] by step; ± steps averaged."""
    bodies = [m for _, out, m in messages if not out and m.get_type() == "ATTITUDE_QUATERNION"]
    targets = [m for _, out, m in messages if not out and m.get_type() == "ATTITUDE_TARGET"]
    time = np.array([m.time_boot_ms * 1e-3 for m in bodies])
    angle = np.unwrap(np.array([_euler((m.q1, m.q2, m.q3, m.q4)) for m in bodies]), axis=0)
    rate = np.array([(m.rollspeed, m.pitchspeed, m.yawspeed) for m in bodies])
    target_time = np.array([m.time_boot_ms * 1e-3 for m in targets])
    target_rate = np.array([(m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate) for m in targets])
    single: dict[str, list[float]] = {}
    for name, phase_s in _phases(messages).items():
        if name not in STEPS:
            continue
        axis, kind, size, watched_s = STEPS[name]
        moving = (target_time > phase_s) & (target_rate[:, axis] * math.copysign(1, size) > MOVING_RAD_S)
        first = int(np.flatnonzero(moving)[0])
        start = float(target_time[first]) - abs(float(target_rate[first, axis])) / TARGET_ACCEL[axis]
        values = angle[:, axis] if kind == "angle" else rate[:, axis]
        before = float(np.interp(start, time, values))
        if axis < 2 and kind == "angle":
            size -= before  # roll and pitch steps are absolute angles
        chosen = (time >= start - 0.02) & (time <= start + watched_s)
        t, share = time[chosen] - start, (values[chosen] - before) / size
        single[name] = [_reaches(t, share, 0.1), _reaches(t, share, 0.63), float(share.max())]
    merged = {
        "roll": ("roll +0.2", "roll -0.2"),
        "pitch": ("pitch +0.2", "pitch -0.2"),
        "yaw": ("yaw +0.8", "yaw -0.8"),
        "roll rate": ("roll rate 0.6",),
        "pitch rate": ("pitch rate 0.6",),
        "yaw rate": ("yaw rate 0.6",),
    }
    return {
        key: [round(float(v), 4) for v in np.mean([single[part] for part in parts if part in single], axis=0)]
        for key, parts in merged.items()
        if any(part in single for part in parts)
    }


def _changes(values: list[tuple[float, tuple[Any, ...]]]) -> list[list[Any]]:
    kept: list[list[Any]] = []
    for t, value in values:
        if not kept or kept[-1][1:] != list(value):
            kept.append([round(t, 2), *value])
    return kept


def _of(messages: list[tuple[float, bool, Any]], name: str) -> list[tuple[float, Any]]:
    return [(t, m) for t, out, m in messages if not out and m.get_type() == name]


def figures(messages: list[tuple[float, bool, Any]]) -> dict[str, Any]:
    """Everything the conformance tests compare."""
    positions = _of(messages, "LOCAL_POSITION_NED")
    took_off = next(m.time_boot_ms for _, m in positions if m.z < -0.1 and m.vz < -0.3)
    first_target = next(t for t, out, m in messages if out and m.get_type() == "SET_ATTITUDE_TARGET")
    window = ASKED_WINDOW_S
    counts = Counter(m.get_type() for t, out, m in messages if not out and window[0] <= t < window[1])
    parameters = {m.param_id: m.param_type for _, m in _of(messages, "PARAM_VALUE")}
    thrusts = [m.thrust for t, m in _of(messages, "ATTITUDE_TARGET") if 56.0 < t < 57.5]
    silent = [m for t, m in positions if 154.0 < t < 155.0]
    return {
        "acks": [[round(t, 2), m.command, m.result] for t, m in _of(messages, "COMMAND_ACK")],
        "heartbeats": _changes(
            [(t, (m.base_mode, m.custom_mode, m.system_status)) for t, m in _of(messages, "HEARTBEAT")]
        ),
        "landed": _changes([(t, (m.landed_state,)) for t, m in _of(messages, "EXTENDED_SYS_STATE")]),
        "sensors": _changes(
            [
                (t, (m.onboard_control_sensors_enabled, m.onboard_control_sensors_health))
                for t, m in _of(messages, "SYS_STATUS")
            ]
        ),
        "texts": [[round(t, 2), m.severity, m.text] for t, m in _of(messages, "STATUSTEXT")],
        "first_position_s": round(positions[0][1].time_boot_ms * 1e-3, 2),
        "off_the_ground_after_target_s": round(took_off * 1e-3 - first_target, 2),
        "hover_thrust": round(float(np.mean(thrusts)), 4),
        "height_after_timeout_m": round(float(np.mean([m.z for m in silent])), 2),
        "rates_hz": {name: round(n / (window[1] - window[0]), 2) for name, n in sorted(counts.items())},
        "steps": step_responses(messages),
        "parameter_count": len(parameters),
        "parameter_types": sorted(Counter(parameters.values()).items()),
        "unknown_parameter_answered": "NO_SUCH_PARAM" in parameters,
        "flight_sw_version": next(m.flight_sw_version for _, m in _of(messages, "AUTOPILOT_VERSION")),
    }


def capture_figures() -> dict[str, Any]:
    """The figures kept in the project."""
    kept: dict[str, Any] = json.loads(FIGURES.read_text())
    return kept


def read_capture() -> list[tuple[float, bool, Any]]:
    """The capture as (autopilot's time, outgoing, message)."""
    return list(wire_figures.with_times(wire_figures.read_capture(CAPTURE)))


if __name__ == "__main__":
    found = figures(read_capture())
    found["source"] = "captures/arducopter_sitl.tlog.gz (ArduCopter 4.7.0-dev), read by ardupilot_figures.py"
    FIGURES.write_text(json.dumps(found, indent=None, separators=(",", ":")).replace('],"', '],\n"') + "\n")
