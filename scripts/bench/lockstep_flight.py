"""How fast a whole flight goes in lockstep over UDP, and where the time is spent.

    python scripts/bench/lockstep_flight.py                       the report's flight with control at 100 Hz
    python scripts/bench/lockstep_flight.py --firmware ardupilot --repeats 3 --json

`companion fly` in this process, the stub in its own. Timed is the flight alone, from the first HEARTBEAT to disarmed;
starting and compiling are not, and are shown on their own (the companion's without its imports). Lockstep means that
the two take turns, so the processor time of both together is what the flight takes on a machine that has nothing else
to do; on a busy one the wall time is longer by what others take. The shares inside the companion are measured around a
few calls; the timers themselves are some 2 % of it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from companion.config.settings import load_settings
from companion.control.law import ControlLaw
from companion.control.prediction import Predictor
from companion.flight.control_loop import ControlLoop
from companion.flight.phases import Phase
from companion.flight.reporter import Reporter
from companion.flight.session import SessionOptions, fly
from companion.mavlink.connection import Connection
from companion.mavlink.endpoint import parse_endpoint
from companion.mavlink.link import Link
from sitl_stub import Stub

TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class Stopwatch:
    """Time spent in a few methods, by what they are for; time of one inside another counts for the inner one."""

    def __init__(self) -> None:
        self.spent_s: dict[str, float] = {}
        self._inner_s: list[float] = []

    def around(self, owner: type, method: str, what: str) -> None:
        """Time `owner.method` from now on."""
        plain: Callable[..., Any] = getattr(owner, method)
        self.spent_s.setdefault(what, 0.0)

        def timed(*given: Any, **named: Any) -> Any:
            self._inner_s.append(0.0)
            began = time.thread_time()
            try:
                return plain(*given, **named)
            finally:
                took = time.thread_time() - began
                self.spent_s[what] += took - self._inner_s.pop()
                if self._inner_s:
                    self._inner_s[-1] += took

        setattr(owner, method, timed)


class Timed(Reporter):
    """Notes when the flight began, by the wall and by the processor."""

    def __init__(self, stub: Stub) -> None:
        self.stub = stub
        self.began: tuple[float, float, float] | None = None
        self.ended = (0.0, 0.0, 0.0)

    def say(self, text: str) -> None:
        pass

    def progress(self, phase: Phase, time_s: float, of_s: float, text: str) -> None:
        if self.began is None and phase is not Phase.CONNECT:
            self.began = self.now()
        self.ended = self.now()

    def now(self) -> tuple[float, float, float]:
        """Wall, processor time of this process, of the stub's, s."""
        assert self.stub.process is not None
        stat = Path(f"/proc/{self.stub.process.pid}/stat").read_text().rpartition(")")[2].split()
        return time.monotonic(), time.process_time(), (int(stat[11]) + int(stat[12])) / TICKS_PER_S


def one_flight(
    firmware: str, rate_hz: float, duration_s: float, folder: Path, watch: Stopwatch
) -> dict[str, float]:
    """Fly once; figures of the flight alone."""
    before = dict(watch.spent_s)
    started_s = time.process_time()
    profile = "arducopter_sitl" if firmware == "ardupilot" else "qball2"
    overrides = [f"flight.control_rate_hz={rate_hz}", "flight.procedure.connect_timeout_s=300"]
    settings = load_settings(profile, {"duration_s": duration_s, "seed": 1}, overrides)
    with Stub(firmware, seed=1, lockstep=True) as stub:
        reporter = Timed(stub)
        options = SessionOptions(
            Connection(parse_endpoint(stub.endpoint)),
            folder / "bench.mcap",
            overwrite=True,
            fix=True,
            real_time=False,
        )
        result = fly(settings, options, reporter)
    if result.outcome.exit_code:
        raise SystemExit(f"the flight ended early: {result.text}")
    assert reporter.began is not None and stub.summary is not None
    wall, ours, stubs = (end - began for began, end in zip(reporter.began, reporter.ended, strict=True))
    figures = {
        "simulated_s": stub.summary["simulated_s"],
        "wall_s": wall,
        "stub_starting_cpu_s": reporter.began[2],
        "companion_starting_cpu_s": reporter.began[1] - started_s,
        "stub_cpu_s": stubs,
        "companion_cpu_s": ours,
        "times_real_time_by_wall": stub.summary["simulated_s"] / wall,
        "times_real_time_by_processor_time": stub.summary["simulated_s"] / (ours + stubs),
        "messages_to_companion": stub.summary["sent"],
    }
    figures |= {f"companion_{what}_s": spent - before[what] for what, spent in watch.spent_s.items()}
    return figures


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--firmware", default="px4", choices=("px4", "px4-1.13", "ardupilot"))
    parser.add_argument("--rate", type=float, default=100.0, metavar="HZ", help="of control (default 100)")
    parser.add_argument("--duration", type=float, default=40.0, metavar="S", help="of tracking (default 40)")
    parser.add_argument(
        "--repeats", type=int, default=3, metavar="N", help="flights; medians are shown (default 3)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    watch = Stopwatch()
    watch.around(Link, "receive", "link")
    watch.around(Link, "send", "link")
    watch.around(ControlLoop, "on_state", "control_loop")
    watch.around(ControlLaw, "step_packed", "law")
    watch.around(Predictor, "predict", "law")
    with tempfile.TemporaryDirectory() as folder:
        flights = [
            one_flight(arguments.firmware, arguments.rate, arguments.duration, Path(folder), watch)
            for _ in range(arguments.repeats)
        ]
    figures = {name: statistics.median(flight[name] for flight in flights) for name in flights[0]}
    if arguments.json:
        print(json.dumps({"firmware": arguments.firmware, "control_hz": arguments.rate, **figures}))
        return
    for name, value in figures.items():
        print(f"{name:40} {value:10.2f}")


if __name__ == "__main__":
    main()
