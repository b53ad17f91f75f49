"""What the flight log bears: killed, on a full, slow or read-only disk, cut by a power failure at every byte.

examples:
  ./scripts/log_torture                              all of it
  ./scripts/log_torture --kills 20 --seed 7 --json   fewer kills, other moments, for programs
  ./scripts/log_torture --only cuts --log FILE       cut this flight's log (default: one that is flown first)

Promised are: at most 0.2 s of records lost by a SIGKILL; the control thread never waits for a disk; every reading command
copes with a cut log; `companion recover` makes a whole, indexed file. The exit code is 1 where that is not kept.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import json
import os
import random
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "flight"))
sys.path.insert(0, str(Path(__file__).parents[2]))

from mcap.reader import make_reader

from companion.config.errors import UserError
from companion.flightlog import mcap_file
from companion.flightlog.channels import STATE
from companion.flightlog.reader import _HEAD, MAGIC, _RawReader, read_log
from companion.flightlog.recovery import recover
from companion.flightlog.writer import FlightLog

CHILD = Path(__file__).parents[1] / "unit" / "logging_child.py"
PROMISED_LOSS_S = 0.2
LONGEST_HAND_OVER_MS = 50.0  # a tenth of the slow disk's fsync: who waited for it would need 500
NOBODY = 65534


def say(text: str) -> None:
    """Progress, on standard error."""
    print(text, file=sys.stderr, flush=True)


# Killed -----------------------------------------------------------------------------------------------------


def lost_by_kill(folder: Path, option: str, delay_s: float) -> float:
    """Kill a logging process `delay_s` after it began; the age of the oldest record lost, seconds."""
    path = folder / "killed.mcap"
    child = subprocess.Popen([sys.executable, str(CHILD), str(path), option], stdout=subprocess.PIPE)
    assert child.stdout is not None
    child.stdout.read(8)
    time.sleep(delay_s)
    child.send_signal(signal.SIGKILL)
    announced = child.communicate()[0]
    logged_s = np.frombuffer(announced[: len(announced) // 8 * 8])
    state = read_log(path).channels.get("/state")
    lost = logged_s[logged_s > (state.time_s[-1] if state is not None else -1.0)]
    whole = path.with_suffix(".whole.mcap")
    whole.unlink(missing_ok=True)
    check_whole(recover(path, whole).output)
    return float(lost[-1] - lost[0]) if len(lost) else 0.0


def check_whole(path: Path) -> int:
    """Read a file by its index with the mcap package, checksums and all; how many messages it holds."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        count = sum(1 for _ in reader.iter_messages())
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == count
    return count


def kills(folder: Path, count: int, seed: int) -> dict[str, Any]:
    """SIGKILL at `count` random moments."""
    rng, losses = random.Random(seed), []
    for number in range(count):
        option = ("paced", "busy", "slow-sync")[number % 3]
        losses.append(lost_by_kill(folder, option, rng.uniform(0.0, 1.0)))
        if (number + 1) % 10 == 0:
            say(f"  {number + 1} of {count} kills, worst {max(losses):.3f} s")
    return {
        "kills": count,
        "lost_s_median": round(float(np.median(losses)), 3),
        "lost_s_95": round(float(np.percentile(losses, 95)), 3),
        "lost_s_worst": round(max(losses), 3),
        "above_promise": sum(loss > PROMISED_LOSS_S for loss in losses),
        "kept": max(losses) <= PROMISED_LOSS_S,
    }


# Bad disks --------------------------------------------------------------------------------------------------


def full_disk(folder: Path) -> dict[str, Any]:
    """RLIMIT_FSIZE: the kernel takes the first half of a write and refuses the rest, as a full disk does."""
    path = folder / "full.mcap"
    child = subprocess.run(
        [sys.executable, str(CHILD), str(path), "limited"], capture_output=True, check=True
    )
    slowest_ms, lost, written = struct.unpack("<3d", child.stdout[-24:])
    kept = len(read_log(path).channels["/state"])
    check_whole(recover(path, folder / "full.whole.mcap").output)
    good = lost > 0 and 0 < kept < 4000 and slowest_ms < LONGEST_HAND_OVER_MS
    return {
        "records_lost": int(lost),
        "records_written": int(written),
        "slowest_hand_over_ms": round(slowest_ms, 2),
        "kept": good,
    }


