"""Coverage-guided fuzzing (atheris, libFuzzer) of every edge where somebody else's bytes come in.

examples:
  ./scripts/fuzz --list                        what there is
  ./scripts/fuzz companion-link --seconds 300  one target for five minutes
  ./scripts/fuzz all --seconds 60 --json       every target, one after the other
  ./scripts/fuzz all --seconds 60 --plain      seeded mutations without guidance, where atheris has no wheel
  ./scripts/fuzz companion-link --repeat FILE  run one found input again

Each target may drop and count what it is given or raise the error that is documented for the user; anything else
raised, more than a second of one input, and a state that cannot be true are finds. Found inputs are kept under
--corpus and belong into tests/fuzz/found/TARGET/ once they are mended. The exit code is 1 when something was found.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import importlib.util
import json
import random
import re
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

HERE = Path(__file__).parent
PROJECT = HERE.parent.parent
sys.path[:0] = [str(HERE), str(PROJECT)]

LONGEST_INPUT_S = 1.0  # of processor time: a busy machine is no find
LARGEST_INPUT = 4096
Take = Callable[[bytes], None]


@dataclasses.dataclass(frozen=True)
class Target:
    """One edge: `take` makes what eats an input, `seeds` what a conversation looks like."""

    module: str
    take: str
    seeds: str
    argument: tuple[str, ...]
    instrumented: tuple[str, ...]
    """Packages whose branches guide the search."""

    def prepare(self) -> tuple[Take, list[bytes]]:
        """Import, make and warm up."""
        module = importlib.import_module(self.module)
        take, seeds = getattr(module, self.take)(*self.argument), getattr(module, self.seeds)()
        for seed in seeds:
            take(seed)  # compiles what has to be compiled, and shows that the seeds are good
        return partial(_timed, take), seeds


EDGE = ("companion.mavlink", "companion.autopilot", "companion.flight.vehicle")
STUB = ("sitl_stub.mavlink", "sitl_stub.firmware")
TARGETS = {
    "companion-link": Target("wire_targets", "companion_link", "companion_seeds", (), EDGE),
    "stub-px4": Target("wire_targets", "stub", "stub_seeds", ("px4",), STUB),
    "stub-ardupilot": Target("wire_targets", "stub", "stub_seeds", ("ardupilot",), STUB),
    "poses": Target("wire_targets", "poses", "pose_seeds", (), ("companion.mavlink",)),
    "configuration": Target(
        "file_targets", "configuration", "configuration_seeds", (), ("companion.config",)
    ),
    "trajectories": Target("file_targets", "trajectories", "trajectory_seeds", (), ("companion.reference",)),
    "scenarios": Target("file_targets", "scenarios", "scenario_seeds", (), ("sitl_stub.faults",)),
    "logs": Target("file_targets", "logs", "log_seeds", (), ("companion.flightlog", "mcap")),
}


def _timed(take: Take, data: bytes) -> None:
    started_s = time.thread_time()
    take(data)
    spent_s = time.thread_time() - started_s
    assert spent_s < LONGEST_INPUT_S, f"{spent_s:.1f} s of processor time for {len(data)} bytes"


def mutated(rng: random.Random, seeds: list[bytes]) -> bytes:
    """A seed with some bytes changed, cut out, doubled or taken from another seed."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        at = rng.randrange(len(data) + 1)
        kind = rng.randrange(5)
        if kind == 0 and at < len(data):
            data[at] = rng.choice(
                (0, 1, 127, 128, 254, 255, rng.randrange(256), data[at] ^ 1 << rng.randrange(8))
            )
        elif kind == 1:
            del data[at : at + rng.choice((1, 2, 4, 8, 64))]
        elif kind == 2:
            data[at:at] = data[at : at + rng.randrange(1, 33)]
        elif kind == 3:
            other = rng.choice(seeds)
            start = rng.randrange(len(other) + 1)
            data[at : at + 8] = other[start : start + rng.randrange(1, 65)]
        else:
            data[at : at + 4] = rng.randbytes(4)
    return bytes(data[:LARGEST_INPUT])


def _compiled_modules(packages: tuple[str, ...]) -> list[str]:
    """Modules with functions for numba, which cannot compile instrumented ones."""
    found = []
    for package in packages:
        place = PROJECT.joinpath(*package.split("."))
        for source in place.rglob("*.py"):
            if re.search(r"^@compiled", source.read_text(), re.MULTILINE):
                found.append(".".join(source.relative_to(PROJECT).with_suffix("").parts))
    return sorted(set(found))


def guided(target: Target, seconds: int, seed: int, corpus: Path) -> None:
    """Run libFuzzer in this process; it does not return."""
    import atheris

    for name in _compiled_modules(target.instrumented):
        importlib.import_module(name)
    programs = tuple({package.split(".")[0] for package in target.instrumented})
    with atheris.instrument_imports(
        include=list(target.instrumented), exclude=_compiled_modules((*programs, *target.instrumented))
    ):
        take, seeds = target.prepare()
    for index, data in enumerate(seeds):
        (corpus / f"seed-{index:03d}").write_bytes(data)
    atheris.Setup(
        [
            "fuzz",
            str(corpus),
            f"-max_total_time={seconds}",
            f"-seed={seed}",
            f"-max_len={LARGEST_INPUT}",
            "-timeout=60",
            "-rss_limit_mb=4096",
            f"-artifact_prefix={corpus.parent}/found-{corpus.name}-",
            "-print_final_stats=1",
        ],
        take,
    )
    atheris.Fuzz()


