"""What a client writes as JSON, and the schema that says the same for machines."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.live.json_points import LONGEST_BYTES, SCHEMA, Wish, parse
from companion.live.point import BadPoint, Point, PolynomialPiece


def test_the_schema_of_the_page_is_that_of_the_code_and_says_what_is_read() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "live_references.md").read_text()
    (block,) = re.findall(r"```json\n(.*?)```", page, re.S)
    assert json.loads(block) == SCHEMA
    for example in re.findall(r"^\{\"(?:time|duration|end)\".*\}$", page, re.M):
        parse(example.encode())
    point, piece, wish = SCHEMA["oneOf"]
    for key in point["properties"]:
        value = "0" if key.startswith(("time", "yaw")) else "[0, 0, 0]"
        parse(f'{{"{key}": {value}}}'.encode())
    assert set(piece["properties"]) == {"time", "duration", "coefficients", "x", "y", "z", "yaw"}
    assert set(wish["properties"]) == {each.value for each in Wish}


def test_a_point_has_what_was_given_and_nothing_else() -> None:
    point = parse(
        b'{"time": 12.5, "position": [1, -2, 3.5], "velocity": [0.1, null, 0], "yaw": 0.5, "yaw_rate": null}'
    )
    assert isinstance(point, Point)
    assert point.time_s == 12.5 and point.position.tolist() == [1.0, -2.0, 3.5] and point.yaw_rad == 0.5
    assert point.velocity[[0, 2]].tolist() == [0.1, 0.0] and math.isnan(point.velocity[1])
    assert (
        np.isnan(point.acceleration).all() and np.isnan(point.jerk).all() and math.isnan(point.yaw_rate_rad_s)
    )
    full = parse(b'{"position": [1, 2, 3], "acceleration": [4, 5, 6], "jerk": [7, 8, 9]}')
    assert isinstance(full, Point) and full.jerk.tolist() == [7, 8, 9] and math.isnan(full.time_s)


@pytest.mark.parametrize(
    "text",
    [
        '{"duration": 2, "x": [0, 1], "y": [0], "z": [1, 0, 0.5], "yaw": [0.1]}',
        '{"duration": 2, "coefficients": [[0, 1], [0], [1, 0, 0.5], [0.1]]}',
    ],
)
def test_a_piece_is_written_by_axis_or_as_rows(text: str) -> None:
    piece = parse(text.encode())
    assert isinstance(piece, PolynomialPiece) and piece.duration_s == 2.0 and math.isnan(piece.time_s)
    assert piece.coefficients.tolist() == [[0, 1, 0], [0, 0, 0], [1, 0, 0.5], [0.1, 0, 0]]


def test_a_piece_without_yaw_keeps_it() -> None:
    piece = parse(b'{"time": 3, "duration": 2, "x": [0], "y": [0], "z": [1]}')
    assert (
        isinstance(piece, PolynomialPiece) and piece.time_s == 3.0 and np.isnan(piece.coefficients[3]).all()
    )


def test_wishes() -> None:
    assert parse(b'{"end": true}') is Wish.END and parse(b'{"release": true}\n') is Wish.RELEASE


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        (b"[1, 2, 3]", "not a JSON object"),
        (b"[" * 4000, "not JSON"),
        (b" " * (LONGEST_BYTES + 1), "too long: at most 4096 bytes"),
        (b'{"position": [NaN, 0, 1]}', "not a number: NaN"),
        (b'{"position": [1, 2]}', "position is not three numbers"),
        (b'{"position": [1, 2, "3"]}', "position holds what is no number"),
        (b'{"position": [1, 2, true]}', "position holds what is no number"),
        (b'{"pos": [1, 2, 3]}', "unknown key: 'pos'"),
        (b'{"end": false}', "unknown key: 'end'"),
        (b'{"duration": 1, "coefficients": [[0]], "x": [0]}', "given twice"),
        (b'{"duration": 1, "coefficients": [[0], [0]]}', "not 3 or 4 rows"),
        (b'{"duration": 1, "x": [0], "y": [0]}', "has 1 to 10 coefficients"),
        (b'{"duration": 1, "x": [0,0,0,0,0,0,0,0,0,0,0], "y": [0], "z": [0]}', "has 1 to 10 coefficients"),
        (b'{"duration": "1", "x": [0], "y": [0], "z": [0]}', "duration holds what is no number"),
    ],
)
def test_what_cannot_be_read_is_refused_in_words(data: bytes, words: str) -> None:
    with pytest.raises(BadPoint, match=words):
        parse(data)


def test_numbers_beyond_floats_are_infinite_and_refused_by_the_point() -> None:
    for number in ("1e999", "9" * 400):
        point = parse(f'{{"position": [{number}, 0, 1]}}'.encode())
        with pytest.raises(BadPoint, match="position is infinite"):
            point.require_sane()  # type: ignore[union-attr]


@given(st.binary(max_size=200))
@settings(max_examples=200, deadline=None)
def test_no_bytes_do_anything_but_be_refused(data: bytes) -> None:
    with pytest.raises(BadPoint):
        parse(data)


values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(sorted(SCHEMA)), inner, max_size=3)
    ),
    max_leaves=8,
)
keys = st.sampled_from(
    ["time", "position", "velocity", "yaw", "duration", "coefficients", "x", "y", "z", "end", "other"]
)


@given(st.dictionaries(keys, values, max_size=5))
@settings(max_examples=300, deadline=None)
def test_any_object_is_read_or_refused(fields: dict[str, object]) -> None:
    try:
        asked = parse(json.dumps(fields).encode())
        if not isinstance(asked, Wish):
            asked.require_sane()
    except BadPoint as bad:
        assert str(bad)
