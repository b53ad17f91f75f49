"""How soon a stub is there: until its sockets are open, and until its first HEARTBEAT; one alone, and many at once.

python scripts/bench/stub_start.py
python scripts/bench/stub_start.py --side-by-side 20 --json
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from concurrent.futures import ThreadPoolExecutor

from pymavlink import mavutil

from sitl_stub import Stub


def one_start(firmware: str) -> tuple[float, float]:
    """Wall time until the ready line and until the first HEARTBEAT, s."""
    began = time.monotonic()
    with Stub(firmware, ready_timeout_s=120.0) as stub:
        ready = time.monotonic() - began
        link = mavutil.mavlink_connection(stub.endpoint)
        if link.wait_heartbeat(timeout=300) is None:
            raise SystemExit("no HEARTBEAT within five minutes")
        heard = time.monotonic() - began
        link.close()
    return ready, heard


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--firmware", default="px4", choices=("px4", "px4-1.13", "ardupilot"))
    parser.add_argument(
        "--repeats", type=int, default=10, metavar="N", help="one after the other (default 10)"
    )
    parser.add_argument("--side-by-side", type=int, default=20, metavar="N", help="at once (default 20)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    one_start(arguments.firmware)  # compiles on a new machine
    alone = [one_start(arguments.firmware) for _ in range(arguments.repeats)]
    with ThreadPoolExecutor(arguments.side_by_side) as pool:
        together = list(pool.map(one_start, [arguments.firmware] * arguments.side_by_side))
    figures = {}
    for name, starts in (("alone", alone), (f"{arguments.side_by_side}_at_once", together)):
        for what, times in zip(("ready", "heartbeat"), zip(*starts, strict=True), strict=True):
            figures[f"{name}_{what}_median_s"] = round(statistics.median(times), 3)
            figures[f"{name}_{what}_worst_s"] = round(max(times), 3)
    if arguments.json:
        print(json.dumps({"firmware": arguments.firmware, **figures}))
        return
    for name, value in figures.items():
        print(f"{name:32} {value:8.3f}")


if __name__ == "__main__":
    main()
