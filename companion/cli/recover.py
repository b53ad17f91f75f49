"""`companion recover`: a whole, indexed file out of a log that was cut."""

from __future__ import annotations

import argparse
from typing import Any

EXAMPLE = """example:
  companion recover flights/crash.mcap -o flights/crash-whole.mcap

Every command of companion reads a cut log as it is; recover is for Foxglove and other programs.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "recover",
        help="make a whole, indexed file of a log that was cut",
        description=__doc__,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("log", metavar="LOG", help="the MCAP file that was cut")
    parser.add_argument("-o", "--output", metavar="OUT", help="file to write (default: LOG.recovered.mcap)")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Recover and say what was saved. Raises UserError for what is no log."""
    from companion.flightlog.recovery import recover

    saved = recover(arguments.log, arguments.output)
    state = saved.cut or "the file was whole"
    print(f"{state}: saved {saved.messages} records over {saved.seconds:.2f} s in {saved.output}")
    return 0
