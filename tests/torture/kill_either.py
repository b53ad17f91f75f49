"""Kill the companion or the stub at seeded moments of a flight: the other one has to end safely and in words.

examples:
  ./scripts/kill_either                                            ten moments each, in lockstep and in real time
  ./scripts/kill_either --victim stub --clock lockstep --count 5 --seed 7 --json
  ./scripts/kill_either --victim companion --count 1 --seed 12     repeat one moment

A moment is a phase of the flight and a wait after it was announced. Asked for are: from the companion a last line that
says what happened, its exit code, and a whole log that says the same; from the stub the vehicle on the ground, disarmed
(PX4's offboard loss), and a log of the dead companion that can be read. The exit code is 1 where that is not so.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "flight"))
sys.path.insert(0, str(Path(__file__).parents[2]))

from stub_flights import STUB_FREE_SPEED, companion_process, kill

from companion.config.errors import UserError
from companion.flight.phases import Phase
from companion.flightlog.reader import read_log
from sitl_stub.stub_process import Stub

VICTIMS, CLOCKS = ("companion", "stub"), ("lockstep", "real-time")
PHASES = tuple(
    phase
    for phase in Phase
    if phase not in (Phase.CONNECT, Phase.WATCH, Phase.DONE, Phase.ENGAGE, Phase.PROVE)
)
"""Those that last; the others are over before anybody could be killed in them."""
LONGEST_DESCENT_S = 90.0
SHORT = ("flight.duration_s=3", "flight.procedure.hold_s=1", "flight.takeoff_height_m=1.0")


@dataclass(frozen=True)
class Case:
    """One kill."""

    victim: str
    clock: str
    firmware: str
    phase: str
    wait_s: float


def drawn(victim: str, clock: str, firmware: str, seed: int) -> Case:
    """The moment of a seed."""
    rng = random.Random(f"{victim} {clock} {firmware} {seed}")
    return Case(
        victim,
        clock,
        firmware,
        rng.choice(PHASES).value,
        rng.uniform(0.0, 0.3 if clock == "lockstep" else 1.5),
    )


def tried(case: Case, folder: Path) -> list[str]:
    """Fly, kill, look; what was not as it should be."""
    lockstep = case.clock == "lockstep"
    stub = Stub(
        case.firmware,
        seed=1,
        lockstep=lockstep,
        speed=STUB_FREE_SPEED if lockstep else 1.0,
        exit_on_disarm=case.victim == "companion",
        arguments=("--param", "COM_DISARM_PRFLT=5") if case.firmware.startswith("px4") else (),
    )
    log = folder / "flight.mcap"
    log.unlink(missing_ok=True)
    with stub:
        words = ["fly", "--endpoint", stub.endpoint, "--log", str(log)]
        for setting in SHORT:
            words += ["--set", setting]
        with companion_process(words, folder) as companion:
            companion.until_said(f"[{case.phase}]")
            try:
                companion.process.wait(case.wait_s)
                return ["the flight was over before the kill"]
            except subprocess.TimeoutExpired:
                pass
            if case.victim == "stub":
                kill(stub)
                code, _ = companion.end()
                return _companions_end(code, companion.lines, log)
            companion.process.kill()
            companion.process.wait()
        return _stubs_end(stub, log)


def _companions_end(code: int, lines: list[str], log: Path) -> list[str]:
    wrong = []
    last = next((line for line in reversed(lines) if line.strip()), "")
    if code not in (1, 2) or "Traceback" in "\n".join(lines):
        wrong.append(f"exit code {code}: {last}")
    if not any("nothing heard from the autopilot" in line or "no autopilot within" in line for line in lines):
        wrong.append(f"the silence is not named: {last}")
    record = read_log(log)
    ended = record.events_of("ended")
    if record.cut or not ended or ended[-1].fields["outcome"] not in ("link lost", "refused"):
        wrong.append(f"log: cut {record.cut!r}, ended {[event.fields.get('outcome') for event in ended]}")
    return wrong


def _stubs_end(stub: Stub, log: Path) -> list[str]:
    try:
        record = read_log(log)
        armed = any(event.fields["armed"] for event in record.events_of("armed"))
        wrong = [] if record.cut else ["the dead companion's log claims to be whole"]
    except UserError as error:
        armed, wrong = (
            False,
            [] if "holds nothing" in str(error) or "is empty" in str(error) else [str(error)],
        )
    try:
        code = stub.wait(LONGEST_DESCENT_S if armed else 5.0)
        if code != 0:
            wrong.append(f"the stub's exit code is {code}")
    except subprocess.TimeoutExpired:
        if armed:
            wrong.append(f"still armed {LONGEST_DESCENT_S:.0f} s later")
        assert stub.process is not None
        stub.process.terminate()
        if stub.wait(60.0) != 0 or stub.summary is None:
            wrong.append("the stub did not end in words when asked to")
    return wrong


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="scripts/kill_either", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--victim", choices=VICTIMS, help="default: both, in turn")
    parser.add_argument("--clock", choices=CLOCKS, help="default: both, in turn")
    parser.add_argument(
        "--firmware", choices=("px4", "ardupilot"), default="px4", help="default: %(default)s"
    )
    parser.add_argument("--count", type=int, default=10, help="moments of each kind (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="the first moment's (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    victims = [options.victim] if options.victim else list(VICTIMS)
    if options.firmware == "ardupilot" and "companion" in victims:
        parser.error(
            "ArduPilot holds its place when a companion dies (docs/autopilots.md); give --victim stub with it"
        )
    results = []
    with tempfile.TemporaryDirectory() as name:
        for victim in victims:
            for clock in [options.clock] if options.clock else CLOCKS:
                for seed in range(options.seed, options.seed + options.count):
                    case = drawn(victim, clock, options.firmware, seed)
                    wrong = tried(case, Path(name))
                    results.append({**asdict(case), "seed": seed, "wrong": wrong})
                    said = "; ".join(wrong) or "as it should be"
                    print(
                        f"{victim:9} {clock:9} seed {seed:3}  {case.phase} + {case.wait_s:.2f} s: {said}",
                        file=sys.stderr,
                    )
    failures = [result for result in results if result["wrong"]]
    if options.json:
        print(json.dumps(results, indent=2))
    else:
        print(f"{len(results) - len(failures)} of {len(results)} kills ended as they should")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
