"""`companion fly`: connect, check, take off, track, land; a log of it all, and the errors at the end."""

from __future__ import annotations

import argparse
import datetime
import itertools
import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.config.errors import UserError
from companion.control.laws import AUTOPILOT, LAWS, law_entry, load_law_file

if TYPE_CHECKING:
    from companion.mavlink.connection import Connection

USUAL_TRACKING_S = 40.0
LONGEST_LIVE_S = 3600.0
EPILOG = """examples:
  companion fly --sitl px4                                     the bundled stub, as fast as it goes
  companion fly --sitl px4 --real-time --controller tlmbc      the same in real time, another law
  companion fly --endpoint udpin:0.0.0.0:14540                 any PX4 multirotor, here its own simulation
  companion fly --endpoint tcp:127.0.0.1:5760 --fix            any ArduCopter
  companion fly --endpoint /dev/ttyACM0,921600 --profile my_drone.toml --trajectory hover
  companion fly --endpoint /dev/ttyACM0,921600 --from-air      a vehicle that hovers already
  companion fly --sitl px4 --sitl-options "--vehicle random:7" a vehicle that nobody has written a profile for

Ctrl-C lands; a second Ctrl-C hands back to the autopilot at once. A vehicle that is not a simulation is armed by
its pilot, unless --arm is given. Exit codes: 0 flown as planned, 1 the link was lost, or the autopilot took
no mode that was asked for, 2 refused or wrong input, 3 ended early and landed or handed back.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "fly",
        help="fly a trajectory",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_flight_options(parser)
    add_log_options(parser)
    parser.add_argument(
        "--schedule",
        default="",
        metavar="LAW:S,…",
        help="laws that take turns while tracking, so many seconds each; in place of --controller and --duration",
    )
    parser.add_argument("--report", nargs="?", const="", metavar="FILE", help="also write an HTML report")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Options of what is flown by one law into one log; `fly` and `standby` share them."""
    parser.add_argument(
        "--controller",
        default="dtlannc",
        metavar="NAME|FILE.py",
        help=f"control law: {', '.join(LAWS)}, {AUTOPILOT} (its own controller), or the file of your own",
    )
    parser.add_argument(
        "--seed", type=int, default=1, metavar="N", help="draws the networks, and the stub's noise"
    )
    parser.add_argument(
        "--log", metavar="FILE", help="MCAP file (default: flights/TIME-CONTROLLER-LEVEL.mcap)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing log file")


