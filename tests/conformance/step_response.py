"""Step responses read off a MAVLink exchange, by one rule for a capture of the real autopilot and for the stub.

The step begins at the autopilot's time of the last ATTITUDE the client had when it sent the step's first setpoint.
Angles come from ATTITUDE; body rates from the slope of its angles over a window of 60 ms, because the gyro of the capture
carries noise as large as a quarter of the step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

STEPS = {
    # name in the scenario: (axis, kind, size)
    "roll +0.2": (0, "angle", 0.2),
    "roll -0.2": (0, "angle", -0.2),
    "pitch +0.2": (1, "angle", 0.2),
    "pitch -0.2": (1, "angle", -0.2),
    "yaw +0.8": (2, "angle", 0.8),
    "yaw -0.8": (2, "angle", -0.8),
    "roll rate 0.6": (0, "rate", 0.6),
    "pitch rate 0.6": (1, "rate", 0.6),
    "yaw rate 0.6": (2, "rate", 0.6),
}
WATCHED_S = {"roll": 0.8, "pitch": 0.8, "yaw": 3.9}
RATE_WATCHED_S = 0.5  # the scenario reverses the rate after 0.4 s; the peak comes a little later
RATE_WINDOW_S = 0.06


@dataclass
class Exchange:
    """What is needed of a telemetry log: attitudes and the instants at which steps began."""

    times_s: list[float] = field(default_factory=list)
    angles: list[tuple[float, float, float]] = field(default_factory=list)
    starts_s: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Response:
    """One step: seconds to 10 % and 63 % of it, and the peak as a ratio."""

    t10_s: float
    t63_s: float
    peak: float


def read_exchange(messages: Iterable[object]) -> Exchange:
    """Collect an exchange from pymavlink messages in order of time."""
    exchange = Exchange()
    pending: str | None = None
    for message in messages:
        kind = message.get_type()  # type: ignore[attr-defined]
        if kind == "ATTITUDE":
            exchange.times_s.append(message.time_boot_ms * 1e-3)  # type: ignore[attr-defined]
            exchange.angles.append((message.roll, message.pitch, message.yaw))  # type: ignore[attr-defined]
        elif kind == "STATUSTEXT" and message.text.startswith("scenario: step "):  # type: ignore[attr-defined]
            name = message.text.removeprefix("scenario: step ")  # type: ignore[attr-defined]
            pending = name if name in STEPS else None
        elif kind == "SET_ATTITUDE_TARGET" and pending is not None:
            # the scenario announces a step and sends it with its next setpoint
            exchange.starts_s[pending] = exchange.times_s[-1]
            pending = None
    return exchange


def measure(exchange: Exchange, name: str) -> Response:
    """The response to one step of the scenario."""
    axis, what, size = STEPS[name]
    times = np.array(exchange.times_s)
    values = np.unwrap(np.array(exchange.angles)[:, axis])
    start = exchange.starts_s[name]
    if what == "rate":
        grid = np.arange(start - 0.1, start + 1.2, 0.004)
        half = RATE_WINDOW_S / 2
        values = (
            np.interp(grid + half, times, values) - np.interp(grid - half, times, values)
        ) / RATE_WINDOW_S
        times = grid
    before = float(np.interp(start, times, values)) if what == "angle" else 0.0
    if what == "angle":
        target = size if axis < 2 else (0.804 if size > 0 else 0.004)
        scale = target - before
    else:
        scale = size
    watched = RATE_WATCHED_S if what == "rate" else WATCHED_S[name.split()[0]]
    chosen = (times >= start) & (times <= start + watched)
    t, share = times[chosen] - start, (values[chosen] - before) / scale
    return Response(_reaches(t, share, 0.1), _reaches(t, share, 0.63), float(share.max()))


def _reaches(times: np.ndarray, share: np.ndarray, level: float) -> float:
    """First time at which `share` passes `level` for good enough, interpolated; NaN if never."""
    above = np.flatnonzero(share >= level)
    if not above.size:
        return math.nan
    i = int(above[0])
    if i == 0:
        return float(times[0])
    part = (level - share[i - 1]) / (share[i] - share[i - 1])
    return float(times[i - 1] + part * (times[i] - times[i - 1]))


def measure_all(exchange: Exchange) -> dict[str, Response]:
    """Every step of the scenario that is in the exchange; ± steps of roll, pitch and yaw averaged."""
    single = {name: measure(exchange, name) for name in exchange.starts_s}
    merged: dict[str, Response] = {}
    for key, parts in {
        "roll": ("roll +0.2", "roll -0.2"),
        "pitch": ("pitch +0.2", "pitch -0.2"),
        "yaw": ("yaw +0.8", "yaw -0.8"),
        "roll rate": ("roll rate 0.6",),
        "pitch rate": ("pitch rate 0.6",),
        "yaw rate": ("yaw rate 0.6",),
    }.items():
        found = [single[name] for name in parts if name in single]
        if found:
            merged[key] = Response(
                *(float(np.mean([getattr(r, f) for r in found])) for f in ("t10_s", "t63_s", "peak"))
            )
    return merged
