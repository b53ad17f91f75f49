"""What a client writes as JSON, one object a datagram or a line: a point, a polynomial piece, or that it ends.

    {"time": 12.34, "position": [x, y, z], "velocity": [...], "acceleration": [...], "jerk": [...], "yaw": ψ, "yaw_rate": ψ̇}
    {"duration": T, "x": [c0, c1, ...], "y": [...], "z": [...], "yaw": [...]}
    {"duration": T, "coefficients": [[x...], [y...], [z...], [yaw...]]}
    {"end": true}      {"release": true}

docs/live_references.md has the meaning of every key; `SCHEMA` is the same for machines.
"""

from __future__ import annotations

import enum
import json
import math
from typing import Any

import numpy as np

from companion.live.point import DEGREE, LONGEST_S, BadPoint, Point, PolynomialPiece

LONGEST_BYTES = 4096
"""Of one object: a piece of degree 9 with every digit has half of it."""


class Wish(enum.Enum):
    """What a client may say beside points."""

    END = "end"
    """It is over: fly home and land."""
    RELEASE = "release"
    """Another client may have the vehicle now."""


Asked = Point | PolynomialPiece | Wish

_VECTORS = ("position", "velocity", "acceleration", "jerk")
_POINT_KEYS = {"time", "yaw", "yaw_rate", *_VECTORS}
_AXES = ("x", "y", "z", "yaw")
_PIECE_KEYS = {"time", "duration", "coefficients", *_AXES}

_VECTOR, _NUMBER, _SERIES = ({"$ref": f"#/$defs/{name}"} for name in ("vector", "number", "series"))
SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": "live reference",
    "$defs": {
        "number": {"type": ["number", "null"]},
        "vector": {"type": ["array", "null"], "items": _NUMBER, "minItems": 3, "maxItems": 3},
        "series": {"type": "array", "items": {"type": "number"}, "minItems": 1, "maxItems": DEGREE + 1},
    },
    "oneOf": [
        {
            "title": "point",
            "type": "object",
            "properties": {
                **dict.fromkeys(_VECTORS, _VECTOR),
                **dict.fromkeys(("time", "yaw", "yaw_rate"), _NUMBER),
            },
            "anyOf": [{"required": [name]} for name in _VECTORS[:3]],
            "additionalProperties": False,
        },
        {
            "title": "polynomial piece",
            "type": "object",
            "properties": {
                "time": _NUMBER,
                "duration": {"type": "number", "exclusiveMinimum": 0, "maximum": LONGEST_S},
                "coefficients": {"type": "array", "items": _SERIES, "minItems": 3, "maxItems": 4},
                **dict.fromkeys(_AXES, _SERIES),
            },
            "required": ["duration"],
            "oneOf": [{"required": ["coefficients"]}, {"required": ["x", "y", "z"]}],
            "additionalProperties": False,
        },
        {
            "title": "wish",
            "type": "object",
            "properties": {wish.value: {"const": True} for wish in Wish},
            "minProperties": 1,
            "maxProperties": 1,
            "additionalProperties": False,
        },
    ],
}
"""JSON Schema of what `parse` takes."""


def parse(data: bytes) -> Asked:
    """Read one object. Raises BadPoint, in words, for what is none of the three."""
    if len(data) > LONGEST_BYTES:
        raise BadPoint(f"too long: at most {LONGEST_BYTES} bytes")
    try:
        fields = json.loads(data, parse_constant=_no_number)
    except BadPoint:
        raise
    except (ValueError, RecursionError):
        raise BadPoint("not JSON") from None
    if not isinstance(fields, dict):
        raise BadPoint("not a JSON object")
    for wish in Wish:
        if fields == {wish.value: True}:
            return wish
    return _piece(fields) if "duration" in fields else _point(fields)


def _no_number(word: str) -> float:
    raise BadPoint(f"not a number: {word}; leave a component out, or write null, where it is not given")


def _point(fields: dict[str, Any]) -> Point:
    _require_known(fields, _POINT_KEYS)
    vectors = {}
    for name in _VECTORS:
        values = fields.get(name)
        if values is None:
            continue
        if not isinstance(values, list) or len(values) != 3:
            raise BadPoint(f"{name} is not three numbers")
        vectors[name] = np.array([_number(name, value) for value in values])
    return Point(
        time_s=_number("time", fields.get("time")),
        yaw_rad=_number("yaw", fields.get("yaw")),
        yaw_rate_rad_s=_number("yaw_rate", fields.get("yaw_rate")),
        **vectors,
    )


def _piece(fields: dict[str, Any]) -> PolynomialPiece:
    _require_known(fields, _PIECE_KEYS)
    rows = fields.get("coefficients")
    if rows is None:
        rows = [fields.get(name) for name in _AXES]
        if rows[3] is None:
            rows.pop()
    elif any(name in fields for name in _AXES):
        raise BadPoint("coefficients: given twice, as a matrix and by axis")
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise BadPoint("coefficients are not 3 or 4 rows: x, y, z and perhaps yaw")
    widths = [len(row) if isinstance(row, list) else 0 for row in rows]
    if not 1 <= min(widths) <= max(widths) <= DEGREE + 1:
        raise BadPoint(f"a piece has 1 to {DEGREE + 1} coefficients for each of x, y, z, yaw")
    table = np.zeros((4, max(widths)))
    for row, values in enumerate(rows):
        table[row, : len(values)] = [_number("coefficients", value) for value in values]
    if len(rows) == 3:
        table[3] = math.nan
    return PolynomialPiece(
        table, _number("duration", fields["duration"]), _number("time", fields.get("time"))
    )


def _require_known(fields: dict[str, Any], known: set[str]) -> None:
    for key in fields:
        if key not in known:
            raise BadPoint(f"unknown key: {key[:30]!r}")


def _number(name: str, value: object) -> float:
    """A float; NaN for null."""
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadPoint(f"{name} holds what is no number")
    try:
        return float(value)
    except OverflowError:
        return math.inf
