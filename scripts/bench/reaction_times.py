"""Measure the worst-case reaction time of every limit of the supervisor, and write it into docs/safety.md.

    python scripts/bench/reaction_times.py            print the table
    python scripts/bench/reaction_times.py --write    put it into docs/safety.md

A quantity goes beyond a rung's threshold at a random moment between two messages of its source; states come at the
slowest control rate in use (100 Hz). Measured is the autopilot's time from that moment to the reaction: the waiting
for the next message, the supervisor's own sampling of slow quantities, its filters, and the configured duration.
What follows a final reaction, the autopilot's change of mode, is measured over the wire by
tests/flight/test_safety_reactions.py.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from companion.config.safety import QUANTITIES, SafetyLimits
from companion.flight.provocation import PERIOD_S, PROVOCATIONS, Scene, just_beyond
from companion.flight.safety_page import put_block

PHASES = 12
LONGEST_S = 20.0
SOURCES = {  # how often the autopilot tells it, s, as `preflight.ask_for_streams` asks for
    "estimator_lost": 0.2,
    "innovation_ratio": 0.2,
    "sensors_unhealthy": 0.2,
    "battery_remaining": 0.2,
    "battery_voltage_v": 0.2,
    "round_trip_s": 1.7,  # half of the median's window of 32 at 10 Hz, and one
    "log_lost": 1.0,
    "disk_free_mb": 1.0,
}


def reaction_time(limits: SafetyLimits, name: str, reaction: int, value: float, wait_s: float) -> float:
    """From the event, `wait_s` before its first message, to the reaction, s."""
    scene = Scene(limits, start_s=100.0 + wait_s)
    for _ in range(30):
        scene.step()
    PROVOCATIONS[name](scene, value)
    event_s = scene.time_s - wait_s
    while scene.time_s < event_s + LONGEST_S:
        if scene.step().reaction >= reaction:
            return scene.time_s - event_s
    return float("nan")


def measure(limits: SafetyLimits, seed: int) -> list[tuple[str, str, float, float, str, float]]:
    """(quantity, reaction, threshold, duration, unit, worst reaction time) of every rung."""
    random = np.random.default_rng(seed)
    rows = []
    for name, quantity in QUANTITIES.items():
        for reaction, at, for_s in limits.ladder(name).rungs():
            value = just_beyond(name, at, quantity.below)
            waits = random.uniform(0.0, SOURCES.get(name, PERIOD_S), PHASES)
            waits[0] = SOURCES.get(name, PERIOD_S)
            worst = max(reaction_time(limits, name, reaction, value, float(wait)) for wait in waits)
            rows.append((name, reaction.setting, at, for_s, quantity.unit, worst))
    return rows


def step_cost_us() -> tuple[float, float]:
    """Median and 99th percentile of one judgement, µs."""
    scene = Scene(SafetyLimits())
    spent: list[float] = []
    judge = scene.supervisor.judge

    def timed(*given):
        began = time.perf_counter()
        judgement = judge(*given)
        spent.append(time.perf_counter() - began)
        return judgement

    scene.supervisor.judge = timed  # type: ignore[method-assign]
    for _ in range(5000):
        scene.step()
    return float(np.median(spent)) * 1e6, float(np.percentile(spent, 99)) * 1e6


def as_table(rows: list[tuple[str, str, float, float, str, float]]) -> str:
    """Markdown."""
    lines = [
        "| quantity | reaction | beyond | for | worst reaction time |",
        "|---|---|---|---|---|",
    ]
    for name, reaction, at, for_s, unit, worst in rows:
        lines.append(f"| `{name}` | {reaction} | {at:g} {unit} | {for_s:g} s | {worst:.2f} s |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Measure, print or write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="put the table into docs/safety.md")
    parser.add_argument("--seed", type=int, default=1, help="of the moments (default 1)")
    arguments = parser.parse_args()
    median, late = step_cost_us()
    print(f"one judgement: {median:.0f} µs median, {late:.0f} µs at 99 %", file=sys.stderr)
    rows = measure(SafetyLimits(), arguments.seed)
    never = [row[:2] for row in rows if not row[-1] < LONGEST_S]
    if never:
        print(f"no reaction at all: {never}", file=sys.stderr)
        return 1
    if arguments.write:
        put_block("reaction times", as_table(rows))
    else:
        print(as_table(rows), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
