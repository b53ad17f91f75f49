"""The command `scripts/campaign`."""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from campaign.crew import Crew, default_size, fly_and_judge
from campaign.draw import FIRMWARES, PlannedFlight, planned
from campaign.flying import arguments as companion_arguments
from campaign.invariants import INVARIANTS
from campaign.planted import DEFECTS, candidates
from campaign.processes import warm_up
from campaign.result import Result
from campaign.tally import Tally, as_json, put_between_markers, read_results

EXAMPLES = """examples:
  scripts/campaign                                  1,000 flights of each firmware, on all cores
  scripts/campaign --flights 100 --firmware px4     a short one
  scripts/campaign --firmware px4 --seed 123        one flight again, in full, its files kept
  scripts/campaign --planted                        defects planted on purpose: is each of them noticed?
  scripts/campaign --out DIR --resume               go on where DIR/results.jsonl ends; DIR keeps what failed
  scripts/campaign --out DIR --resume --write docs/campaign.md
                                                    the same, and the table into the page

Ctrl-C ends with the table so far. Exit codes: 0 every invariant kept, 1 one broke or a defect went unnoticed,
2 wrong input, 130 interrupted.
"""
STUBS = {"px4": ("px4", "px4-1.13"), "ardupilot": ("ardupilot",)}


