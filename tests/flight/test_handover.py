"""A part of the hand-over matrix, drawn so that every kind of end is among it: each cell keeps its bounds, by the truth."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
pytestmark = [pytest.mark.flight, pytest.mark.timeout(600)]


def matrix(*words: str) -> list[dict]:
    done = subprocess.run(
        [sys.executable, "-m", "handover", "--json", *words],
        cwd=PROJECT,
        env={**os.environ, "PYTHONPATH": str(PROJECT / "tests")},
        capture_output=True,
        text=True,
        check=False,
    )
    cells = [json.loads(line) for line in done.stdout.splitlines()]
    assert cells, done.stderr
    assert [cell for cell in cells if cell["broken"]] == [], done.stderr
    assert done.returncode == 0
    return cells


def test_ctrl_c_at_lift_off_comes_down_from_where_it_is() -> None:
    """It climbed to 9.95 m on a real ArduCopter: rising thrust stood for 2.5 s while DISARM was refused."""
    words = ["--phase", "lift-off", "--end", "ctrl-c", "--end", "ctrl-c twice", "--heading", "0"]
    for cell in matrix(*words, "--firmware", "ardupilot", "--level", "body_rate"):
        assert cell["rise_m"] < 0.2


def test_frames_that_are_lost_are_asked_for_again() -> None:
    words = [
        "--end",
        "mode frame lost three times",
        "--end",
        "hold frame lost three times",
        "--heading",
        "90",
    ]
    for cell in matrix(*words, "--phase", "track", "--level", "body_rate"):
        assert 0.25 < cell["taken_s"] < 0.6  # three tenths of a second were lost, and no more


def test_a_companion_that_starts_while_the_first_landing_comes_down_lets_it_come_down() -> None:
    """It was dropped from 0.67 m (PX4), and from 5.4 m (ArduPilot)."""
    for cell in matrix(
        "--end", "killed and started again", "--phase", "land", "--heading", "180", "--cells", "3"
    ):
        assert cell["sink_m_s"] < 1.2


def test_a_draw_of_the_rest_keeps_its_bounds() -> None:
    ends = [
        "sigterm",
        "supervisor lands",
        "law refuses",
        "exception in the law",
        "pilot by sticks",
        "link lost",
    ]
    matrix(*(word for end in ends for word in ("--end", end)), "--cells", "6", "--seed", "5")
