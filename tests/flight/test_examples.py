"""The programs of examples/, each run as its first lines say."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import companion

EXAMPLES = Path(__file__).parents[2] / "examples"

pytestmark = pytest.mark.flight


def run(folder: Path, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, check=False, capture_output=True, text=True, timeout=250
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_every_example_is_run_here() -> None:
    programs = {path.name for path in EXAMPLES.glob("*.py")} - {"climb_and_land.py", "test_climb_and_land.py"}
    text = Path(__file__).read_text()
    assert {name for name in programs if name in text} == programs
    assert programs


def test_fly_and_plot_and_read_a_log(tmp_path: Path) -> None:
    said = run(tmp_path, str(EXAMPLES / "fly_and_plot.py"), "3", "path.png")
    assert "completed: flown as planned" in said
    assert (tmp_path / "path.png").stat().st_size > 5000
    (log,) = (tmp_path / "flights").glob("*.mcap")
    said = run(tmp_path, str(EXAMPLES / "read_a_log.py"), str(log))
    assert "phase: phase track" in said and "ended: outcome completed" in said
    steps = said.splitlines()[-1].split()
    assert steps[0] == steps[2] and int(steps[0]) > 1000


def test_a_trajectory_of_ones_own(tmp_path: Path) -> None:
    said = run(tmp_path, str(EXAMPLES / "my_trajectory.py"), "spiral.csv")
    # r = 0.8 m at t = 10 s, at an angle of 8 rad
    assert "20 s; halfway at [-0.12  0.79  1.  ] m" in said


def test_references_from_another_program(tmp_path: Path) -> None:
    """In real time, since the example paces itself by the wall clock: it is followed until it ends."""
    client = subprocess.Popen([sys.executable, str(EXAMPLES / "stream_references.py"), "14797", "24"])
    flight = "fly --sitl px4 --real-time --trajectory live:udp:14797 --duration 40 --log live.mcap --set"
    hold = "flight.procedure.hold_s=0.2"
    try:
        run(tmp_path, "-m", "companion.cli.main", *flight.split(), hold)
    finally:
        client.kill()
        client.wait()
    record = companion.read_log(tmp_path / "live.mcap")
    assert record.events_of("ended")[-1].fields["outcome"] == "completed"
    assert int(record.metadata["wall references"]["followed"]) > 100


def test_a_law_of_ones_own_flies_is_logged_and_replays(tmp_path: Path) -> None:
    """Its text is in the log, and runs from there only where that is asked for."""
    law, log = tmp_path / "my_law.py", tmp_path / "own.mcap"
    shutil.copy(EXAMPLES / "my_law.py", law)
    command = ["-m", "companion.cli.main"]
    run(
        tmp_path,
        *command,
        *f"fly --sitl px4 --controller {law} --trajectory hover --duration 2 --log {log}".split(),
    )
    assert companion.analyze(log).controller == "my_law"
    law.unlink()
    refused = subprocess.run(
        [sys.executable, *command, "replay", str(log)], check=False, capture_output=True, text=True
    )
    assert refused.returncode == 2 and "--run-law-in-log" in refused.stderr
    said = run(tmp_path, *command, "replay", str(log), "--run-law-in-log")
    assert "steps give the same bits" in said