class WrongInput(Exception):
    """One line for the user, exit code 2."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="scripts/campaign",
        description=__doc__
        and "Flies companion against sitl_stub with everything going wrong, and checks what must hold.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--firmware", choices=FIRMWARES, help="one of them only")
    parser.add_argument(
        "--flights", type=int, default=1000, metavar="N", help="of each firmware (default 1000)"
    )
    parser.add_argument(
        "--first-seed", type=int, default=1, metavar="N", help="of the first flight (default 1)"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="this one flight, in full; needs --firmware")
    parser.add_argument("--jobs", type=int, metavar="N", help="flights at a time (default: one per core)")
    parser.add_argument(
        "--out", metavar="DIR", help="results.jsonl, and the files of flights that broke an invariant"
    )
    parser.add_argument("--resume", action="store_true", help="skip what results.jsonl in --out has already")
    parser.add_argument("--write", metavar="PAGE", help="put the table between the markers of a page")
    parser.add_argument("--plant", choices=DEFECTS, help="fly with this defect in the companion")
    parser.add_argument(
        "--planted", action="store_true", help="every defect in turn: by which invariant is it caught?"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    options = _parser().parse_args(arguments)
    try:
        _check(options)
        firmwares = (options.firmware,) if options.firmware else FIRMWARES
        print("loading both programs; the first time on a machine they compile for a minute", file=sys.stderr)
        warm_up([stub for firmware in firmwares for stub in STUBS[firmware]])
        if options.seed is not None:
            return _one(options)
        if options.planted:
            return _planted(options, firmwares)
        return _many(options, firmwares)
    except (WrongInput, ValueError) as error:
        print(f"scripts/campaign: {error}", file=sys.stderr)
        return 2


def _check(options: argparse.Namespace) -> None:
    if options.seed is not None and options.firmware is None:
        raise WrongInput(f"--seed {options.seed}: also say --firmware {' or '.join(FIRMWARES)}")
    if options.flights < 1 or options.first_seed < 0 or (options.jobs is not None and options.jobs < 1):
        raise WrongInput("--flights and --jobs are at least 1, --first-seed at least 0")
    if options.resume and options.out is None:
        raise WrongInput("--resume goes on with a results.jsonl: say where with --out DIR")
    if options.write is not None and not Path(options.write).is_file():
        raise WrongInput(f"--write {options.write}: there is no such page")


def _one(options: argparse.Namespace) -> int:
    """One flight, told in full; its folder is kept."""
    flight = planned(options.firmware, options.seed)
    out = Path(options.out) if options.out else Path(tempfile.gettempdir()) / "campaign"
    folder = (out / f"{flight.firmware}-{flight.seed}").resolve()
    plant = DEFECTS[options.plant].plant if options.plant else None
    result, _, flown = fly_and_judge(flight, folder, plant)
    if options.json:
        print(
            json.dumps(
                json.loads(result.to_line()) | {"planned": flight.to_json()}, indent=1, ensure_ascii=False
            )
        )
    else:
        _tell(flight, result, flown.words, folder)
    return 1 if result.broken else 0


def _tell(flight: PlannedFlight, result: Result, words: Sequence[str], folder: Path) -> None:
    print(f"{flight.name}: {', '.join(flight.kinds)}")
    for name, value in flight.to_json().items():
        if name not in ("firmware", "seed", "faults"):
            print(f"  {name:<16} {value}")
    for fault in flight.faults:
        print("  " + " ".join(fault.to_toml().split("\n")).strip())
    print(f"companion {' '.join(companion_arguments(flight, folder / 'flight.mcap'))}")
    print("\n".join(f"  | {line}" for line in words))
    print(f"ended: {result.outcome}: {result.text}")
    for name in INVARIANTS:
        if name in result.broken:
            print(f"  BROKEN {name}: {result.broken[name]}")
    print(f"files: {folder}\n{len(result.broken)} of {result.judged} invariants judged are broken")


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Signals that came; the first Ctrl-C or SIGTERM lets flights under way end, a second one does what it always does."""
    came: list[int] = []
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)
        for one, handler in usual.items():
            signal.signal(one, handler)  # type: ignore[arg-type]

    before = {number: signal.signal(number, note) for number in usual}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _many(options: argparse.Namespace, firmwares: Sequence[str]) -> int:
    out = Path(options.out) if options.out else None
    tally = Tally()
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        if options.resume and (out / "results.jsonl").exists():
            tally = Tally(read_results(out / "results.jsonl"))
        elif (out / "results.jsonl").exists():
            raise WrongInput(
                f"{out / 'results.jsonl'} exists: --resume goes on with it, another --out begins anew"
            )
    done = {(result.firmware, result.seed) for result in tally.results}
    seeds = range(options.first_seed, options.first_seed + options.flights)
    flights = [
        planned(firmware, seed) for seed in seeds for firmware in firmwares if (firmware, seed) not in done
    ]
    plant = DEFECTS[options.plant].plant if options.plant else None
    with _interruptible() as came:
        _fly_all(flights, tally, options.jobs or default_size(), out, plant, came)
    if options.write is not None:
        put_between_markers(Path(options.write), "campaign", tally.page(_repeat(options)))
    if options.json:
        print(json.dumps(as_json(tally), indent=1, ensure_ascii=False))
    else:
        for firmware in sorted({result.firmware for result in tally.results}, reverse=True):
            print(f"\n{firmware}\n{tally.table(firmware)}")
        for result in tally.broken:
            for name, word in result.broken.items():
                print(f"scripts/campaign --firmware {result.firmware} --seed {result.seed}    {name}: {word}")
    if came:
        return 130
    return 1 if tally.broken else 0


def _repeat(options: argparse.Namespace) -> str:
    words = ["scripts/campaign"]
    words += ["--firmware", options.firmware] if options.firmware else []
    words += ["--flights", str(options.flights)] if options.flights != 1000 else []
    words += ["--first-seed", str(options.first_seed)] if options.first_seed != 1 else []
    return " ".join(words)


def _fly_all(
    flights: Sequence[PlannedFlight], tally: Tally, size: int, out: Path | None, plant: Any, came: list[int]
) -> None:
    scratch = Path(tempfile.mkdtemp(prefix="campaign-"))
    began_s, total, done = time.monotonic(), len(flights), 0
    crew = Crew(min(size, max(1, total)), scratch, out, plant)
    results = (out / "results.jsonl").open("a", encoding="utf-8") if out is not None else None

    def orders() -> Iterator[PlannedFlight]:
        for flight in flights:
            if came:
                return
            yield flight

    try:
        for result in crew.results(orders()):
            tally.add(result)
            done += 1
            if results is not None:
                results.write(result.to_line() + "\n")
                results.flush()
            _progress(done, total, time.monotonic() - began_s, tally, result)
    finally:
        crew.close()
        if results is not None:
            results.close()
        shutil.rmtree(scratch, ignore_errors=True)
        if sys.stderr.isatty():
            print(file=sys.stderr)


