"""The command `scripts/handover_matrix`."""

from __future__ import annotations

import argparse
import math
import multiprocessing
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from campaign.crew import default_size
from campaign.processes import warm_up

from handover.cells import ENDS, FIRMWARES, LEVELS, MIDDLE_S, Cell, all_cells, shuffled
from handover.flying import fly_at, fly_cell
from handover.judging import Verdict, judge
from handover.page import put_between_markers, table

EXAMPLES = """examples:
  scripts/handover_matrix --cells 100               a hundred cells, drawn by --seed
  scripts/handover_matrix --phase lift-off          every end of the lift-off, both firmwares
  scripts/handover_matrix --end ctrl-c --end sigterm --firmware px4 --level body_rate
  scripts/handover_matrix --cells 300 --write docs/handover.md
  scripts/handover_matrix --endpoint udpin:0.0.0.0:14540 --firmware px4 --end ctrl-c
                                                    against a build of your own (a simulation: it is armed)

Exit codes: 0 every cell kept its bounds, 1 one did not, 2 wrong input, 130 interrupted.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="scripts/handover_matrix",
        description="Flies every moment of a flight with every way it can end, and judges by where the vehicle truly was.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name, choices in (
        ("--firmware", FIRMWARES),
        ("--level", LEVELS),
        ("--phase", tuple(MIDDLE_S)),
        ("--end", tuple(ENDS)),
    ):
        parser.add_argument(name, choices=choices, action="append", help="only this one; may be repeated")
    parser.add_argument("--heading", type=float, action="append", metavar="DEG", help="0, 90 or 180 only")
    parser.add_argument("--cells", type=int, metavar="N", help="so many, drawn by --seed (default: all)")
    parser.add_argument(
        "--seed", type=int, default=1, metavar="N", help="of the draw and of noise (default 1)"
    )
    parser.add_argument("--jobs", type=int, metavar="N", help="flights at a time (default: one per core)")
    parser.add_argument(
        "--endpoint", metavar="ADDRESS", help="fly there instead of against the stub, one by one"
    )
    parser.add_argument("--profile", metavar="NAME", help="with --endpoint: the vehicle's profile")
    parser.add_argument("--keep", metavar="DIR", help="files of cells that broke a bound")
    parser.add_argument("--write", metavar="PAGE", help="put the table between the markers of a page")
    parser.add_argument("--json", action="store_true", help="print a line of JSON a cell")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    options = _parser().parse_args(arguments)
    cells = [cell for cell in all_cells(options.seed) if _wanted(cell, options)]
    if options.endpoint is not None:
        cells = [cell for cell in cells if not ENDS[cell.end].needs_stub and cell.heading_deg == 0.0]
    cells = shuffled(cells, options.cells, options.seed)
    if not cells or (options.jobs is not None and options.jobs < 1):
        print("scripts/handover_matrix: no such cell, or --jobs below 1: see --help", file=sys.stderr)
        return 2
    if options.write is not None and not Path(options.write).is_file():
        print(f"scripts/handover_matrix: --write {options.write}: there is no such page", file=sys.stderr)
        return 2
    stubs = sorted({cell.planned.stub_firmware for cell in cells})
    warm_up(stubs)

    verdicts: list[Verdict] = []
    interrupted = False
    try:
        _fly_all(cells, options, verdicts)
    except KeyboardInterrupt:
        interrupted = True
    broken = [verdict for verdict in verdicts if verdict.broken]
    if not options.json:
        print(table(verdicts))
        for verdict in broken:
            print(f"BROKEN {verdict.cell.name}: {'; '.join(verdict.broken)}")
    print(f"{len(verdicts)} cells flown, {len(broken)} broken", file=sys.stderr)
    if options.write is not None:
        put_between_markers(Path(options.write), verdicts, sum(1 for _ in all_cells()))
    return 130 if interrupted else (1 if broken else 0)


def _wanted(cell: Cell, options: argparse.Namespace) -> bool:
    pairs = (
        (options.firmware, cell.firmware),
        (options.level, cell.level),
        (options.phase, cell.phase),
        (options.end, cell.end),
        (options.heading, cell.heading_deg),
    )
    return all(chosen is None or value in chosen for chosen, value in pairs)


def _fly_all(cells: list[Cell], options: argparse.Namespace, verdicts: list[Verdict]) -> None:
    """In forked workers, which fork both programs of a flight themselves."""
    jobs = 1 if options.endpoint is not None else options.jobs or default_size()
    with (
        tempfile.TemporaryDirectory(prefix="handover-") as scratch,
        multiprocessing.get_context("fork").Pool(jobs) as pool,
    ):
        orders = [
            (cell, Path(scratch) / str(number), options.endpoint, options.profile, options.keep)
            for number, cell in enumerate(cells)
        ]
        for verdict in pool.imap_unordered(_fly_one, orders):
            verdicts.append(verdict)
            _tell(verdict, len(verdicts), len(cells), options.json)


def _fly_one(order: tuple[Cell, Path, str | None, str | None, str | None]) -> Verdict:
    cell, folder, endpoint, profile, keep = order
    flown = fly_cell(cell, folder) if endpoint is None else fly_at(cell, folder, endpoint, profile)
    verdict = judge(cell, flown)
    if verdict.broken and keep is not None:
        shutil.copytree(folder, Path(keep) / cell.name.replace(", ", "-"), dirs_exist_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    return verdict


def _tell(verdict: Verdict, number: int, total: int, as_json: bool) -> None:
    if as_json:
        print(verdict.to_line(), flush=True)
    taken = "-" if math.isnan(verdict.taken_s) else f"{verdict.taken_s:.2f} s"
    numbers = f"rise {verdict.rise_m:.2f} m, tilt {verdict.tilt_deg:.0f}°, ground {verdict.sink_m_s:.1f} m/s, {taken}"
    word = "BROKEN " + "; ".join(verdict.broken) if verdict.broken else "kept"
    print(f"{number}/{total} {verdict.cell.name}: {numbers}: {word}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
