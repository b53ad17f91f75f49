"""`companion tune`: search gains for a controller at a level of a profile, on the stub's vehicle, in compiled code."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.config.errors import UserError

if TYPE_CHECKING:
    from companion.tuning.objective import Flown
    from companion.tuning.session import Progress, Tuned

EXAMPLE = """examples:
  companion tune --controller dtlannc --level attitude
  companion tune --profile my_drone.toml --autopilot ardupilot --budget 300 --write my_drone.toml
  companion tune --level actuator --only-verify          how the profile's gains stand up, no search

The search starts from the same gentle gains for every law, or with --from-profile from the profile's.
Ctrl-C ends it with the best so far; with --save FILE a later call goes on from there. Cost 1 is about the
report's DTLANNC; see docs/tuning.md. Exit code 2: wrong input.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "tune",
        help="search gains for a profile",
        description=__doc__,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--profile", default="qball2", metavar="NAME|FILE", help="vehicle profile (TOML)")
    parser.add_argument("--controller", default="dtlannc", metavar="NAME", help="dtlannc, tlmbc, nnsmc")
    parser.add_argument("--level", default="attitude", choices=("attitude", "body_rate", "actuator"))
    parser.add_argument(
        "--autopilot", default="px4", choices=("px4", "ardupilot"), help="whose response counts"
    )
    parser.add_argument(
        "--plant",
        choices=("stub", "lagged"),
        help="PX4's loops on the stub's physics with the profile's mass, inertia and rotors, or the profile's responses "
        "(no torque level); by default stub for a shipped profile, responses for one of your own",
    )
    parser.add_argument(
        "--estimator", default="mocap", choices=("mocap", "gps", "perfect", "sih_mocap"), help="its noise"
    )
    parser.add_argument(
        "--delay",
        type=float,
        default=0.0,
        metavar="S",
        help="dead time of the link, s, on top of the plant's",
    )
    parser.add_argument("--trajectory", default="lemniscate", metavar="NAME|FILE", help="what is flown")
    parser.add_argument(
        "--budget", type=int, default=400, metavar="N", help="sets of gains to fly (default 400)"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the search (default 1)")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help="change the profile"
    )
    parser.add_argument(
        "--from-profile",
        action="store_true",
        help="start from the profile's gains, not from the standard ones",
    )
    parser.add_argument("--save", metavar="FILE", help="keep the best so far here, and go on from it")
    parser.add_argument(
        "--write", metavar="FILE", help="put the gains into this profile (TOML), marked [tuned]"
    )
    parser.add_argument("--only-verify", action="store_true", help="no search: fly the profile's gains")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Search, verify, print. Raises UserError for wrong input."""
    if arguments.budget < 1 or arguments.seed < 0 or not 0.0 <= arguments.delay <= 0.5:
        raise UserError("--budget must be 1 or more, --seed not negative, --delay between 0 and 0.5 s")
    from companion.config.settings import load_profile, select_gains
    from companion.control.laws import LAWS
    from companion.tuning.flight import STUB_VEHICLES, PlantChoice
    from companion.tuning.objective import Objective
    from companion.tuning.session import Tuning

    profile = load_profile(arguments.profile, arguments.overrides)
    start = select_gains(profile, arguments.controller, arguments.level)
    if arguments.controller not in LAWS:
        raise UserError(f"there is no controller {arguments.controller!r}; there are {', '.join(LAWS)}")
    if arguments.plant is None:
        shipped = profile.name in STUB_VEHICLES or arguments.level == "actuator"
        arguments.plant = "stub" if shipped else "lagged"
    told = "PX4's loops on its mass, inertia and rotors" if arguments.plant == "stub" else "its responses"
    print(f"what is flown is profile {profile.name!r}: {told}, {profile.mass_kg:g} kg", file=sys.stderr)
    plant = PlantChoice(arguments.plant, arguments.estimator, arguments.delay)
    objective = Objective(
        profile,
        arguments.autopilot,
        arguments.controller,
        arguments.level,
        plant,
        arguments.trajectory,
    )
    tuned: Tuned | None = None
    gains = start
    if not arguments.only_verify:
        save = Path(arguments.save) if arguments.save else None
        tuning = Tuning(
            profile,
            arguments.controller,
            arguments.level,
            objective,
            start,
            arguments.seed,
            save,
            arguments.from_profile,
        )
        print(
            f"{len(tuning.space)} numbers, {arguments.budget} sets of gains; compiling ...", file=sys.stderr
        )
        tuned = tuning.run(arguments.budget, _report)
        gains = tuned.gains
        if tuned.stopped:
            print("stopped, verifying the best so far; Ctrl-C again ends without it", file=sys.stderr)
    flown = list(objective.verify(gains))
    _show(arguments, tuned, gains, flown)
    if arguments.write and tuned is not None:
        from companion.tuning.profile_file import put_gains

        put_gains(
            Path(arguments.write),
            arguments.controller,
            arguments.level,
            gains,
            f"[tuned] {_command(arguments)}",
        )
        print(f"written to {arguments.write}", file=sys.stderr)
    return 0


def _command(arguments: argparse.Namespace) -> str:
    """The call that finds these gains again from the same start."""
    words = ["companion", "tune"]
    defaults = {"plant": "stub", "autopilot": "px4", "estimator": "mocap", "trajectory": "lemniscate"}
    for name in ("profile", "controller", "level", "autopilot", "plant", "estimator", "trajectory"):
        value = getattr(arguments, name)
        if value != defaults.get(name):
            words += [f"--{name}", Path(value).name if name == "profile" else value]
    if arguments.delay:
        words += ["--delay", f"{arguments.delay:g}"]
    if arguments.from_profile:
        words.append("--from-profile")
    for override in arguments.overrides:
        words += ["--set", override]
    return shlex.join([*words, "--budget", str(arguments.budget), "--seed", str(arguments.seed)])


def _report(progress: Progress) -> None:
    left = progress.elapsed_s / progress.evaluations * max(0, progress.budget - progress.evaluations)
    print(
        f"{progress.evaluations:5d} of {progress.budget}: best {progress.best_cost:.4f} "
        f"(start {progress.start_cost:.4f}), {left:.0f} s left",
        file=sys.stderr,
    )


def _show(arguments: argparse.Namespace, tuned: Tuned | None, gains: Any, flown: list[Flown]) -> None:
    rows = [
        {
            "flight": one.scenario.name,
            "position_rms_m": one.outcome.position_rms_m.tolist(),
            "attitude_rms_deg": (one.outcome.attitude_rms_rad * 57.29577951308232).tolist(),
            "shake_rms_rad_s": one.outcome.shake_rms_rad_s.tolist(),
            "hold_rms_m": one.outcome.hold_rms_m.tolist(),
            "flown": one.outcome.flown,
        }
        for one in flown
    ]
    if arguments.json:
        body: dict[str, Any] = {"command": _command(arguments), "gains": gains.model_dump(mode="json")}
        if tuned is not None:
            body |= {
                "cost": tuned.cost,
                "start_cost": tuned.start_cost,
                "evaluations": tuned.evaluations,
                "flights": tuned.flights,
                "elapsed_s": tuned.elapsed_s,
                "stopped": tuned.stopped,
            }
        print(json.dumps(body | {"verification": rows}, indent=1, ensure_ascii=False))
        return
    from rich.console import Console
    from rich.table import Table

    from companion.tuning.profile_file import gains_text

    print(gains_text(arguments.controller, arguments.level, gains, f"[tuned] {_command(arguments)}"))
    table = Table(
        "flight", "e_x [m]", "e_y [m]", "e_z [m]", "e_φ [°]", "e_θ [°]", "shake [rad/s]", "hold [m]"
    )
    for row in rows:
        lost = "" if row["flown"] == 1.0 else f" lost at {100 * row['flown']:.0f} %"
        table.add_row(
            row["flight"] + lost,
            *(f"{value:.4f}" for value in row["position_rms_m"]),
            *(f"{value:.2f}" for value in row["attitude_rms_deg"][:2]),
            f"{max(row['shake_rms_rad_s']):.3f}",
            f"{max(row['hold_rms_m']):.4f}",
        )
    Console().print(table)
