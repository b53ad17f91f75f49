"""Flies beside other people's traffic, and beside none, and compares: not one bit of a setpoint may differ.

    python scripts/other_traffic.py                                   a million messages for each firmware
    python scripts/other_traffic.py --firmware px4 --messages 20000   a minute
    python scripts/other_traffic.py --senders autopilot companion --json

Every message of MAVLink's ardupilotmega dialect (common is part of it) with random and extreme content, and the autopilot's
own messages with other numbers, from a companion, a ground station, a gimbal and a camera, some 500 a second beside the
autopilot's own, in lockstep. Exit code 1: something of the flight was changed by it.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import companion
from sitl_stub import Stub

TOPICS = ("/state", "/reference", "/setpoint", "/law_input", "/law_memory", "/terms", "/truth")
RATE_HZ = 500.0
PER_FLIGHT = 100_000
"""Messages beside one flight, which then lasts 200 s; further flights have other seeds."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n")[0],
        epilog=__doc__.partition("\n")[2],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--firmware", nargs="+", default=["px4", "ardupilot"], choices=("px4", "ardupilot"))
    parser.add_argument("--messages", type=int, default=1_000_000, metavar="N", help="for each firmware")
    parser.add_argument(
        "--senders", nargs="+", default=["companion", "ground_station", "gimbal", "camera"], metavar="NAME"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="N")
    parser.add_argument("--json", action="store_true", help="a line of JSON a flight")
    options = parser.parse_args(arguments)
    changed = 0
    try:
        for firmware in options.firmware:
            heard, seed = 0, options.seed
            while heard < options.messages:
                began_s = time.monotonic()
                count, differing = _compare(
                    firmware, seed, min(PER_FLIGHT, options.messages - heard), options.senders
                )
                heard += count
                changed += bool(differing)
                row = {"firmware": firmware, "seed": seed, "messages": heard, "of": options.messages}
                row |= {"changed": differing, "wall_s": round(time.monotonic() - began_s, 1)}
                print(json.dumps(row) if options.json else _line(row), flush=True)
                seed += 1
    except KeyboardInterrupt:
        return 130
    return 1 if changed else 0


def _line(row: dict[str, object]) -> str:
    result = f"CHANGED {row['changed']}" if row["changed"] else "not one bit changed"
    return f"{row['firmware']} seed {row['seed']}: {row['messages']} of {row['of']} messages, {result} ({row['wall_s']} s)"


def _compare(firmware: str, seed: int, messages: int, senders: Sequence[str]) -> tuple[int, list[str]]:
    """How many foreign messages were heard, and which channels differ from those of the flight without them."""
    crowd = f'[[fault]]\nkind = "other_traffic"\nsenders = {json.dumps(list(senders))}\nafter = "start"\nat_s = 0.0\n'
    flown = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name, faults in (("alone", ""), ("beside", crowd)):
            folder = Path(scratch) / name
            folder.mkdir()
            scenario = folder / "faults.toml"
            scenario.write_text(f"seed = {seed}\n{faults}", encoding="utf-8")
            with Stub(firmware, seed=seed, lockstep=True, arguments=("--scenario", str(scenario))) as stub:
                result = companion.fly(
                    stub.endpoint,
                    profile="qball2" if firmware == "px4" else "arducopter_sitl",
                    trajectory="lemniscate",
                    duration_s=max(5.0, messages / RATE_HZ),
                    log=folder / "flight.mcap",
                    settings=["flight.safety.silence_s=60"],
                    system=1,
                    arm=True,
                    fix=True,
                )
            if result.outcome is not companion.Outcome.COMPLETED:
                return messages, [f"{name}: {result.text}"]
            flown[name] = companion.read_log(folder / "flight.mcap")
    alone, beside = flown["alone"].channels, flown["beside"].channels
    differing = [
        topic
        for topic in TOPICS
        if not np.array_equal(alone[topic].values, beside[topic].values, equal_nan=True)
    ]
    counts = flown["beside"].metadata["wall link"]
    return int(counts.get("other senders", 0)) + int(counts.get("other autopilots", 0)), differing


if __name__ == "__main__":
    sys.exit(main())
