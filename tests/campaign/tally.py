"""Many results as a table: by what was done to the flights, and which invariants broke."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from campaign.invariants import INVARIANTS
from campaign.result import Result

BLOCKS = {
    "campaign": "<!-- campaign: made by scripts/campaign --write -->",
    "planted defects": "<!-- planted defects: made by scripts/campaign --planted --write -->",
}
"""What the command writes into a page, and the line it comes after; `<!-- end of NAME -->` ends it."""
COLUMNS = ("completed", "landed early", "handed back", "pilot's", "link lost", "refused", "killed")
_IN_COLUMN = {
    "aborted": "landed early",
    "interrupted": "landed early",
    "pilot took over": "pilot's",
}


class Tally:
    """Results so far."""

    def __init__(self, results: Iterable[Result] = ()) -> None:
        self.results: list[Result] = list(results)

    def add(self, result: Result) -> None:
        """Take one more."""
        self.results.append(result)

    @property
    def broken(self) -> list[Result]:
        """Those that broke an invariant."""
        return [result for result in self.results if result.broken]

    def rows(self, firmware: str) -> list[list[str]]:
        """Cells of the table by kind: a flight to which two things were done counts in both rows."""
        mine = [result for result in self.results if result.firmware == firmware]
        kinds = sorted(
            {kind for result in mine for kind in result.kinds}, key=lambda kind: (kind != "none", kind)
        )
        rows = [_row(kind, [result for result in mine if kind in result.kinds]) for kind in kinds]
        return [*rows, _row("**all**", mine)]

    def table(self, firmware: str) -> str:
        """Markdown."""
        head = ["done to it", "flights", *COLUMNS, "worst tilt", "worst error", "invariants broken"]
        lines = [_line(head), "|---" + "|---:" * (len(head) - 1) + "|"]
        return "\n".join([*lines, *map(_line, self.rows(firmware))]) + "\n"

    def invariants(self) -> str:
        """How often each invariant broke, in words; empty when none did."""
        counts = Counter(name for result in self.broken for name in result.broken)
        return ", ".join(f"{name} {count}" for name, count in counts.most_common())

    def page(self, repeat: str) -> str:
        """What goes between the markers of the page; `repeat` is the command that made it."""
        parts = [f"`{repeat}`; {len(INVARIANTS)} invariants.\n"]
        for firmware in sorted({result.firmware for result in self.results}, reverse=True):
            mine = [result for result in self.results if result.firmware == firmware]
            seeds = f"seeds {min(r.seed for r in mine)} to {max(r.seed for r in mine)}"
            parts.append(f"### {firmware}: {len(mine)} flights, {seeds}\n\n{self.table(firmware)}")
        return "\n".join(parts)


def _row(kind: str, results: Sequence[Result]) -> list[str]:
    ends = Counter(_IN_COLUMN.get(result.outcome, result.outcome) for result in results)
    tilts = [result.worst_tilt_deg for result in results if result.worst_tilt_deg is not None]
    errors = [result.worst_error_m for result in results if result.worst_error_m is not None]
    broken = sum(bool(result.broken) for result in results)
    shown = [str(ends[column]) if ends[column] else "" for column in COLUMNS]
    tilt = f"{max(tilts):.0f}°" if tilts else ""
    error = f"{max(errors):.2f} m" if errors else ""
    return [kind, str(len(results)), *shown, tilt, error, str(broken)]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def as_json(tally: Tally) -> dict[str, Any]:
    """For programs."""
    return {
        "flights": len(tally.results),
        "broken": [{"firmware": r.firmware, "seed": r.seed, "broken": r.broken} for r in tally.broken],
        "rows": {
            firmware: tally.rows(firmware)
            for firmware in sorted({result.firmware for result in tally.results})
        },
    }


def put_between_markers(page: Path, name: str, text: str) -> None:
    """Replace a block of a page. Raises ValueError when the page has none of that name."""
    begin, end = BLOCKS[name], f"<!-- end of {name} -->"
    content = page.read_text(encoding="utf-8")
    before, found, rest = content.partition(begin)
    _, found_end, after = rest.partition(end)
    if not found or not found_end:
        raise ValueError(f"{page} has no lines {begin!r} and {end!r} to write between")
    page.write_text(f"{before}{begin}\n\n{text}\n{end}{after}", encoding="utf-8")


def read_results(path: Path) -> list[Result]:
    """Results of earlier runs, one JSON line each. Raises ValueError naming the line that is none."""
    found = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            found.append(Result.from_line(line))
        except (json.JSONDecodeError, TypeError, KeyError) as error:
            raise ValueError(f"{path}, line {number}: not a result of this campaign ({error})") from error
    return found