def add_flight_options(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Options that `fly` and `compare` share."""
    where = parser.add_mutually_exclusive_group(required=required)
    where.add_argument(
        "--endpoint", metavar="ADDRESS", help="the autopilot's address, as pymavlink or MAVSDK spell it"
    )
    where.add_argument(
        "--sitl", metavar="FIRMWARE", help="start the bundled stub: px4, px4-1.13 or ardupilot"
    )
    add_link_options(parser)
    parser.add_argument(
        "--sitl-options", default="", metavar="WORDS", help="further options of sitl-stub, in quotes"
    )
    parser.add_argument(
        "--real-time", action="store_true", help="run the stub in real time instead of lockstep"
    )
    parser.add_argument(
        "--level", default="attitude", choices=("attitude", "body_rate", "actuator"), help="what is sent"
    )
    parser.add_argument(
        "--trajectory",
        default="lemniscate",
        metavar="NAME|FILE",
        help="see docs/trajectories.md; live:udp:PORT, live:mavlink:PORT, live:stdin: docs/live_references.md",
    )
    parser.add_argument(
        "--frame", default="takeoff", choices=("takeoff", "local"), help="where the trajectory is laid out"
    )
    parser.add_argument(
        "--duration",
        type=float,
        metavar="S",
        help="tracking time, s (default 40; a mission whole; live references until they end, an hour at most)",
    )
    parser.add_argument(
        "--profile",
        metavar="NAME|FILE",
        help="what is to be otherwise than the autopilot tells (TOML); of the stub's own vehicles by default theirs",
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a setting, e.g. profile.mass_ratio=1.0",
    )
    parser.add_argument(
        "--outside-poses",
        metavar="[HOST:]PORT",
        help="hear poses of a motion-capture system there (UDP), forward them as ODOMETRY (docs/links.md)",
    )
    parser.add_argument(
        "--pose-rate", type=float, default=50.0, metavar="HZ", help="forward so many at most (default 50)"
    )
    parser.add_argument(
        "--from-air",
        action="store_true",
        help="begin in the air: the vehicle hovers already, under its pilot or its autopilot (docs/in_the_air.md)",
    )
    parser.add_argument(
        "--then",
        choices=("hold", "land", "return"),
        help="what the autopilot does once the plan is flown (default: hold with --from-air, else land)",
    )
    parser.set_defaults(engage_port=None, schedule="")  # a port is what stands by
    parser.add_argument("--arm", action="store_true", help="let the companion arm a real vehicle")
    parser.add_argument("--wait-for-offboard", action="store_true", help="leave the mode switch to the pilot")
    parser.add_argument(
        "--fix", action="store_true", help="set parameters that stand in the way, put them back on landing"
    )


def schedule_from(text: str) -> tuple[tuple[str, float], ...]:
    """Laws and seconds of `tlmbc:20,dtlannc:20`. Raises UserError for anything else."""
    parts = []
    for part in text.split(","):
        name, _, seconds = part.strip().partition(":")
        try:
            lasts_s = float(seconds)
        except ValueError:
            lasts_s = math.nan
        if not name or not 1.0 <= lasts_s <= 3600.0:
            raise UserError(f"--schedule {part!r}: give LAW:SECONDS, for example tlmbc:20,dtlannc:20")
        parts.append((name, lasts_s))
    return tuple(parts)


def add_link_options(parser: argparse.ArgumentParser) -> None:
    """Options on how the endpoint is spoken to; `fly`, `compare` and `check` share them."""
    parser.add_argument(
        "--link", default="pymavlink", choices=("pymavlink", "mavsdk"), help="what carries the bytes"
    )
    parser.add_argument(
        "--system",
        type=system_id,
        metavar="N",
        help="the autopilot with this MAVLink system id; needed where several share the link",
    )
    parser.add_argument(
        "--signing-key", metavar="FILE", help="sign with this key, believe nothing else (docs/links.md)"
    )


def system_id(text: str) -> int:
    """A MAVLink system id. Raises ArgumentTypeError for anything but 1 to 255."""
    if not text.isdecimal() or not 1 <= int(text) <= 255:
        raise argparse.ArgumentTypeError(f"{text!r} is no MAVLink system id: give 1 to 255")
    return int(text)


def connection_from(arguments: argparse.Namespace, address: str) -> Connection:
    """How to reach the autopilot at `address`. Raises UserError for a wrong address."""
    from companion.mavlink.connection import Connection, LinkLibrary
    from companion.mavlink.endpoint import parse_endpoint

    key = Path(arguments.signing_key) if arguments.signing_key else None
    return Connection(parse_endpoint(address), LinkLibrary(arguments.link), key, arguments.system)


def pose_address(text: str | None, option: str = "--outside-poses") -> tuple[str, int] | None:
    """`[HOST:]PORT`; without a host this machine only. Raises UserError for anything else."""
    from companion.mavlink.endpoint import host_and_port

    return None if text is None else host_and_port(text, option)


def tracking_time(arguments: argparse.Namespace) -> float:
    """How long is tracked, s: as asked, and else as long as the trajectory needs.

    Raises UserError for a trajectory that is none: it is told before anything is started.
    """
    from companion.live.trajectory import LiveTrajectory, trajectory_or_live
    from companion.reference.mission import Mission

    trajectory = trajectory_or_live(arguments.trajectory)
    if arguments.duration is not None:
        return float(arguments.duration)
    if isinstance(trajectory, Mission):
        return max(USUAL_TRACKING_S, trajectory.duration_s + 60.0)
    return LONGEST_LIVE_S if isinstance(trajectory, LiveTrajectory) else USUAL_TRACKING_S


def _pose_rate(rate_hz: float) -> float:
    if not 1.0 <= rate_hz <= 200.0:
        raise UserError(f"--pose-rate {rate_hz:g}: give 1 to 200 Hz; PX4 advises 30 to 50")
    return rate_hz


def run(arguments: argparse.Namespace) -> int:
    """Fly once. Raises UserError for wrong input."""
    log_path, claimed = log_path_of(arguments, arguments.log)
    report = _report_path(arguments.report, log_path)
    with unless_empty(log_path, claimed):
        if report is not None:
            prepare_report(report)
        outcome, text, code = fly_once(
            arguments, arguments.controller, arguments.seed, log_path, arguments.overwrite or claimed
        )
    try:
        _show(log_path, report, arguments.json, outcome, text)
    except (Exception, KeyboardInterrupt) as error:  # the flight is over: its exit code stands
        print(f"no table: {error!r}\nlog: {log_path}", file=sys.stderr)
    return code


@contextmanager
def unless_empty(log_path: Path, claimed: bool) -> Iterator[None]:
    """A log file that was made for a flight which never began is gone afterwards."""
    try:
        yield
    finally:
        with suppress(OSError):
            if claimed and not log_path.stat().st_size:
                log_path.unlink()


def log_path_of(arguments: argparse.Namespace, given: str | None) -> tuple[Path, bool]:
    """Where the log goes, and whether that is a new file of ours, made here. Raises UserError where none can be made."""
    if given:
        return Path(given), False
    new = default_log_path(Path(arguments.controller).stem, arguments.level)
    return claim(new, lambda path: path.touch(exist_ok=False)), True


def default_log_path(controller: str, level: str) -> Path:
    """A new file below `flights/`, named by UTC time, law and level."""
    now = datetime.datetime.now(datetime.UTC)
    return Path("flights") / f"{now:%Y%m%d-%H%M%S}-{controller}-{level}.mcap"


def claim(path: Path, make: Callable[[Path], object]) -> Path:
    """`path`, or that with -2, -3 … before its ending where another flight of the same second has it; made by `make`.

    `make` raises FileExistsError for what is there. Raises UserError where nothing can be made.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            free = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
            with suppress(FileExistsError):
                make(free)
                return free
    except OSError as error:
        raise UserError(
            f"cannot write in the folder {path.parent}: {error.strerror or error}; choose another one with --log"
        ) from None
    raise AssertionError


def prepare_report(path: str | os.PathLike[str]) -> None:
    """Make sure before a flight that its report can be made and written; a folder that is not there is made.

    Raises UserError with the remedy.
    """
    from companion.analysis.page import check_room

    check_room(path)


def told_report(write: Callable[[], None]) -> bool:
    """Write a report after a flight; what goes wrong is said, and costs neither results nor exit code."""
    try:
        write()
        return True
    except (
        Exception
    ) as error:  # whatever a library or a disk may raise: the flight is over and its result stands
        print(f"no report: {error}", file=sys.stderr)
        return False


def fly_once(
    arguments: argparse.Namespace, controller: str, seed: int, log_path: Path, overwrite: bool
) -> tuple[str, str, int]:
    """One flight with the shared options, or where they say so standing by for many; outcome, text and exit code."""
    from companion.autopilot.adapter import Intent
    from companion.cli.console import ConsoleReporter
    from companion.cli.sitl import FIRMWARES, STUB_PATIENCE, airborne, running_stub
    from companion.config.settings import load_settings
    from companion.flight.session import SessionOptions, fly, stand_by
    from companion.live.trajectory import PREFIX

    law_text = ""
    schedule = schedule_from(arguments.schedule) if arguments.schedule else ()
    if schedule:
        controller = schedule[0][0]
        for name, _ in schedule:
            law_entry(name)  # a wrong one is told before anything is started
    if controller.endswith(".py"):
        law_file = Path(controller)
        controller = load_law_file(law_file)
        law_text = law_file.read_text(encoding="utf-8")
    settings = load_settings(
        arguments.profile or _stubs_profile(arguments),
        {
            "controller": controller,
            "level": arguments.level,
            "trajectory": arguments.trajectory,
            "layout": arguments.frame,
            "seed": seed,
            "duration_s": sum(lasts_s for _, lasts_s in schedule) or tracking_time(arguments),
        },
        ([STUB_PATIENCE] if arguments.sitl else []) + arguments.overrides,
    )
    for name in dict.fromkeys(name for name, _ in schedule):
        settings.gains_of(name)
    if arguments.trajectory.startswith(PREFIX) and (schedule or arguments.engage_port is not None):
        raise UserError("live references are flown by `companion fly`, without --schedule")
    if arguments.from_air and arguments.fix:
        raise UserError("--fix sets parameters on the ground: run `companion check --fix` before the flight")
    if arguments.sitl and arguments.sitl not in FIRMWARES:
        raise UserError(f"--sitl {arguments.sitl}: the bundled stub has {', '.join(FIRMWARES)}")
    reporter = ConsoleReporter()
    if arguments.sitl:
        reporter.say("starting the bundled stub; the first time on a machine it compiles for up to a minute")
    stub_words = [*(airborne(arguments.sitl) if arguments.sitl and arguments.from_air else ())]
    stub_words += shlex.split(arguments.sitl_options) + ([] if arguments.real_time else ["--lockstep"])
    simulator = (
        running_stub(arguments.sitl, seed, stub_words) if arguments.sitl else nullcontext(arguments.endpoint)
    )
    if arguments.sitl and (other := _another_vehicle(arguments)):
        reporter.say(f"warning: {other}")
    with simulator as address:
        options = SessionOptions(
            connection=connection_from(arguments, address),
            log_path=log_path,
            overwrite=overwrite,
            may_arm=arguments.arm,
            fix=arguments.fix,
            wait_for_offboard=arguments.wait_for_offboard,
            from_air=arguments.from_air,
            then=Intent(arguments.then or ("hold" if arguments.from_air else "land")),
            real_time=not arguments.sitl or arguments.real_time,
            command_line=shlex.join(sys.argv),
            outside_poses=pose_address(arguments.outside_poses),
            pose_rate_hz=_pose_rate(arguments.pose_rate),
            schedule=schedule,
            law_text=law_text,
            engage_port=arguments.engage_port or 0,
        )
        try:
            result = (fly if arguments.engage_port is None else stand_by)(settings, options, reporter)
            reporter.say(f"{result.outcome.value}: {result.text}")
        finally:
            reporter.close()
    return result.outcome.value, result.text, result.outcome.exit_code


def _another_vehicle(arguments: argparse.Namespace) -> str:
    """What to say where the profile is not the one of the vehicle that the stub flies; empty where it is."""
    own = _stubs_profile(arguments)
    if own is None or arguments.profile in (None, own):
        return ""
    return (
        f"the stub flies the vehicle of {own}, not that of --profile {arguments.profile}; "
        'give it yours with --sitl-options "--vehicle NAME|FILE"'
    )


def _stubs_profile(arguments: argparse.Namespace) -> str | None:
    """The profile of the report's experiment for the vehicle that the stub flies by itself; None for any other vehicle."""
    from companion.cli.sitl import STUB_PROFILES

    chosen = any(word.startswith("--veh") for word in shlex.split(arguments.sitl_options))
    return None if chosen else STUB_PROFILES.get(arguments.sitl)


def _report_path(wish: str | None, log_path: Path) -> Path | None:
    if wish is None:
        return None
    return Path(wish) if wish else log_path.with_suffix(".html")


def _show(log_path: Path, report: Path | None, as_json: bool, outcome: str, text: str) -> None:
    """The table or the JSON, from the log file itself; a flight without tracking says so instead."""
    from companion.analysis.metrics import flight_metrics
    from companion.analysis.table import flight_table
    from companion.flightlog.reader import read_log

    record = read_log(log_path)
    try:
        metrics, tracking = flight_metrics(record, None, None)
    except UserError as error:
        if as_json:
            print(json.dumps({"ended": outcome, "text": text, "log": str(log_path)}, indent=2))
        else:
            print(f"no table: {error}\nlog: {log_path}", file=sys.stderr)
        return
    if report is not None:
        from companion.analysis.report import write_flight_report

        written = report
        if not told_report(lambda: write_flight_report(record, metrics, tracking, written)):
            report = None
    if as_json:
        body = {**metrics.to_json(), "text": text, "log": str(log_path)}
        if report is not None:
            body["report"] = str(report)
        print(json.dumps(body, indent=2, ensure_ascii=False, allow_nan=False))
        return
    from rich.console import Console

    console = Console()
    console.print(flight_table(metrics))
    console.print(f"log:    {log_path}", soft_wrap=True, highlight=False)
    if report is not None:
        console.print(f"report: {report}", soft_wrap=True, highlight=False)
