"""`companion engage`: ask a running `companion standby` to switch to our mode, as the pilot's switch would."""

from __future__ import annotations

import argparse
import socket
import sys
from typing import Any

from companion.config.errors import UserError

ANSWER_S = 2.0

EPILOG = """examples:
  companion engage                          with the law that standby was started with
  companion engage --controller tlmbc       with another; in flight the law changes without a bump

It talks to `companion standby` on this machine, which asks the autopilot for the mode and refuses what it would refuse
the pilot's switch. Nothing is armed. Exit codes: 0 asked for, 2 refused, or nobody stands by.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "engage",
        help="ask a running standby to engage",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--controller", default="", metavar="NAME", help="control law to engage with")
    parser.add_argument(
        "--engage-port", type=int, default=14610, metavar="PORT", help="of the standby (default 14610)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Ask, and say what was answered. Raises UserError where nobody answers, or it is refused."""
    if not 0 < arguments.engage_port < 65536:
        raise UserError(f"--engage-port {arguments.engage_port}: give a port from 1 to 65535")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.settimeout(ANSWER_S)
        wire.connect(("127.0.0.1", arguments.engage_port))
        try:
            wire.send(arguments.controller.encode())
            answer = wire.recv(1024).decode("utf-8", "replace")
        except OSError:
            raise UserError(
                f"nobody stands by on port {arguments.engage_port} of this machine: start `companion standby` first"
            ) from None
    if answer.startswith("refused"):
        raise UserError(answer)
    print(answer, file=sys.stderr)
    return 0
