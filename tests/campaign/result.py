"""What is kept of a judged flight: small, as JSON, one line each."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from campaign.evidence import Evidence
from campaign.invariants import KEPT, NOT_JUDGED


@dataclass(frozen=True)
class Result:
    """One flight."""

    firmware: str
    seed: int
    kinds: tuple[str, ...]
    outcome: str
    """First word of its last line; `killed`, or `none` when it had none."""
    text: str
    worst_tilt_deg: float | None
    """True tilt in the air."""
    worst_error_m: float | None
    """True distance from the reference while tracking."""
    judged: int
    """How many invariants the flight said something about."""
    broken: dict[str, str]
    wall_s: float
    cpu_s: float

    def to_line(self) -> str:
        """JSON without line breaks."""
        return json.dumps(asdict(self), ensure_ascii=False)

    @staticmethod
    def from_line(line: str) -> Result:
        """Back from `to_line`."""
        values: dict[str, Any] = json.loads(line)
        values["kinds"] = tuple(values["kinds"])
        return Result(**values)


def result_of(e: Evidence, words: dict[str, str], cpu_s: float) -> Result:
    """Evidence and the judges' words in short."""
    flying = (e.height_m > 0.15) & (e.armed > 0) if len(e.box) else np.zeros(0, bool)
    outcome, text = e.ending
    return Result(
        firmware=e.planned.firmware,
        seed=e.planned.seed,
        kinds=e.planned.kinds,
        outcome="killed" if e.killed else outcome or "none",
        text=text or (e.words[-1] if e.words else ""),
        worst_tilt_deg=round(float(e.tilt_deg[flying].max()), 1) if flying.any() else None,
        worst_error_m=None if math.isnan(e.position_error_m) else round(e.position_error_m, 3),
        judged=sum(word != NOT_JUDGED for word in words.values()),
        broken={name: word for name, word in words.items() if word not in (KEPT, NOT_JUDGED)},
        wall_s=round(e.wall_s, 1),
        cpu_s=round(cpu_s, 2),
    )
