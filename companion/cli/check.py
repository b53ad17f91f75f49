"""`companion check`: everything a flight depends on, as ok, warning or refusal, with what mends it.

Changes nothing but message rates (the autopilot forgets them), unless --fix is given.
"""

from __future__ import annotations

import argparse
import itertools
import json
from typing import TYPE_CHECKING, Any

from companion.cli.fly import add_link_options, connection_from, pose_address
from companion.config.errors import UserError

if TYPE_CHECKING:
    from rich.table import Table

    from companion.autopilot.adapter import Finding
    from companion.config.provenance import Known

EPILOG = """examples:
  companion check --endpoint /dev/ttyACM0,921600
  companion check --endpoint tcp:127.0.0.1:5760 --set flight.procedure.ready_timeout_s=5
  companion check --endpoint tcp:127.0.0.1:5760 --fix     for good; fly --fix for one flight
  companion check --endpoint udpin:0.0.0.0:14540 --outside-poses 0.0.0.0:14600     are the source's axes right?

Exit codes: 0 nothing stands in the way (warnings may), 2 a flight would be refused, or wrong input.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "check",
        help="look at a vehicle before a flight",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--endpoint", required=True, metavar="ADDRESS", help="the autopilot's address")
    add_link_options(parser)
    parser.add_argument("--level", default="attitude", choices=("attitude", "body_rate", "actuator"))
    parser.add_argument(
        "--profile", metavar="NAME|FILE", help="what is to be otherwise than the autopilot tells (TOML)"
    )
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help="change a setting"
    )
    parser.add_argument(
        "--outside-poses",
        metavar="[HOST:]PORT",
        help="hear poses there as `fly` does, and look at their axes",
    )
    parser.add_argument("--fix", action="store_true", help="set parameters that stand in the way, for good")
    parser.add_argument(
        "--restore", action="store_true", help="put parameters back that an earlier fly --fix left changed"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")


def findings_of(
    arguments: argparse.Namespace,
) -> tuple[list[Finding], list[tuple[str, float, float]], list[Known]]:
    """What is found, what was set, and the vehicle's numbers. Raises UserError for wrong input, or nobody there."""
    from companion.cli.console import ConsoleReporter
    from companion.config.settings import load_settings
    from companion.flight.outcome import FlightEnd
    from companion.flight.session import check

    poses = pose_address(arguments.outside_poses)
    settings = load_settings(arguments.profile, {"level": arguments.level}, arguments.overrides)
    reporter = ConsoleReporter()
    try:
        connection = connection_from(arguments, arguments.endpoint)
        return check(settings, connection, reporter, arguments.fix, poses, arguments.restore)
    except FlightEnd as end:
        raise UserError(f"endpoint {arguments.endpoint}: {end}") from None


def run(arguments: argparse.Namespace) -> int:
    """Check and print. Raises UserError as `findings_of`."""
    from companion.autopilot.adapter import Verdict

    findings, changed, numbers = findings_of(arguments)
    refused = any(finding.verdict is Verdict.REFUSAL for finding in findings)
    if arguments.json:
        rows = [
            {
                "verdict": f.verdict.value,
                "subject": f.subject,
                "found": f.found,
                "why": f.why,
                "remedy": f.remedy,
            }
            for f in findings
        ]
        set_now = [{"parameter": name, "before": before, "now": now} for name, before, now in changed]
        vehicle = [{"key": n.key, "value": n.value, "from": n.source, "sure": n.sure} for n in numbers]
        body = {"flyable": not refused, "findings": rows, "changed": set_now, "vehicle": vehicle}
        print(json.dumps(body, indent=2, ensure_ascii=False))
        return 2 if refused else 0
    from rich.console import Console
    from rich.table import Table

    console = Console()
    console.print(_configuration(numbers))
    table = Table(title=f"level {arguments.level}", title_justify="left")
    for heading in ("", "what", "found", "why it matters", "what mends it"):
        table.add_column(heading, overflow="fold")
    colours = {Verdict.OK: "green", Verdict.WARNING: "yellow", Verdict.REFUSAL: "bold red"}
    for f in findings:
        table.add_row(f"[{colours[f.verdict]}]{f.verdict.value}[/]", f.subject, f.found, f.why, f.remedy)
    console.print(table)
    return 2 if refused else 0


def _configuration(numbers: list[Known]) -> Table:
    """The vehicle that would fly, on one screen: what is alike in source and room shares a line."""
    from rich.table import Table

    from companion.config.provenance import short

    table = Table(title="the vehicle", title_justify="left")
    for heading in ("what", "from"):
        table.add_column(heading, overflow="fold")
    for (_, source, sure), rows in itertools.groupby(
        numbers, lambda n: (n.key.split(".")[0], n.source, n.sure)
    ):
        shown = ", ".join(f"{n.key} {short(n.value)}" for n in rows)
        table.add_row(shown, f"{source}; {sure}" if sure else source)
    return table
