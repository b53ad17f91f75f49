"""`companion standby`: wait, and engage each time the pilot, or a ground station, switches to our mode in the air."""

from __future__ import annotations

import argparse
from typing import Any

from companion.cli.fly import add_flight_options, add_log_options, fly_once, log_path_of, unless_empty

EPILOG = """examples:
  companion standby --endpoint /dev/autopilot,921600 --profile my_drone.toml
  companion standby --endpoint udpin:127.0.0.1:14540 --trajectory circle --duration 60 --controller tlmbc
  companion engage                     in another terminal: ask for our mode as the pilot's switch would

Engages when OFFBOARD (PX4) or GUIDED (ArduCopter) begins, and stops when it is left; docs/in_the_air.md says what is
refused. Ctrl-C ends it; in flight it lands as in any flight. Exit codes as of `companion fly`.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "standby",
        help="wait, and engage each time somebody switches to our mode in the air",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_flight_options(parser)
    add_log_options(parser)
    parser.add_argument(
        "--engage-port",
        type=int,
        default=14610,
        metavar="PORT",
        help="where `companion engage` is heard, on this machine only (default 14610)",
    )
    parser.set_defaults(trajectory="hover", duration=3600.0, from_air=True)


def run(arguments: argparse.Namespace) -> int:
    """Stand by until Ctrl-C. Raises UserError for wrong input."""
    log_path, claimed = log_path_of(arguments, arguments.log)
    with unless_empty(log_path, claimed):
        _, _, code = fly_once(
            arguments, arguments.controller, arguments.seed, log_path, arguments.overwrite or claimed
        )
    print(f"log: {log_path}")
    return code