def slow_disk(folder: Path, seconds: float = 10.0) -> dict[str, Any]:
    """What a record costs the control thread while fsync takes 500 ms and a write 100 ms, beside a disk that is quick."""
    figures: dict[str, Any] = {}
    real = mcap_file.os.write, os.fdatasync, os.fsync
    for name in ("quick", "slow"):
        if name == "slow":
            mcap_file.os.write = lambda fd, data: (time.sleep(0.1), real[0](fd, data))[1]
            os.fdatasync = os.fsync = lambda _fd: time.sleep(0.5)
        try:
            log = FlightLog(folder / f"{name}.mcap", channels=[STATE])
            state, numbers, costs = log.define(STATE), np.zeros(14), []
            started = time.perf_counter()
            for step in range(round(seconds * 100)):
                time.sleep(max(0.0, started + 0.01 * step - time.perf_counter()))
                begun = time.perf_counter()
                for _ in range(10):
                    log.record(state, 0.01 * step, numbers)
                costs.append((time.perf_counter() - begun) / 10)
            health = log.close()
        finally:
            mcap_file.os.write, os.fdatasync, os.fsync = real
        figures[name] = {
            "hand_over_us": [round(1e6 * float(q), 1) for q in (*np.percentile(costs, [50, 99]), max(costs))],
            "complete": health.complete,
        }
    slowest_ms = figures["slow"]["hand_over_us"][2] * 10 / 1e3
    return {**figures, "kept": slowest_ms < LONGEST_HAND_OVER_MS and figures["slow"]["complete"]}


def read_only(folder: Path) -> dict[str, Any]:
    """A folder that may not be written: said at the start, in one line, by a user who is not root."""
    place = folder / "locked"
    place.mkdir()
    folder.chmod(0o755)
    place.chmod(0o555)
    readable, writable = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            if os.geteuid() == 0:
                os.setgroups([])
                os.setgid(NOBODY)
                os.setuid(NOBODY)
            FlightLog(place / "a.mcap")
            os.write(writable, b"nothing was said")
        except UserError as error:
            os.write(writable, str(error).encode())
        except BaseException as error:
            os.write(writable, repr(error).encode())
        os._exit(0)
    os.close(writable)
    with os.fdopen(readable, "rb") as pipe:
        said = pipe.read().decode()
    os.waitpid(child, 0)
    place.chmod(0o755)
    return {"said": said.replace(str(folder), "…"), "kept": "choose a folder you may write" in said}


# A power cut ------------------------------------------------------------------------------------------------


def flown_log(folder: Path) -> Path:
    """A short flight in lockstep, so that there is something to analyze and to replay."""
    from stub_flights import fly_short, lockstep_stub

    say("  flying a log to cut")
    with lockstep_stub() as stub:
        return fly_short(stub, folder).log


def records_of(data: bytes) -> list[tuple[int, int]]:
    """Opcode and start of each record of a file, in order, and at the end (0, its length)."""
    found, at = [], len(MAGIC)
    while at + _HEAD.size <= len(data) - len(MAGIC):
        opcode, length = _HEAD.unpack_from(data, at)
        found.append((opcode, at))
        at += _HEAD.size + length
    return [*found, (0, at)]


def last_second(data: bytes, end_s: float, path: Path) -> int:
    """The first byte of the records of the last second: where the log, cut after it, still ends a second earlier."""
    boundaries = [at for _, at in records_of(data)]
    low, high = 0, len(boundaries) - 1
    while low < high:
        middle = (low + high) // 2
        path.write_bytes(data[: boundaries[middle]])
        try:
            early = not read_log(path).end_time_s > end_s - 1.0
        except UserError:
            early = True
        low, high = (middle + 1, high) if early else (low, middle)
    return boundaries[max(low - 1, 0)]


