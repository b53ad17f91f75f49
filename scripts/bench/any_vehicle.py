"""Vehicles that nobody has written a profile for: `companion fly` as it comes, beside their autopilot's own controller.

    python scripts/bench/any_vehicle.py                          12 vehicles of each firmware, some minutes
    python scripts/bench/any_vehicle.py --vehicles 40 --jobs 2 --json

Each is `random:SEED` of the stub, flown in lockstep with motion capture over UDP: once without a profile (nothing is known
but what the autopilot's parameters tell, not the mass either), once by the same stub's position controller, which is sent
position, velocity and acceleration of the same reference. Judged is the distance from the reference in the autopilot's
estimate, RMS over three axes while tracking. Seeds from 1000 on have been in no search. `--profiles FOLDER` flies
the profiles of that folder (`px4-1000.toml`, as `companion adopt` writes them) where there is one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import multiprocessing
import os
import statistics
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from unittest import mock

from companion.analysis.metrics import flight_metrics
from companion.config.errors import UserError
from companion.config.settings import load_settings
from companion.control.structs import Reference, VehicleState
from companion.flight import control_loop, session
from companion.flight.reporter import Reporter
from companion.flight.session import SessionOptions
from companion.flight.setpoint_sender import SetpointSender
from companion.flightlog.reader import read_log
from companion.mavlink.connection import Connection
from companion.mavlink.endpoint import parse_endpoint
from companion.mavlink.frames import ned_from_enu, yaw_ned_from_enu
from companion.mavlink.link import Message, mav
from sitl_stub import Stub

NO_YAW_RATE = 0b1000_0000_0000
"""Type mask of SET_POSITION_TARGET_LOCAL_NED: all but the yaw rate counts."""
QUIET = ["flight.procedure.connect_timeout_s=300", "flight.safety.stall_s=30"]
"""On a busy machine a lockstep flight may go like a clock by chance, and then stand still for longer than in the air."""
LADDERS = {
    "attitude_error_deg": ("warn", "freeze", "hold", "land"),
    "position_error_m": ("warn", "non_adaptive", "hold"),
    "velocity_error_m_s": ("warn", "non_adaptive", "hold", "land"),
    "thrust_margin": ("warn", "freeze", "hold", "land"),
    "ground_support": ("warn", "land"),
}
OWN = [
    *QUIET,
    *(f"flight.safety.{name}.{rung}=off" for name, rungs in LADDERS.items() for rung in rungs),
    "flight.safety.position_error_m.land=[10, 1]",
]
"""The autopilot's own controller may be as far off as it is, and what the law would have asked for is not what flies."""
FIRMWARES = ("px4", "ardupilot")
LOG = "flight.mcap"


class OwnSender(SetpointSender):
    """Sends the reference itself, once there is one: the law's setpoints stay at home."""

    reference: Reference | None = None

    def _post(self, time_s: float, message: Message, *rest: Any) -> None:
        if (reference := self.reference) is not None:
            message = mav.MAVLink_set_position_target_local_ned_message(
                0, message.target_system, 1, mav.MAV_FRAME_LOCAL_NED, NO_YAW_RATE,
                *ned_from_enu(reference.position_enu),
                *ned_from_enu(reference.velocity_enu),
                *ned_from_enu(reference.acceleration_enu),
                yaw_ned_from_enu(reference.yaw_rad), 0.0,
            )  # fmt: skip
        super()._post(time_s, message, *rest)


class OwnLoop(control_loop.ControlLoop):
    """Hands the autopilot's own controller each state's reference."""

    def _follow(self, state: VehicleState, gap_s: float, age_s: float) -> float:
        assert isinstance(self._sender, OwnSender)
        self._sender.reference = self._sample(state.time_s)
        return super()._follow(state, gap_s, age_s)

    def level(self) -> None:
        assert isinstance(self._sender, OwnSender)
        self._sender.reference = None
        super().level()