def _progress(done: int, total: int, passed_s: float, tally: Tally, result: Result) -> None:
    rate = done / passed_s * 60.0
    left_min = (total - done) / rate
    line = f"{done}/{total} flights, {rate:.0f} a minute, {left_min:.0f} min left, {len(tally.broken)} broke an invariant"
    moving = sys.stderr.isatty()
    if result.broken:
        name, word = next(iter(result.broken.items()))
        clear = "\r\x1b[K" if moving else ""
        print(
            f"{clear}{result.firmware} {result.seed} ({', '.join(result.kinds)}): {name}: {word}",
            file=sys.stderr,
        )
    if moving:
        print(f"\r{line}\x1b[K", end="", file=sys.stderr, flush=True)
    elif done % 20 == 0 or done == total:
        print(line, file=sys.stderr, flush=True)


def _planted(options: argparse.Namespace, firmwares: Sequence[str]) -> int:
    """Fly with each defect until an invariant breaks."""
    found: list[dict[str, Any]] = []
    scratch = Path(tempfile.mkdtemp(prefix="campaign-"))
    names = [options.plant] if options.plant else list(DEFECTS)
    try:
        for name in names:
            for firmware in firmwares:
                found.append(_hunt(name, firmware, options.first_seed, scratch))
                _tell_hunt(found[-1])
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    if options.json:
        print(json.dumps(found, indent=1, ensure_ascii=False))
    if options.write is not None:
        put_between_markers(Path(options.write), "planted defects", _hunts_table(found))
    return 0 if all(one["caught_by"] for one in found) else 1


def _hunts_table(found: Sequence[dict[str, Any]]) -> str:
    """Markdown."""
    lines = ["| defect | firmware | caught by | in flight | what was said |", "|---|---|---|---:|---|"]
    for one in found:
        what = f"`{one['defect']}`: {DEFECTS[one['defect']].summary}"
        said = one["word"].replace("|", "/")
        caught = one["caught_by"] or "**not caught**"
        lines.append(
            f"| {what} | {one['firmware']} | {caught} | {one['flights']} (seed {one['seed']}) | {said} |"
        )
    return "\n".join(lines) + "\n"


def _hunt(name: str, firmware: str, first_seed: int, scratch: Path) -> dict[str, Any]:
    flown = 0
    for flight in candidates(DEFECTS[name], firmware, first_seed):
        flown += 1
        folder = scratch / f"{name}-{firmware}-{flight.seed}"
        result, _, _ = fly_and_judge(flight, folder, DEFECTS[name].plant)
        shutil.rmtree(folder, ignore_errors=True)
        if not result.broken:
            continue
        sound, _, _ = fly_and_judge(flight, folder)  # what breaks without the defect does not show the defect
        shutil.rmtree(folder, ignore_errors=True)
        for by in result.broken:
            if by in sound.broken:
                continue
            return {
                "defect": name,
                "firmware": firmware,
                "flights": flown,
                "seed": flight.seed,
                "caught_by": by,
                "word": result.broken[by],
                "also": [other for other in result.broken if other != by],
            }
    return {
        "defect": name,
        "firmware": firmware,
        "flights": flown,
        "seed": None,
        "caught_by": "",
        "word": "",
        "also": [],
    }


def _tell_hunt(one: dict[str, Any]) -> None:
    where = f"{one['defect']} on {one['firmware']}: {DEFECTS[one['defect']].summary}"
    if not one["caught_by"]:
        print(f"NOT CAUGHT {where}; {one['flights']} flights", flush=True)
        return
    found = f"by {one['caught_by']!r} in flight {one['flights']} (seed {one['seed']}): {one['word']}"
    print(f"caught     {where}\n           {found}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
