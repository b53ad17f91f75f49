"""How fast the stub's vehicle is: compiled steps per second, beside the same step in plain NumPy, in one run.

    python scripts/bench/physics.py            table
    python scripts/bench/physics.py --json     figures for a machine

Speeds differ from machine to machine and hour to hour; the ratio to NumPy in the same run is the figure to compare.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable

import numba
import numpy as np

from sitl_stub.physics.estimator import Estimator, advance_estimate
from sitl_stub.physics.rigid_body import advance, advance_batch
from sitl_stub.physics.vehicle import (
    BODY_RATE_FRD,
    RIGID,
    ROTOR_SIGNALS,
    ROTOR_THRUSTS,
    VELOCITY_NED,
    VehicleParameters,
    calm_environment,
    initial_state,
    load_vehicle,
)
from sitl_stub.physics.wind import Wind, advance_wind

DT = 1e-3


def numpy_step(
    x: np.ndarray, signals: np.ndarray, commands: np.ndarray, vehicle: VehicleParameters, dt: float
) -> tuple:
    """The same Runge–Kutta step with small arrays: free flight, lag, drag; no ground, no battery, no wind."""
    lag = vehicle.rotor_lag_rad_s
    middle = commands + (signals - commands) * np.exp(-0.5 * dt * lag)
    end = commands + (signals - commands) * np.exp(-dt * lag)
    allocation = vehicle.allocation_frd()

    def slope(y: np.ndarray, s: np.ndarray) -> np.ndarray:
        w, a, b, c = y[6:10]
        rotation = np.array(
            [
                [1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b)],
                [2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a)],
                [2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)],
            ]
        )
        wrench = allocation @ (vehicle.max_thrust_newton * s)
        force = -vehicle.linear_drag_kg_s * (rotation.T @ y[3:6]) - np.array([0.0, 0.0, wrench[0]])
        rate = y[10:13]
        torque = (
            wrench[1:] - vehicle.angular_drag_kg_m2_s * rate - np.cross(rate, vehicle.inertia_kg_m2 * rate)
        )
        spin = np.array([[-a, -b, -c], [w, -c, b], [c, w, -a], [-b, a, w]])
        acceleration = rotation @ force / vehicle.mass_kg + np.array([0.0, 0.0, vehicle.gravity_m_s2])
        return np.concatenate([y[3:6], acceleration, 0.5 * spin @ rate, torque / vehicle.inertia_kg_m2])

    k1 = slope(x, signals)
    k2 = slope(x + 0.5 * dt * k1, middle)
    k3 = slope(x + 0.5 * dt * k2, middle)
    k4 = slope(x + dt * k3, end)
    x = x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    x[6:10] /= np.linalg.norm(x[6:10])
    return x, end


def rate(run: Callable[[], object], count: int, repeats: int = 5) -> float:
    """Best of `repeats` runs, in counts per second: the least disturbed one."""
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        best = min(best, time.perf_counter() - start)
    return count / best


@numba.njit(cache=True)
def _many_estimates(estimate, memory, delay_line, settings, random, state, count):  # type: ignore[no-untyped-def]
    for _ in range(count):
        advance_estimate(estimate, memory, delay_line, settings, random, state)


@numba.njit(cache=True)
def _many_winds(wind, random, state, environment, count):  # type: ignore[no-untyped-def]
    for _ in range(count):
        advance_wind(wind, random, state, environment, 0.004)


def measure(vehicles: int) -> dict[str, float]:
    """All figures; each compiled function is run once before it is timed."""
    vehicle = load_vehicle("qball2", ground_effect=0.0)
    p, environment = vehicle.packed(), calm_environment(vehicle)
    commands = vehicle.hover_command * np.array([1.0001, 1.0, 0.9999, 1.0])

    def flying(height: float = 1e5) -> np.ndarray:  # so high that it never meets the ground while it is timed
        state = initial_state(vehicle, (0.0, 0.0, -height))
        state[ROTOR_SIGNALS][:4] = commands
        state[VELOCITY_NED], state[BODY_RATE_FRD] = (1.0, 2.0, 0.0), (0.1, 0.0, 0.2)
        return state

    # the two must be the same step, or the ratio means nothing
    state, x, signals = flying(), flying()[RIGID].copy(), commands.copy()
    advance(state, commands, p, environment, DT, 200)
    for _ in range(200):
        x, signals = numpy_step(x, signals, commands, vehicle, DT)
    np.testing.assert_allclose(state[RIGID], x, atol=1e-9)
    assert state[ROTOR_THRUSTS].sum() > 0

    figures: dict[str, float] = {}

    def plain() -> None:
        y, s = flying()[RIGID].copy(), commands.copy()
        for _ in range(500):
            y, s = numpy_step(y, s, commands, vehicle, DT)

    figures["numpy_steps_per_s"] = rate(plain, 500)
    figures["steps_per_s"] = rate(lambda: advance(flying(), commands, p, environment, DT, 200_000), 200_000)
    effect = vehicle.packed()
    effect[16], effect[14] = 1.0, 0.05
    figures["steps_per_s_ground_effect_rotor_drag"] = rate(
        lambda: advance(flying(), commands, effect, environment, DT, 200_000), 200_000
    )
    resting = initial_state(vehicle)
    figures["steps_per_s_at_rest"] = rate(
        lambda: advance(resting, 0.3 * commands, p, environment, DT, 200_000), 200_000
    )
    state = flying()

    def called_each_step() -> None:
        for _ in range(20_000):
            advance(state, commands, p, environment, DT, 1)

    figures["steps_per_s_called_from_python"] = rate(called_each_step, 20_000)

    states = np.stack([flying(1e5 + i) for i in range(vehicles)])
    rows = (np.tile(commands, (vehicles, 1)), np.tile(p, (vehicles, 1)), np.tile(environment, (vehicles, 1)))
    advance_batch(states, *rows, DT, 1)
    figures["vehicles"] = vehicles
    figures["threads"] = numba.get_num_threads()
    figures["batch_steps_per_s"] = rate(lambda: advance_batch(states, *rows, DT, 200), 200 * vehicles, 3)

    estimator = Estimator("mocap", 1)
    _many_estimates(*estimator.arguments, state, 1)
    figures["estimates_per_s"] = rate(lambda: _many_estimates(*estimator.arguments, state, 50_000), 50_000)
    wind = Wind((5.0, 0.0, 0.0), 8.0, 1)
    _many_winds(wind.wind, wind.random, state, environment, 1)
    figures["winds_per_s"] = rate(
        lambda: _many_winds(wind.wind, wind.random, state, environment, 50_000), 50_000
    )
    figures["ratio_to_numpy"] = figures["steps_per_s"] / figures["numpy_steps_per_s"]
    return figures


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vehicles", type=int, default=2000, help="rows of the batch (default 2000)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    figures = measure(arguments.vehicles)
    if arguments.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name:40} {value:14,.1f}")


if __name__ == "__main__":
    main()