class Silent(Reporter):
    """Keeps what was said, for a flight that went wrong."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str) -> None:
        self.said.append(text)


def one_flight(
    firmware: str, seed: int, profile: str | None, own: bool, options: argparse.Namespace, folder: Path
) -> dict[str, Any]:
    """Fly once; 3D RMS in the estimate, m, and how it ended."""
    settings = load_settings(
        profile,
        {
            "duration_s": options.duration,
            "seed": seed,
            "level": options.level,
            "trajectory": options.trajectory,
        },
        (OWN if own else QUIET) + options.overrides,
    )
    log, reporter = folder / LOG, Silent()
    with contextlib.ExitStack() as stack:
        if own:
            stack.enter_context(mock.patch.object(session, "ControlLoop", OwnLoop))
            stack.enter_context(mock.patch.object(control_loop, "SetpointSender", OwnSender))
        stub = stack.enter_context(
            Stub(
                firmware, f"random:{seed}", seed=seed, lockstep=True, ready_after_s=2.0, ready_timeout_s=120.0
            )
        )
        link = Connection(parse_endpoint(stub.endpoint))
        flight = SessionOptions(link, log, overwrite=True, fix=True, real_time=False)
        result = session.fly(settings, flight, reporter)
    if result.outcome.exit_code:
        return {"rms_m": math.nan, "ended": result.text, "said": reporter.said}
    metrics, _ = flight_metrics(read_log(log))
    errors = metrics.get("rms", "position_estimate_m")
    assert errors is not None
    return {"rms_m": math.hypot(*errors), "axes_m": errors, "reactions_s": metrics.reactions_s, "ended": ""}


def one_vehicle(task: tuple[str, int, argparse.Namespace]) -> dict[str, Any]:
    """Both flights of a vehicle."""
    firmware, seed, options = task
    out: dict[str, Any] = {"firmware": firmware, "seed": seed, **about(seed)}
    with tempfile.TemporaryDirectory() as name:
        own = one_flight(firmware, seed, None, True, options, Path(name))
        profile = Path(options.profiles or "") / f"{firmware}-{seed}.toml"
        known = str(profile) if options.profiles and profile.exists() else None
        try:
            ours = one_flight(firmware, seed, known, False, options, Path(name))
        except UserError as error:
            ours = {"rms_m": math.nan, "ended": str(error)}
        if options.logs:
            Path(options.logs).mkdir(parents=True, exist_ok=True)
            (Path(name) / LOG).replace(Path(options.logs) / f"{firmware}-{seed}.mcap")
    out |= {"own_m": own["rms_m"], "ours_m": ours["rms_m"], "ratio": own["rms_m"] / ours["rms_m"]}
    out |= {"axes_m": ours.get("axes_m"), "reactions_s": ours.get("reactions_s"), "profile": known}
    return out | {"ended": ours["ended"], "own_ended": own["ended"]}


def about(seed: int) -> dict[str, Any]:
    """What the stub drew, for the table."""
    from sitl_stub.physics.random_vehicle import random_vehicle

    drawn = random_vehicle(seed)
    return {
        "mass_kg": drawn.mass_kg,
        "rotors": len(drawn.rotor_spin),
        "motor_lag_s": 1.0 / drawn.rotor_lag_rad_s,
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Worst, median and lost of a firmware's rows; ratios where both flights ended well."""
    ratios = [row["ratio"] for row in rows if math.isfinite(row["ratio"])]
    return {
        "vehicles": len(rows),
        "lost": sum(bool(row["ended"]) for row in rows),
        "own_lost": sum(bool(row["own_ended"]) for row in rows),
        "median": statistics.median(ratios or [math.nan]),
        "worst": min(ratios, default=math.nan),
        "below_2_5": sum(ratio < 2.5 for ratio in ratios),
        "ours_median_m": statistics.median(
            [r["ours_m"] for r in rows if math.isfinite(r["ours_m"])] or [math.nan]
        ),
    }


def as_line(row: dict[str, Any]) -> str:
    """One row of the table."""
    ended = row["ended"] or (f"own: {row['own_ended']}" if row["own_ended"] else "")
    return (
        f"{row['firmware']:9} {row['seed']:6d} {row['mass_kg']:7.2f} {row['rotors']:6d} {row['motor_lag_s']:9.3f}"
        f" {row['own_m']:8.3f} {row['ours_m']:8.3f} {row['ratio']:6.1f}  {ended}"
    )


def flown(tasks: list[tuple[str, int, argparse.Namespace]], jobs: int) -> Iterable[dict[str, Any]]:
    """Rows as they come."""
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        yield from pool.imap_unordered(one_vehicle, tasks)


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--firmware", choices=FIRMWARES, help="this one only")
    parser.add_argument("--vehicles", type=int, default=12, metavar="N", help="of each firmware (default 12)")
    parser.add_argument("--first", type=int, default=1000, metavar="SEED", help="first seed (default 1000)")
    parser.add_argument("--level", default="attitude", choices=("attitude", "body_rate"))
    parser.add_argument("--trajectory", default="lemniscate", metavar="NAME")
    parser.add_argument(
        "--duration", type=float, default=16.0, metavar="S", help="of tracking (default 16: two rounds)"
    )
    parser.add_argument(
        "--profiles", metavar="FOLDER", help="profiles by firmware and seed, where there are any"
    )
    parser.add_argument("--logs", metavar="FOLDER", help="keep our flights' logs there")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="flights at once")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    firmwares = [options.firmware] if options.firmware else FIRMWARES
    tasks = [
        (firmware, options.first + i, options) for firmware in firmwares for i in range(options.vehicles)
    ]
    rows: list[dict[str, Any]] = []
    for row in flown(tasks, options.jobs):
        rows.append(row)
        print(f"{len(rows)}/{len(tasks)}  {as_line(row)}", file=sys.stderr, flush=True)
    rows.sort(key=lambda row: (row["firmware"], row["seed"]))
    totals = {name: summary([row for row in rows if row["firmware"] == name]) for name in firmwares}
    if options.json:
        print(json.dumps({"vehicles": rows, "summary": totals}))
        return
    print("firmware    seed mass kg rotors motor lag    own m   ours m  times")
    for row in rows:
        print(as_line(row))
    for name, total in totals.items():
        print(f"{name}: " + ", ".join(f"{what} {value:.3g}" for what, value in total.items()))


if __name__ == "__main__":
    main()
