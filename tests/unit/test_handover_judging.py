"""The judge of the hand-over matrix: what it finds in motions made by hand, one fault each."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from campaign.flying import Flown
from campaign.tape import ARMED, BOX_WIDTH, MODE, POSITION, QUATERNION, TICK_WIDTH, TIME, VELOCITY
from handover.cells import ENDS, Cell, all_cells, shuffled
from handover.judging import Verdict, judge

OFFBOARD, LAND = 6 << 16, 4 << 16 | 6 << 24
STRUCK_S, TAKEN_S, DOWN_S = 10.0, 10.1, 13.0


def box() -> np.ndarray:
    """At 1 m; LAND at TAKEN_S, down at 0.5 m/s, disarmed at DOWN_S."""
    times = np.arange(0.0, 15.0, 0.02)
    rows = np.zeros((len(times), BOX_WIDTH))
    rows[:, TIME] = times
    rows[:, ARMED] = (times >= 2.0) & (times < DOWN_S)
    rows[:, MODE] = np.where(times < TAKEN_S, OFFBOARD, LAND)
    height = np.clip(np.minimum(times - 3.0, 1.0 - 0.5 * (times - TAKEN_S)), 0.0, 1.0)
    rows[:, POSITION] = np.column_stack((0 * times, 0 * times, -height))
    rows[:, VELOCITY] = np.column_stack((0 * times, 0 * times, -np.gradient(height, times)))
    rows[:, QUATERNION] = (1.0, 0.0, 0.0, 0.0)
    return rows


def verdict(
    rows: np.ndarray, words: str = "interrupted: by Ctrl-C or SIGTERM; landed and disarmed", code: int = 3
) -> Verdict:
    cell = Cell("px4", "attitude", "hold", "middle", "ctrl-c", 0.0)
    nothing = np.empty((0, TICK_WIDTH))
    flown = Flown(
        cell.planned, Path(), code, (words,), "", 0, "", 1.0, 1.0, rows, nothing, struck_at_s=STRUCK_S
    )
    return judge(cell, flown)


def test_a_good_landing_keeps_everything() -> None:
    good = verdict(box())
    assert good.broken == ()
    assert good.taken_s == pytest.approx(0.1, abs=0.021)
    assert good.sink_m_s == pytest.approx(0.5, abs=0.01)
    assert good.rise_m == pytest.approx(0.0, abs=0.01)


def spoiled(column: slice | int, while_s: tuple[float, float], value: object) -> np.ndarray:
    rows = box()
    inside = (rows[:, TIME] >= while_s[0]) & (rows[:, TIME] < while_s[1])
    rows[inside, column] = value
    return rows


@pytest.mark.parametrize(
    ("rows", "word"),
    [
        (spoiled(POSITION, (10.2, 10.4), (0.0, 0.0, -1.6)), "rose 0.60 m"),
        (spoiled(QUATERNION, (10.1, 10.2), (math.cos(0.35), math.sin(0.35), 0.0, 0.0)), "tilted 40°"),
        (spoiled(VELOCITY, (12.0, 12.1), (0.0, 0.0, 2.0)), "met the ground at 2.0 m/s"),
        (spoiled(ARMED, (2.0, 20.0), 1.0), "says landed and disarmed, and is not"),
        (spoiled(MODE, (0.0, 20.0), OFFBOARD), ""),
    ],
    ids=["rises", "tilts", "hits the ground", "stays armed", "disarmed in our mode"],
)
def test_each_bound_is_looked_at(rows: np.ndarray, word: str) -> None:
    broken = "; ".join(verdict(rows).broken)
    assert word in broken if word else broken == ""


def test_an_armed_vehicle_in_our_mode_has_nobody() -> None:
    rows = box()
    rows[:, MODE], rows[rows[:, TIME] > 2.0, ARMED] = OFFBOARD, 1.0
    assert "nobody has it" in "; ".join(verdict(rows, "interrupted: still armed").broken)


def test_words_and_exit_code_are_looked_at() -> None:
    assert "exit code 0" in "; ".join(verdict(box(), code=0).broken)
    assert "last word completed" in "; ".join(verdict(box(), "completed: flown as planned", 0).broken)


def test_every_end_is_flown_in_every_phase_it_can_come_in() -> None:
    cells = list(all_cells())
    assert len(set(cells)) == len(cells)
    assert {cell.end for cell in cells} == set(ENDS)
    assert all({c.phase for c in cells if c.end == end} == set(facts.phases) for end, facts in ENDS.items())
    assert shuffled(cells, 5, 1) == shuffled(cells, 5, 1) != shuffled(cells, 5, 2)
