"""Every fuzz target on its seeds, on inputs that once broke something, and on a few seeded mutations."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
from fuzz import TARGETS, mutated  # noqa: E402

MUTATIONS = {"stub-px4": 60, "stub-ardupilot": 60, "configuration": 40, "scenarios": 30}


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_found_inputs_and_mutations_pass(name: str) -> None:
    take, seeds = TARGETS[name].prepare()
    for found in sorted((HERE / "found" / name).glob("*")):
        take(found.read_bytes())
    rng = random.Random(f"suite {name}")
    for _ in range(MUTATIONS.get(name, 300)):
        take(mutated(rng, seeds))


def test_found_inputs_belong_to_targets() -> None:
    assert {folder.name for folder in (HERE / "found").iterdir()} <= set(TARGETS)
