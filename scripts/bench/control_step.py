#!/usr/bin/env python3
"""What one control step costs: machine code, the same source in Python, and what a flight calls.

    python scripts/bench/control_step.py [--steps 20000] [--json]

Both are measured in one run, interleaved, so that their ratio does not depend on what else the machine does.
`kernel` is the compiled step as called from Python, `inside` the same called from compiled code (the step itself),
`law.step` the call a flight makes, `predict` the prediction before it.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np

from companion.config.settings import load_profile, select_gains
from companion.control.compiled import compiled, python_twin
from companion.control.law import pack_input
from companion.control.laws import LAWS
from companion.control.packing import INPUT, TERMS, memory_dtype
from companion.control.prediction import Predictor
from companion.control.registry import build_law
from companion.control.structs import AdaptationGate, ControlLevel, Reference, VehicleState


def example() -> tuple[VehicleState, Reference]:
    z = np.zeros(3)
    a = np.array([0.4, -0.3, 0.1])
    q = np.array([0.995, 0.05, -0.07, 0.03])
    state = VehicleState(1.0, 0.1 * a, 0.5 * a, q / np.linalg.norm(q), 0.2 * a)
    return state, Reference(z, a, a, a, a, 0.1, 0.0, 0.0)


def seconds_each(call, count: int, rounds: int = 25) -> float:
    """Least over rounds of the mean time of one call: whatever else the machine does only adds."""
    means = []
    for _ in range(rounds):
        start = time.perf_counter()
        for _ in range(count):
            call()
        means.append((time.perf_counter() - start) / count)
    return min(means)


def measure(name: str, level: ControlLevel, steps: int) -> dict[str, float | str]:
    profile = load_profile("qball2")
    law = build_law(name, select_gains(profile, name, level.value), profile, level, seed=1)
    started = time.perf_counter()
    law.warm_up()
    warm_up_s = time.perf_counter() - started
    state, reference = example()
    memory = law.step(law.initial_memory(), state, reference, 0.01, AdaptationGate.RUN).memory
    inputs = pack_input(state, reference, 0.01, AdaptationGate.RUN, law.thrust_bounds_newton).view(INPUT)
    following, terms = np.zeros(1, memory_dtype(law.hidden)), np.zeros(1, TERMS)
    arguments = (law.packed_parameters, memory.packed, inputs, following, terms)
    kernel = law.kernel

    @compiled
    def many(count, p, m, x, m_next, t):
        for _ in range(count):
            kernel(p, m, x, m_next, t)

    many(1, *arguments)
    twin = python_twin(kernel)
    predictor = Predictor(profile, level)
    result = law.step(memory, state, reference, 0.01, AdaptationGate.RUN)
    for k in range(64):
        predictor.sent(0.01 * k + 0.3, result.setpoint)
    return {
        "law": name,
        "level": level.value,
        "warm_up_s": warm_up_s,
        "inside_us": 1e6 * seconds_each(lambda: many(steps // 10, *arguments), 1) / (steps // 10),
        "kernel_us": 1e6 * seconds_each(lambda: kernel(*arguments), steps // 10),
        "python_us": 1e6 * seconds_each(lambda: twin(*arguments), max(20, steps // 500)),
        "law_step_us": 1e6
        * seconds_each(lambda: law.step(memory, state, reference, 0.01, AdaptationGate.RUN), steps // 10),
        "predict_us": 1e6 * seconds_each(lambda: predictor.predict(state), steps // 20),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=20000, help="steps per figure (default: 20000)")
    parser.add_argument("--json", action="store_true", help="print figures as JSON")
    options = parser.parse_args()
    rows = [measure(name, level, max(1000, options.steps)) for name in LAWS for level in ControlLevel]
    if options.json:
        print(json.dumps(rows, indent=2))
        return
    print(
        f"{'law':9}{'level':11}{'inside':>9}{'kernel':>9}{'python':>10}{'ratio':>8}{'law.step':>10}{'predict':>9}   µs"
    )
    for row in rows:
        ratio = row["python_us"] / row["inside_us"]
        print(
            f"{row['law']:9}{row['level']:11}{row['inside_us']:9.2f}{row['kernel_us']:9.2f}{row['python_us']:10.0f}"
            f"{ratio:7.0f}x{row['law_step_us']:10.1f}{row['predict_us']:9.1f}"
        )


if __name__ == "__main__":
    main()
