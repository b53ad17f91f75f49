"""`companion identify`: how the autopilot's own loops follow our setpoints, for the vehicle's profile."""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

EPILOG = """example:
  companion identify flights/flight.mcap        prints a table and the lines for the profile

A lemniscate or `--trajectory step` moves roll and pitch enough; yaw needs a trajectory that yaws.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "identify",
        help="dead time and lag of the autopilot's loops, from a log",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("log", metavar="LOG", help="a flight's MCAP file, whole or cut")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")


def run(arguments: argparse.Namespace) -> int:
    """Identify and print. Raises UserError for what is no flight, or one that did not move."""
    from companion.analysis.identify import identify, profile_lines
    from companion.flightlog.reader import read_log

    record = read_log(arguments.log)
    found = identify(record)
    autopilot = "ardupilot" if record.flight.get("firmware", "").startswith("ArduPilot") else "px4"
    if arguments.json:
        rows = [
            {
                "axis": r.axis,
                "dead_time_s": r.dead_time_s,
                "natural_frequency_rad_s": r.natural_frequency_rad_s,
                "damping": None if math.isnan(r.damping) else r.damping,
                "lag_s": r.lag_s,
                "explained": r.explained,
            }
            for r in found
        ]
        print(json.dumps({"autopilot": autopilot, "axes": rows}, indent=2))
        return 0
    from rich.console import Console
    from rich.table import Table

    table = Table(
        title=f"responses of {record.flight.get('firmware', 'the autopilot')}", title_justify="left"
    )
    for heading in ("axis", "dead time [ms]", "ω [rad/s]", "ζ", "lag [ms]", "explained"):
        table.add_column(heading, justify="right")
    for r in found:
        damping = "first order" if math.isnan(r.damping) else f"{r.damping:.2f} ± {r.spread[2]:.2f}"
        table.add_row(
            r.axis,
            f"{r.dead_time_s * 1e3:.0f} ± {r.spread[0] * 1e3:.0f}",
            f"{r.natural_frequency_rad_s:.1f} ± {r.spread[1]:.1f}",
            damping,
            f"{r.lag_s * 1e3:.0f}",
            f"{r.explained * 100:.1f} %",
        )
    console = Console()
    console.print(table)
    console.print("for the vehicle's profile:", highlight=False)
    console.print(profile_lines(found, autopilot), highlight=False, markup=False)
    return 0
