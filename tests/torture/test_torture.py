"""Short versions of scripts/log_torture and scripts/kill_either; the scripts do the whole."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "unit"))
import synthetic_flight
from kill_either import drawn, tried
from log_torture import cuts, read_only, slow_disk


def test_a_log_cut_at_every_byte_of_its_last_second_passes_through_every_command(tmp_path: Path) -> None:
    log = synthetic_flight.write(tmp_path / "flight.mcap", seconds=2.0)
    found = cuts(tmp_path, log, seed=1, at_most=4)
    assert found["kept"] and found["bytes_cut"] > 10_000, found


def test_a_disk_whose_fsync_takes_half_a_second_is_not_waited_for(tmp_path: Path) -> None:
    found = slow_disk(tmp_path, seconds=1.2)
    assert found["kept"], found


def test_a_locked_folder_is_named_at_the_start(tmp_path: Path) -> None:
    found = read_only(tmp_path)
    assert found["kept"], found


@pytest.mark.flight
@pytest.mark.parametrize(("victim", "seed"), [("companion", 10), ("stub", 1)])
def test_the_survivor_of_a_kill_ends_safely_and_in_words(tmp_path: Path, victim: str, seed: int) -> None:
    assert tried(drawn(victim, "lockstep", "px4", seed), tmp_path) == []
