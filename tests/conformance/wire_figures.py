"""Figures that one session leaves on the wire: acknowledgements, transitions, stream rates, answers to unknown things.

The same reading is done on a capture of the real autopilot and on a session with the stub. Times are the autopilot's.
"""

from __future__ import annotations

import gzip
import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import step_response

os.environ.setdefault("MAVLINK20", "1")
from pymavlink.dialects.v20 import all as mavlink

CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "captures"
FIGURES = Path(__file__).parent / "px4_capture_figures.json"
COMPANION_COMPONENT = 191
DEFAULT_WINDOW_S = (2.6, 4.1)  # before the first SET_MESSAGE_INTERVAL, everything running
ASKED_WINDOW_S = (30.0, 55.0)


def read_capture(path: Path) -> Iterator[tuple[bool, Any]]:
    """(outgoing, message) of a gzipped telemetry log: 8 bytes of microseconds, then the frame."""
    decoder = mavlink.MAVLink(None)
    decoder.robust_parsing = True
    data = gzip.decompress(path.read_bytes())
    at = 0
    while at + 10 < len(data):
        start = at + 8
        signed = 13 if data[start + 2] & 1 else 0
        end = start + 12 + data[start + 1] + signed
        message = decoder.decode(bytearray(data[start:end]))
        at = end
        yield message.get_srcComponent() == COMPANION_COMPONENT, message


def with_times(pairs: Iterable[tuple[bool, Any]]) -> Iterator[tuple[float, bool, Any]]:
    """Add the autopilot's time of the last ATTITUDE to each message."""
    now = 0.0
    for outgoing, message in pairs:
        if message.get_type() == "ATTITUDE":
            now = message.time_boot_ms * 1e-3
        yield now, outgoing, message


def _rates(messages: list[tuple[float, bool, Any]], window: tuple[float, float]) -> dict[str, float]:
    counts = Counter(m.get_type() for t, out, m in messages if not out and window[0] <= t < window[1])
    return {name: round(n / (window[1] - window[0]), 2) for name, n in sorted(counts.items())}


def figures(messages: list[tuple[float, bool, Any]]) -> dict[str, Any]:
    """Everything the conformance tests compare."""
    incoming = [(t, m) for t, out, m in messages if not out]
    acks = [[round(t, 2), m.command, m.result] for t, m in incoming if m.get_type() == "COMMAND_ACK"]
    modes: list[list[float]] = []
    for t, m in incoming:
        if m.get_type() == "HEARTBEAT":
            state = [m.base_mode, m.custom_mode, m.system_status]
            if not modes or modes[-1][1:] != state:
                modes.append([round(t, 2), *state])
    landed: list[list[float]] = []
    for t, m in incoming:
        if m.get_type() == "EXTENDED_SYS_STATE" and (not landed or landed[-1][1] != m.landed_state):
            landed.append([round(t, 2), m.landed_state])
    exchange = step_response.read_exchange(m for _, _, m in messages)
    steps = {name: [r.t10_s, r.t63_s, r.peak] for name, r in step_response.measure_all(exchange).items()}
    parameters = {m.param_id: m.param_type for _, m in incoming if m.get_type() == "PARAM_VALUE"}
    versions = [m.flight_sw_version for _, m in incoming if m.get_type() == "AUTOPILOT_VERSION"]
    return {
        "acks": acks,
        "heartbeats": modes,
        "landed": landed,
        "default_rates_hz": _rates(messages, DEFAULT_WINDOW_S),
        "asked_rates_hz": _rates(messages, ASKED_WINDOW_S),
        "steps": {name: [None if v != v else round(v, 4) for v in values] for name, values in steps.items()},
        "parameter_count": len(parameters),
        "unknown_parameter_answered": "NO_SUCH_PARAM" in parameters,
        "flight_sw_version": versions[0] if versions else None,
    }


def capture_figures() -> dict[str, Any]:
    """The figures kept in the project."""
    kept: dict[str, Any] = json.loads(FIGURES.read_text())
    return kept


if __name__ == "__main__":
    found = figures(list(with_times(read_capture(CAPTURES / "px4_sih_qball2.tlog.gz"))))
    found["source"] = "captures/px4_sih_qball2.tlog.gz (PX4 v1.17.0, SIH), read by wire_figures.py"
    FIGURES.write_text(json.dumps(found, indent=1) + "\n")
