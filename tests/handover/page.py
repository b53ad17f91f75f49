"""The matrix as a table, and into the page between its markers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from handover.cells import ENDS
from handover.judging import Verdict

BEGIN, FINISH = "<!-- made by scripts/handover_matrix --write -->", "<!-- end of the matrix -->"


def table(verdicts: Sequence[Verdict]) -> str:
    """A row an end: the worst of all its cells."""
    rows = [
        "| end | cells | rises, m | tilt, ° | meets the ground, m/s | somebody has it after, s | broken |",
        "|---|---|---|---|---|---|---|",
    ]
    for end in ENDS:
        mine = [verdict for verdict in verdicts if verdict.cell.end == end]
        if mine:
            worst = [
                _worst(mine, of)
                for of in (
                    lambda v: v.rise_m,
                    lambda v: v.tilt_deg,
                    lambda v: v.sink_m_s,
                    lambda v: v.taken_s,
                )
            ]
            broken = sum(bool(verdict.broken) for verdict in mine)
            rows.append(f"| {end} | {len(mine)} | {' | '.join(worst)} | {broken} |")
    return "\n".join(rows)


def _worst(verdicts: Sequence[Verdict], of: Callable[[Verdict], float]) -> str:
    values = [of(verdict) for verdict in verdicts if not math.isnan(of(verdict))]
    return f"{max(values):.2f}" if values else "-"


def put_between_markers(page: Path, verdicts: Sequence[Verdict], of_all: int) -> None:
    """Write the table into a page. Raises ValueError where it has no markers."""
    before, found, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, found_end, after = rest.partition(FINISH)
    if not found or not found_end:
        raise ValueError(f"{page} has no lines {BEGIN!r} and {FINISH!r} to write between")
    broken = [verdict for verdict in verdicts if verdict.broken]
    lines = [f"{len(verdicts)} of {of_all} cells flown, {len(broken)} broken.", "", table(verdicts)]
    if broken:
        lines += ["", *(f"- {verdict.cell.name}: {'; '.join(verdict.broken)}" for verdict in broken)]
    page.write_text(before + BEGIN + "\n\n" + "\n".join(lines) + "\n\n" + FINISH + after, encoding="utf-8")
