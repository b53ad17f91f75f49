"""`companion compare`: several controllers in one table with P_imp, as the report prints it.

Give it logs of flights, or let it fly them: each controller on the same seeds, the same m̂, the same trajectory.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.cli.analyze import add_window
from companion.cli.fly import (
    add_flight_options,
    claim,
    default_log_path,
    fly_once,
    prepare_report,
    told_report,
)
from companion.config.errors import UserError

EPILOG = """examples:
  companion compare --sitl px4 --seeds 1-5                       fly three controllers on five seeds, then compare
  companion compare --sitl px4-1.13 --level actuator --controllers dtlannc,my_law
  companion compare flights/tlmbc.mcap flights/nnsmc.mcap flights/dtlannc.mcap --report compare.html

Flights of one controller are averaged over their seeds. P_imp is against TLMBC.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "compare",
        help="compare controllers, from their logs or by flying them",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("logs", metavar="LOG", nargs="*", help="flights' MCAP files, whole or cut")
    add_flight_options(parser, required=False)
    parser.add_argument("--controllers", default="tlmbc,nnsmc,dtlannc", metavar="NAMES", help="which to fly")
    parser.add_argument(
        "--seeds", default="1-3", metavar="LIST", help="which seeds to fly, e.g. 1-5 or 1,4,7"
    )
    parser.add_argument(
        "--folder", metavar="DIR", help="where the flown logs go (default: flights/compare-TIME)"
    )
    add_window(parser)
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--report", metavar="FILE", help="also write an HTML report with figures")


def run(arguments: argparse.Namespace) -> int:
    """Fly if asked to, compare and print. Raises UserError for wrong input."""
    flies = bool(arguments.sitl or arguments.endpoint)
    if flies == bool(arguments.logs):
        raise UserError(
            "give either logs of flights, or --sitl or --endpoint to fly them; see companion compare --help"
        )
    if not flies:
        show_comparison(arguments.logs, arguments.from_s, arguments.to_s, arguments.json, arguments.report)
        return 0
    if arguments.report:
        prepare_report(arguments.report)
    logs, code = _fly_all(arguments)
    if logs:
        try:
            show_comparison(logs, arguments.from_s, arguments.to_s, arguments.json, arguments.report)
        except UserError as error:
            if not code:
                raise
            print(f"error: {error}", file=sys.stderr)  # how the series ended counts more
    return code


def _fly_all(arguments: argparse.Namespace) -> tuple[list[Path], int]:
    """Fly them one after another; returns the logs to compare and the exit code.

    Ctrl-C ends the series. So does, on a vehicle that is not the bundled stub, any flight that did not go as planned:
    a pilot who took the vehicle, or a limit that was reached, must not be followed by another take-off.
    """
    controllers = [name.strip() for name in arguments.controllers.split(",") if name.strip()]
    seeds = parse_seeds(arguments.seeds)
    if arguments.folder:
        folder = Path(arguments.folder)
    else:
        folder = claim(default_log_path("compare", arguments.level).with_suffix(""), Path.mkdir)
    flights = [(seed, controller) for seed in seeds for controller in controllers]
    logs: list[Path] = []
    for number, (seed, controller) in enumerate(flights, start=1):
        print(f"== flight {number} of {len(flights)}: {controller}, seed {seed}", file=sys.stderr)
        log = folder / f"{Path(controller).stem}-{arguments.level}-seed{seed}.mcap"
        outcome, _text, code = fly_once(arguments, controller, seed, log, overwrite=True)
        if code == 2:
            raise UserError(f"{controller}, seed {seed}, was refused; nothing to compare")
        if outcome == "interrupted" or (code and not arguments.sitl):
            print(
                f"the series ends here: {len(flights) - number} not flown; logs in {folder}", file=sys.stderr
            )
            return logs, code
        logs.append(log)
    return logs, 0


def parse_seeds(text: str) -> list[int]:
    """`1-3,7` → [1, 2, 3, 7]. Raises UserError for anything else."""
    seeds: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise UserError(f"--seeds {text}: write numbers and ranges, for example 1-5 or 1,4,7")
        seeds += range(int(first), int(last or first) + 1)
    if not seeds:
        raise UserError(f"--seeds {text}: holds no seed")
    return seeds


def show_comparison(
    logs: Sequence[str | os.PathLike[str]],
    from_s: float | None = None,
    to_s: float | None = None,
    as_json: bool = False,
    report: str | None = None,
) -> None:
    """Compare logs, print the table (or JSON), write the report where one is asked for."""
    from rich.console import Console

    from companion.analysis.comparison import compare_logs, comparison_table

    comparison = compare_logs(logs, from_s, to_s)
    if report is not None:
        from companion.analysis.report import write_comparison_report  # matplotlib takes its time to load

        written = report
        if not told_report(lambda: write_comparison_report(comparison, written)):
            report = None
    if as_json:
        print(json.dumps(comparison.to_json(), indent=2, ensure_ascii=False, allow_nan=False))
        return
    console = Console()
    console.print(comparison_table(comparison))
    if report is not None:
        console.print(f"report: {report}", soft_wrap=True, highlight=False)
