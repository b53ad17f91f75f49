"""`companion adopt`: a short flight, or the log of any earlier one, becomes the vehicle's profile."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.config.errors import UserError

if TYPE_CHECKING:
    from companion.analysis.adoption import Adopted

EPILOG = """examples:
  companion adopt --endpoint /dev/ttyACM0,921600 --dry-run         how much room and time it takes
  companion adopt --endpoint /dev/ttyACM0,921600 --write my_drone.toml
  companion adopt flights/flight.mcap --write my_drone.toml        from an earlier flight, nothing is flown
  companion adopt --sitl px4 --sitl-options "--vehicle random:7"   the bundled stub

It hovers, makes small steps forward, to the left, up and in heading, and lands; the supervisor watches as in every flight.
With --verify the lemniscate is flown before and after. Ctrl-C lands and keeps what is known by then.
Exit codes as `companion fly`; 2 where the log tells no response.
"""
MARGIN_M = 1.0
"""Room beyond the steps, on every side."""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    from companion.cli.fly import add_flight_options

    parser = subparsers.add_parser(
        "adopt",
        help="a short flight, or a log, becomes a profile",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "log", nargs="?", metavar="LOG", help="an earlier flight's MCAP file: nothing is flown"
    )
    add_flight_options(parser, required=False)
    parser.add_argument(
        "--size", type=float, default=0.5, metavar="M", help="of the steps (default 0.5, up to 0.7)"
    )
    parser.add_argument("--write", metavar="FILE", help="where the profile goes; an existing file is kept")
    parser.add_argument("--verify", action="store_true", help="fly 16 s of the lemniscate before and after")
    parser.add_argument("--dry-run", action="store_true", help="say what it would do, and do nothing")
    parser.add_argument(
        "--seed", type=int, default=1, metavar="N", help="of the networks, and the stub's noise"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(controller="dtlannc")


def run(arguments: argparse.Namespace) -> int:
    """Fly where no log is given, print, write. Raises UserError for wrong input, and a log that tells nothing."""
    flies = arguments.endpoint is not None or arguments.sitl is not None
    if (arguments.log is None) != flies:
        raise UserError("adopt: give either a LOG, or where to fly: --endpoint ADDRESS or --sitl px4")
    if arguments.level != "attitude":
        raise UserError("adopt flies at level attitude: leave --level out")
    if arguments.write and Path(arguments.write).exists():
        raise UserError(f"--write {arguments.write}: is there already; choose another name")
    from companion.analysis.adoption import adopted
    from companion.flightlog.reader import read_log

    code, log = 0, arguments.log
    if flies:
        steps = f"steps,size_m={arguments.size:g}"
        if arguments.dry_run:
            print(_room(steps, arguments.size, arguments.verify))
            return 0
        before_m = _flown_m(arguments, "lemniscate", 16.0, arguments.profile)[1] if arguments.verify else None
        code, _, log = _flight(arguments, steps, 3600.0, arguments.profile)
    record = read_log(log)
    found = adopted(record)
    source = Path(log).name
    if not arguments.json:
        _show(found)
    text = found.profile_text(_margin(found), source)
    if arguments.write:
        try:
            Path(arguments.write).write_text(text, encoding="utf-8")
        except OSError as error:
            raise UserError(f"--write {arguments.write}: {error.strerror}") from None
    verified = {}
    if flies and arguments.verify and code == 0 and arguments.write:
        code, after_m = _flown_m(arguments, "lemniscate", 16.0, arguments.write)
        verified = {"before_rms_m": before_m, "after_rms_m": after_m}
    if arguments.json:
        print(json.dumps(_as_json(found) | {"profile": text, "log": str(log)} | verified, indent=2))
        return code
    print(text)
    if verified:
        print(
            f"lemniscate, 3D RMS in the estimate: {before_m:.3f} m before, {after_m:.3f} m with the profile"
        )
    return code


def _room(steps: str, size_m: float, verify: bool) -> str:
    from companion.reference.registry import trajectory_from_text

    trajectory = trajectory_from_text(steps)
    height = float(trajectory.sample(0.0).position_enu[2])
    room = size_m + MARGIN_M
    lines = [
        f"takes off, hovers {height:g} m above the ground, steps {size_m:g} m forward, to the left, {0.6 * size_m:g} m "
        f"up and 29° in heading, each there and back, twice; {trajectory.duration_s:.0f} s and half a minute on the way",
        f"needs {room:g} m of room on every side and {height + 0.6 * size_m + MARGIN_M:g} m of height; the supervisor "
        "watches, Ctrl-C lands",
    ]
    if verify:
        lines.append(
            "then flies 16 s of the lemniscate, 1 m by 2 m, before and after: 2 m of room on every side"
        )
    return "\n".join(lines)


def _flight(
    arguments: argparse.Namespace, trajectory: str, duration_s: float, profile: str | None
) -> tuple[int, str, Path]:
    """Fly once; exit code, last word, log."""
    from companion.cli.fly import fly_once, log_path_of

    values = vars(arguments) | {"trajectory": trajectory, "duration": duration_s, "profile": profile}
    if arguments.sitl and profile is None:  # what is adopted is the stub's vehicle, of which nothing is known
        values["sitl_options"] = (
            arguments.sitl_options
            if "--veh" in arguments.sitl_options
            else (
                f"{arguments.sitl_options} --vehicle {'arducopter' if arguments.sitl == 'ardupilot' else 'qball2'}"
            )
        )
    flight = argparse.Namespace(**values)
    log, _ = log_path_of(flight, None)
    _, text, code = fly_once(flight, "dtlannc", arguments.seed, log, True)
    return code, text, log


def _flown_m(
    arguments: argparse.Namespace, trajectory: str, duration_s: float, profile: str | None
) -> tuple[int, float]:
    """Fly once; exit code, and 3D RMS in the estimate, m; NaN where it did not track."""
    from companion.analysis.metrics import flight_metrics
    from companion.flightlog.reader import read_log

    code, text, log = _flight(arguments, trajectory, duration_s, profile)
    if code:
        raise UserError(
            f"adopt: the lemniscate was not flown ({text}); fly without --verify, or look at {log}"
        )
    errors = flight_metrics(read_log(log))[0].get("rms", "position_estimate_m")
    return code, math.hypot(*errors) if errors is not None else math.nan


def _margin(found: Adopted) -> float:
    """The least lag margin that stands half as much gain and lag again; said where none does."""
    from companion.config.profile import SecondOrder
    from companion.config.settings import load_profile
    from companion.tuning.margins import LAG_MARGINS, least_lag_margin

    if found.tilt is None:
        return LAG_MARGINS[-1]  # nothing is written then
    dead_s, omega, zeta = found.tilt
    profile = load_profile(None)
    tilt = SecondOrder(natural_frequency_rad_s=omega, damping=zeta)
    response = profile.response(found.autopilot).model_copy(update={"dead_time_s": dead_s, "tilt": tilt})
    profile = profile.model_copy(update={"responses": {found.autopilot: response}})
    print("choosing gains: flying half as much gain and lag again, compiled ...", file=sys.stderr)
    margin = least_lag_margin(profile, found.autopilot)
    if margin is None:
        print(
            f"no gains stand half as much lag again: the slowest are taken, {LAG_MARGINS[-1]:g}",
            file=sys.stderr,
        )
    return margin if margin is not None else LAG_MARGINS[-1]


def _show(found: Adopted) -> None:
    for axis in found.axes:
        print(
            f"{axis.axis}: dead time {1e3 * axis.dead_time_s:.0f} ± {1e3 * axis.spread[0]:.0f} ms, "
            f"ω {axis.natural_frequency_rad_s:.1f} ± {axis.spread[1]:.1f} rad/s, "
            f"ζ {axis.damping:.2f} ± {axis.spread[2]:.2f} ({100 * axis.explained:.0f} % explained)"
        )
    if found.drag is not None:
        print(
            f"drag: {found.drag[0]:.2f} ± {found.drag[1]:.2f} m/s² for each m/s (measured anew in each flight)"
        )
    if found.hover is not None:
        print(f"hover thrust: {found.hover[0]:.3f} ± {found.hover[1]:.3f}")
    for line in found.unknown:
        print(f"not determined: {line}")


def _as_json(found: Adopted) -> dict[str, Any]:
    return {
        "autopilot": found.autopilot,
        "axes": [
            {
                "axis": axis.axis,
                "dead_time_s": axis.dead_time_s,
                "natural_frequency_rad_s": axis.natural_frequency_rad_s,
                "damping": axis.damping,
                "deviation": list(axis.spread),
            }
            for axis in found.axes
        ],
        "drag_1_s": found.drag,
        "hover_thrust": found.hover,
        "not_determined": list(found.unknown),
    }
