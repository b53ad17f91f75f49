"""A short version of `scripts/hostile_frames.py`; the numbers of the long one are in docs/testing_with_the_stub.md."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.flight
PROJECT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("target", "over", "frames"),
    [
        ("px4", "memory", 20_000),
        ("ardupilot", "memory", 20_000),
        ("link", "memory", 20_000),
        ("px4", "tcp", 2_000),
    ],
)
def test_hostile_frames_change_nothing_and_kill_nobody(target: str, over: str, frames: int) -> None:
    words = ["--target", target, "--over", over, "--frames", str(frames), "--seed", "7", "--json"]
    done = subprocess.run(
        [sys.executable, str(PROJECT / "scripts" / "hostile_frames.py"), *words],
        env={**os.environ, "PYTHONPATH": str(PROJECT)},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["damaged"] == figures["forged"] == frames // 2
    if over == "memory":  # both halves did what they are for
        assert 0 < figures["messages taken of damaged"] < 0.2 * figures["damaged"]
        assert figures["messages taken of forged"] > 0.5 * figures["forged"]
