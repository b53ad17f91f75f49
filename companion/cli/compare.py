"""`companion compare`: several controllers' flights in one table with P_imp, as the report prints it."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from typing import Any

from rich.console import Console

from companion.analysis.comparison import Comparison, compare_logs, comparison_table
from companion.cli.analyze import add_window

EXAMPLE = """example:
  companion compare flights/tlmbc.mcap flights/nnsmc.mcap flights/dtlannc.mcap --report compare.html

Flights of one controller are averaged over their seeds. P_imp is against TLMBC.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "compare",
        help="compare controllers from their logs",
        description=__doc__,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("logs", metavar="LOG", nargs="+", help="flights' MCAP files, whole or cut")
    add_window(parser)
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--report", metavar="FILE", help="also write an HTML report with figures")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Compare and print. Raises UserError for what is no log, or when none of them tracked."""
    show_comparison(arguments.logs, arguments.from_s, arguments.to_s, arguments.json, arguments.report)
    return 0


def show_comparison(
    logs: Sequence[str | os.PathLike[str]],
    from_s: float | None = None,
    to_s: float | None = None,
    as_json: bool = False,
    report: str | os.PathLike[str] | None = None,
) -> Comparison:
    """Compare logs, print the table (or JSON), write the report where one is asked for, and return the figures."""
    comparison = compare_logs(logs, from_s, to_s)
    if report is not None:
        from companion.analysis.report import write_comparison_report  # matplotlib takes its time to load

        write_comparison_report(comparison, report)
    if as_json:
        print(json.dumps(comparison.to_json(), indent=2, ensure_ascii=False, allow_nan=False))
        return comparison
    console = Console()
    console.print(comparison_table(comparison))
    if report is not None:
        console.print(f"report: {report}", soft_wrap=True, highlight=False)
    return comparison
