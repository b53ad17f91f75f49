"""`companion export`: the raw MAVLink of a flight as a .tlog for Mission Planner, QGroundControl or pymavlink."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

EXAMPLE = """example:
  companion export flights/flight.mcap -o flight.tlog
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "export",
        help="write a flight's raw MAVLink as a .tlog",
        description=__doc__,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("log", metavar="LOG", help="a flight's MCAP file, whole or cut")
    parser.add_argument("-o", "--output", metavar="OUT", help="file to write (default: LOG with .tlog)")
    parser.add_argument(
        "--direction", choices=("in", "out", "both"), default="both", help="frames to write (default: both)"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Export and say how much. Raises UserError for what is no log or holds no MAVLink."""
    from companion.flightlog.reader import read_log
    from companion.flightlog.tlog import export_tlog

    record = read_log(arguments.log)
    output = Path(arguments.output) if arguments.output else record.path.with_suffix(".tlog")
    directions = ("in", "out") if arguments.direction == "both" else (arguments.direction,)
    count = export_tlog(record, output, directions)
    note = f" (the log was cut: {record.cut})" if record.cut else ""
    print(f"{count} frames in {output}{note}")
    return 0
