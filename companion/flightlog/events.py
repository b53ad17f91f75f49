"""Events: what happens once, as text: phases, modes, warnings, messages of the autopilot, how it ended.

One JSON object each, under one JSON schema, on one channel, so that a log can be read with any JSON tool.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

TOPIC = "/events"
SCHEMA_NAME = "companion.Event"
WALL_CLOCK_PREFIX = "wall_"
"""Fields so named differ between two runs of one seed and are left out of the digest."""

KINDS: dict[str, str] = {
    "phase": "a flight phase began: phase",
    "mode": "the autopilot's flight mode changed: mode",
    "armed": "armed or disarmed: armed (bool)",
    "layout": "how the trajectory lies in local ENU: heading_rad (yaw of its x axis), origin_enu [m]",
    "tracking": "tracking began or stopped: active (bool)",
    "status_text": "STATUSTEXT of the autopilot: severity (0 worst .. 7), text",
    "ack": "COMMAND_ACK: command, result",
    "warning": "something to know: text",
    "safety": "the supervisor reacted: reaction, reason, and the numbers it acted on",
    "blind": "a message that something rests on is not heard, or leaves it open: active (bool), text",
    "estimator_reset": "the estimate jumped and the plan went along: jump_enu [m], yaw_jump_rad",
    "live": "references of another program: text; when tracking begins all that they are followed by",
    "rc": "the pilot's transmitter was lost, or is back: lost (bool), text",
    "log": "the log itself had trouble: text, and how many records it cost",
    "mistake": "an exception in this program, or in somebody's law, ended the flight: text (the traceback)",
    "ended": "how the flight ended: outcome, text",
}
"""Kinds the package writes and what fields they carry; others are welcome."""

SCHEMA: bytes = json.dumps(
    {
        "title": SCHEMA_NAME,
        "type": "object",
        "description": "; ".join(f"{kind}: {meaning}" for kind, meaning in KINDS.items()),
        "properties": {
            "time_s": {"type": "number", "description": "autopilot time since boot, s"},
            "kind": {"type": "string"},
            "phase": {"type": "string"},
            "mode": {"type": "string"},
            "text": {"type": "string"},
            "reason": {"type": "string"},
            "severity": {"type": "integer"},
        },
        "required": ["time_s", "kind"],
        "additionalProperties": True,
    },
    indent=1,
).encode()


def _plain(value: Any) -> Any:
    """Return `value` as JSON can hold it. Numbers that JSON has no word for become null; nothing raises."""
    if isinstance(value, (str, bool, int)) or value is None:
        return value
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(item) for item in value]
    if isinstance(value, bytes):
        return value.hex()
    return str(value)


def encode_event(kind: str, time_s: float, fields: dict[str, Any]) -> bytes:
    """Return one event as JSON bytes, keys sorted so that equal events are equal bytes."""
    body = {**_plain(fields), "time_s": time_s if math.isfinite(time_s) else None, "kind": kind}
    return json.dumps(body, sort_keys=True, ensure_ascii=False, allow_nan=False).encode("utf-8", "replace")
