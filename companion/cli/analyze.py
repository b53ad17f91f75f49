"""`companion analyze`: a flight's errors beside the report's figures, as a table, JSON or an HTML report."""

from __future__ import annotations

import argparse
import json
from typing import Any

from companion.cli.fly import told_report

EXAMPLE = """examples:
  companion analyze flights/flight.mcap
  companion analyze flights/flight.mcap --from 8 --to 40 --json
  companion analyze flights/flight.mcap --report flight.html

Errors are reference minus truth where the log holds the truth, at the truth's own samples, and reference
minus estimate beside it, along the axes of the trajectory as it was laid out. The window is in seconds since
tracking started.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "analyze",
        help="measure a flight from its log",
        description=__doc__,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("log", metavar="LOG", help="a flight's MCAP file, whole or cut")
    add_window(parser)
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--report", metavar="FILE", help="also write an HTML report with figures")
    parser.set_defaults(run=run)


def add_window(parser: argparse.ArgumentParser) -> None:
    """Add --from and --to, as every command that measures has them."""
    parser.add_argument(
        "--from",
        dest="from_s",
        type=float,
        metavar="S",
        help="start of the window, s of tracking (default: 0)",
    )
    parser.add_argument(
        "--to",
        dest="to_s",
        type=float,
        metavar="S",
        help="end of the window, s of tracking (default: its end)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Analyze and print. Raises UserError for what is no log or a window outside the tracking."""
    from companion.analysis.metrics import flight_metrics
    from companion.flightlog.reader import read_log

    record = read_log(arguments.log)
    metrics, tracking = flight_metrics(record, arguments.from_s, arguments.to_s)
    report, code = arguments.report, 0
    if report:
        from companion.analysis.report import write_flight_report  # matplotlib takes its time to load

        if not told_report(lambda: write_flight_report(record, metrics, tracking, arguments.report)):
            report, code = None, 2
    if arguments.json:
        print(json.dumps(metrics.to_json(), indent=2, ensure_ascii=False, allow_nan=False))
        return code
    from rich.console import Console

    from companion.analysis.table import flight_table

    console = Console()
    console.print(flight_table(metrics))
    if report:
        console.print(f"report: {report}", soft_wrap=True, highlight=False)
    return code