def plain(target: Target, seconds: float, seed: int, corpus: Path) -> None:
    """Seeded mutations without guidance, in this process."""
    take, seeds = target.prepare()
    rng, count, until_s = random.Random(seed), 0, time.monotonic() + seconds
    while time.monotonic() < until_s:
        data, count = mutated(rng, seeds), count + 1
        try:
            take(data)
        except Exception:
            (corpus.parent / f"found-{corpus.name}-{seed}-{count}").write_bytes(data)
            print(f"stat::number_of_executed_units: {count}", file=sys.stderr)
            raise
    print(f"stat::number_of_executed_units: {count}", file=sys.stderr)


def run(name: str, seconds: int, seed: int, folder: Path, without_guidance: bool) -> dict[str, object]:
    """Fuzz one target in a process of its own; what came of it. A find ends it: mend it and go on."""
    (folder / name).mkdir(parents=True, exist_ok=True)
    before = set(folder.glob(f"found-{name}-*"))
    words = [sys.executable, __file__, name, "--here", "--seconds", str(seconds), "--seed", str(seed)]
    words += ["--corpus", str(folder), *(["--plain"] if without_guidance else [])]
    started_s = time.monotonic()
    process = subprocess.Popen(
        words, stderr=subprocess.STDOUT, stdout=subprocess.PIPE, text=True, errors="replace"
    )
    said: list[str] = []
    told_s = started_s
    assert process.stdout is not None
    with contextlib.suppress(KeyboardInterrupt):
        for line in process.stdout:
            said.append(line.rstrip())
            if line.startswith("#") and time.monotonic() - told_s > 15.0:
                told_s = time.monotonic()
                print(f"  {name}: {told_s - started_s:4.0f} s  {line.rstrip()[:90]}", file=sys.stderr)
        process.wait()
    text = "\n".join(said)
    executed = re.search(r"number_of_executed_units: (\d+)", text)
    numbers = [int(found) for found in re.findall(r"^#(\d+)", text, re.MULTILINE)]
    coverage = re.findall(r" cov: (\d+) ft: (\d+)", text)
    found = sorted(set(folder.glob(f"found-{name}-*")) - before)
    if process.returncode not in (0, None):
        kept = [line[:400] for line in said if not line.startswith(("#", "INFO:", "WARNING:"))]
        print("\n".join(kept)[-6000:], file=sys.stderr)
    return {
        "target": name,
        "seconds": round(time.monotonic() - started_s, 1),
        "executions": int(executed[1]) if executed else max(numbers, default=0),
        "edges": int(coverage[-1][0]) if coverage else None,
        "found": [str(path) for path in found],
        "exit": process.returncode,
    }


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="scripts/fuzz", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("target", nargs="?", choices=[*TARGETS, "all"], help="which edge")
    parser.add_argument("--list", action="store_true", help="name the targets and end")
    parser.add_argument("--seconds", type=int, default=60, help="of each target (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the mutations (default: %(default)s)")
    parser.add_argument(
        "--corpus", type=Path, default=PROJECT / "fuzz-corpus", help="folder of corpora and finds"
    )
    parser.add_argument("--plain", action="store_true", help="seeded mutations only, without atheris")
    parser.add_argument("--repeat", type=Path, metavar="FILE", help="run this input once and end")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.list or options.target is None:
        print("\n".join(TARGETS))
        return 0 if options.list else 2
    if options.repeat:
        if options.target == "all":
            parser.error("--repeat needs the target that FILE belongs to")
        take, _ = TARGETS[options.target].prepare()
        take(options.repeat.read_bytes())
        print("nothing wrong with it")
        return 0
    if options.here:
        work = plain if options.plain else guided
        work(TARGETS[options.target], options.seconds, options.seed, options.corpus / options.target)
        return 0
    if not options.plain and importlib.util.find_spec("atheris") is None:
        parser.error(
            "atheris is not installed (pip install -e .[fuzz]; it has wheels for some Pythons only); or --plain"
        )
    names = list(TARGETS) if options.target == "all" else [options.target]
    results = []
    for name in names:
        print(f"== {name}: {options.seconds} s", file=sys.stderr)
        results.append(run(name, options.seconds, options.seed, options.corpus, options.plain))
        if not options.json:
            shown = results[-1]
            print(f"{name:16} {shown['executions']:>10} executions in {shown['seconds']} s, {shown['edges'] or 0} edges, "
                  f"{len(shown['found'])} found{''.join(' ' + path for path in shown['found'])}")  # fmt: skip
    if options.json:
        print(json.dumps(results, indent=2))
    return 1 if any(result["exit"] for result in results) else 0


if __name__ == "__main__":
    sys.exit(main())