def commands_on(path: Path) -> list[str]:
    """Run every reading command on a log; what was wrong, in words."""
    from companion.cli.main import main

    outputs = [path.with_suffix(ending) for ending in (".tlog", ".whole.mcap")]
    for output in outputs:
        output.unlink(missing_ok=True)
    wrong = []
    for words in (
        ["analyze", str(path), "--json"],
        ["replay", str(path), "--json"],
        ["identify", str(path), "--json"],
        ["compare", str(path), str(path), "--json"],
        ["export", str(path), "-o", str(outputs[0])],
        ["recover", str(path), "-o", str(outputs[1])],
    ):
        spoken = io.StringIO()
        try:
            with contextlib.redirect_stdout(spoken), contextlib.redirect_stderr(spoken):
                code = main(words)
        except Exception as error:
            wrong.append(f"{words[0]}: {error!r}")
            continue
        if code not in (0, 2) or (code == 2 and "error: " not in spoken.getvalue()):
            wrong.append(f"{words[0]}: exit code {code}: {spoken.getvalue()[:200]}")
    if outputs[1].exists():
        check_whole(outputs[1])
    return wrong


def cuts(folder: Path, log: Path, seed: int, at_most: int) -> dict[str, Any]:
    """Cut a log at every byte of its last second.

    A file is read from front to back, so what a cut inside a record leaves is what a cut before the record leaves, and a
    part of a record: every byte is tried on the part, and the whole reader and all commands on the ends of records and on
    as many random bytes; together at most `at_most`.
    """
    data, rng, path = log.read_bytes(), random.Random(seed), folder / "cut.mcap"
    first = last_second(data, read_log(log).end_time_s, path)
    boundaries = [at for _, at in records_of(data) if at >= first]
    wrong: list[str] = []
    for start, end in itertools.pairwise(boundaries):
        view = memoryview(data)[start:end]
        for cut in range(len(view)):
            reader = _RawReader()
            said = reader.read_records(view[:cut])
            if not said or reader.channels or reader.metadata:
                wrong.append(f"byte {start + cut}: {said!r}")
    inside = [rng.randrange(first, len(data)) for _ in boundaries]
    tried = sorted({*boundaries, *inside})
    if len(tried) > at_most:
        tried = sorted(rng.sample(tried, at_most))
    path.write_bytes(data)
    for number, cut in enumerate(reversed(tried), start=1):
        os.truncate(path, cut)
        wrong += [f"cut at byte {cut}: {text}" for text in commands_on(path)]
        if number % 25 == 0:
            say(f"  {number} of {len(tried)} cuts through every command")
    for text in wrong[:10]:
        say(f"  {text}")
    return {
        "log_bytes": len(data),
        "bytes_of_the_last_second": len(data) - first,
        "bytes_cut": sum(end - start for start, end in itertools.pairwise(boundaries)),
        "cuts_through_every_command": len(tried),
        "wrong": len(wrong),
        "kept": not wrong,
    }


PARTS = ("kills", "full", "slow", "read-only", "cuts")


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="scripts/log_torture", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=PARTS, action="append", help="one part (may be repeated)")
    parser.add_argument("--kills", type=int, default=200, help="how often (default: %(default)s)")
    parser.add_argument(
        "--cuts", type=int, default=600, help="through every command, at most (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the moments and cuts (default: %(default)s)")
    parser.add_argument("--log", type=Path, help="the log to cut (default: one that is flown first)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    if options.log is not None and not options.log.is_file():
        print(f"error: --log {options.log}: there is no such file", file=sys.stderr)
        return 2
    results: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        work: dict[str, Callable[[], dict[str, Any]]] = {
            "kills": lambda: kills(folder, options.kills, options.seed),
            "full": lambda: full_disk(folder),
            "slow": lambda: slow_disk(folder),
            "read-only": lambda: read_only(folder),
            "cuts": lambda: cuts(folder, options.log or flown_log(folder), options.seed, options.cuts),
        }
        for part in options.only or PARTS:
            say(f"== {part}")
            results[part] = work[part]()
            shown = json.dumps({k: v for k, v in results[part].items() if k != "kept"}, ensure_ascii=False)
            line = f"{part:10} {'kept' if results[part]['kept'] else 'NOT KEPT'}  {shown}"
            print(line, file=sys.stderr if options.json else sys.stdout, flush=True)
    if options.json:
        print(json.dumps(results, indent=2, ensure_ascii=False))
    return 0 if all(result["kept"] for result in results.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
