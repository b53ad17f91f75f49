"""`companion replay`: repeat a flight's control steps from its log and compare them bit by bit."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

EXAMPLE = """example:
  companion replay flights/flight.mcap

Exit code 0 when every step gives the logged bits, 1 when one does not. References of another program are made again
from what it sent, too.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "replay",
        help="repeat a flight's control steps from its log, bit by bit",
        description=__doc__,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("log", metavar="LOG", help="a flight's MCAP file, whole or cut")
    parser.add_argument("--law", metavar="FILE.py", help="the law that flew, where it is one of your own")
    parser.add_argument(
        "--run-law-in-log", action="store_true", help="run the text of such a law that the log holds"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Replay and say what came out. Raises UserError where the log does not hold what a replay needs."""
    from companion.analysis.live_replay import replay_references
    from companion.analysis.replay import laws_of, replay
    from companion.flightlog.reader import read_log

    record = read_log(arguments.log)
    law_file = Path(arguments.law) if arguments.law else None
    found = replay(record, laws_of(record, law_file, arguments.run_law_in_log))
    references = replay_references(record)
    if arguments.json:
        mismatches = [
            {"step": item.step, "time_s": item.time_s, "fields": item.fields} for item in found.mismatches
        ]
        body = {
            "exact": found.exact,
            "steps": found.steps,
            "identical": found.identical,
            "hand_overs": found.hand_overs,
            "mismatches": mismatches,
        }
        if references is not None:
            body["references"] = {"sampled": references[0], "identical": references[1]}
        print(json.dumps(body, indent=2))
    else:
        print(
            f"{found.identical} of {found.steps} steps give the same bits, {found.hand_overs} hand-overs between them"
        )
        for item in found.mismatches:
            print(
                f"  step {item.step} at {item.time_s:.3f} s: {', '.join(item.fields)} (by {item.largest:.3g})"
            )
        if references is not None:
            print(
                f"{references[1]} of {references[0]} references give the same bits from what the client sent"
            )
    same = references is None or references[0] == references[1]
    return 0 if found.exact and same else 1
