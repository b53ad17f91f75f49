"""`companion serve`: stand in for the autopilot; what programs ask for that connect to us is flown by our law."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.config.errors import UserError
from companion.control.laws import LAWS, load_law_file

if TYPE_CHECKING:
    import socket

    from companion.serve.session import ServeOptions

TRANSIT = (
    "flight.procedure.transit_speed_m_s=3",
    "flight.procedure.transit_acceleration_m_s2=2",
    "flight.procedure.transit_jerk_m_s3=8",
)
"""On the way to a setpoint that jumps: nearer to an autopilot's own limits than those of a flight's run-in."""
EPILOG = """examples:
  companion serve --endpoint udpin:0.0.0.0:14540 --clients udpout:127.0.0.1:14541
      PX4's simulation; MAVSDK connects to udpin://0.0.0.0:14541 instead of 14540
  companion serve --endpoint /dev/ttyACM0,921600 --clients udpin:0.0.0.0:14551 tcpin:127.0.0.1:5760
      clients that speak first, from other computers too, and such as connect by TCP

Ctrl-C ends it; in flight that is to the vehicle as if the client had been killed. Exit codes: 0 ended by a signal,
2 wrong input.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    from companion.cli.fly import add_link_options

    parser = subparsers.add_parser(
        "serve",
        help="stand in for the autopilot: programs connect to us and track better",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--endpoint",
        required=True,
        metavar="ADDRESS",
        help="the autopilot's address, as pymavlink or MAVSDK spell it",
    )
    parser.add_argument(
        "--clients",
        required=True,
        nargs="+",
        metavar="ADDRESS",
        help="where clients are: udpin: and tcpin: listen for them (on this machine only, unless a host is named), "
        "udpout: speaks first, or a serial port",
    )
    add_link_options(parser)
    parser.add_argument(
        "--demand-signing",
        action="store_true",
        help="pass on nothing of clients that is not signed with --signing-key",
    )
    parser.add_argument(
        "--controller",
        default="dtlannc",
        metavar="NAME|FILE.py",
        help=f"control law: {', '.join(LAWS)}, or the file of your own",
    )
    parser.add_argument(
        "--level", default="attitude", choices=("attitude", "body_rate", "actuator"), help="what is sent"
    )
    parser.add_argument("--profile", metavar="NAME|FILE", help="as for `companion fly`")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a setting, e.g. flight.safety.fence.radius_m=100",
    )


def run(arguments: argparse.Namespace) -> int:
    """Serve until a signal. Raises UserError for wrong input."""
    from companion.cli.fly import connection_from
    from companion.config.settings import load_settings
    from companion.serve.session import ServeOptions, serve

    if arguments.link != "pymavlink":
        raise UserError(
            "--link mavsdk: it holds its connection for itself; `serve` passes on with --link pymavlink"
        )
    if arguments.demand_signing and not arguments.signing_key:
        raise UserError("--demand-signing needs the key: --signing-key FILE")
    controller, law_text = _law_of(arguments.controller)
    settings = load_settings(
        arguments.profile,
        {"controller": controller, "level": arguments.level, "trajectory": "hover"},
        [*TRANSIT, *arguments.overrides],
    )
    options = ServeOptions(
        connection=connection_from(arguments, arguments.endpoint),
        clients=tuple(arguments.clients),
        settings=settings,
        demand_signing=arguments.demand_signing,
        command_line=shlex.join(sys.argv),
        law_text=law_text,
        law_file=arguments.controller if law_text else "",
    )
    from companion.cli.console import ConsoleReporter

    reporter = ConsoleReporter()
    try:
        return serve(options, law_process, reporter.say)
    finally:
        reporter.close()


def _law_of(controller: str) -> tuple[str, str]:
    """Name of a law, and its text where it is a file of one's own. Raises UserError."""
    if not controller.endswith(".py"):
        return controller, ""
    return load_law_file(Path(controller)), Path(controller).read_text(encoding="utf-8")


def law_process(wire: socket.socket, control: socket.socket, options: ServeOptions) -> None:
    """The process that flies; its words go to the same terminal."""
    from companion.cli.console import ConsoleReporter
    from companion.cli.fly import claim, default_log_path
    from companion.flight.outcome import FlightEnd
    from companion.serve.session import fly_for_clients

    if options.law_file:
        _law_of(options.law_file)
    reporter = ConsoleReporter()

    def new_log() -> Path:
        return claim(
            default_log_path("serve", options.settings.level.value), lambda path: path.touch(exist_ok=False)
        )

    try:
        fly_for_clients(wire, control, options, reporter, new_log)
    except (UserError, FlightEnd) as end:
        reporter.say(f"our law stops: {end}")
    finally:
        reporter.close()
