"""The campaign itself, short: a flight of each firmware keeps everything, and a planted defect is caught."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from campaign.draw import planned

PROJECT = Path(__file__).parents[2]
pytestmark = [pytest.mark.flight, pytest.mark.timeout(600)]


def campaign(*words: str) -> tuple[int, str, str]:
    done = subprocess.run(
        [sys.executable, "-m", "campaign", *words],
        cwd=PROJECT,
        env={**os.environ, "PYTHONPATH": str(PROJECT / "tests")},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def test_a_flight_of_each_firmware_keeps_every_invariant(tmp_path: Path) -> None:
    words = ["--flights", "1", "--first-seed", "20", "--jobs", "1", "--out", str(tmp_path), "--json"]
    code, output, errors = campaign(*words)
    assert code == 0, errors
    told = json.loads(output)
    assert told["flights"] == 2 and told["broken"] == []
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 2
    assert [entry.name for entry in tmp_path.iterdir()] == ["results.jsonl"], "only what failed is kept"


def test_a_planted_defect_is_caught_and_the_flight_kept(tmp_path: Path) -> None:
    seed = next(seed for seed in range(1, 500) if planned("px4", seed).has("ctrl_c"))
    words = ["--firmware", "px4", "--seed", str(seed), "--plant", "always-exit-0", "--out", str(tmp_path)]
    code, output, errors = campaign(*words)
    assert code == 1, errors
    assert "BROKEN last word" in output
    assert (tmp_path / f"px4-{seed}" / "flight.mcap").exists()
