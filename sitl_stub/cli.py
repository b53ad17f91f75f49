"""The command `sitl-stub`: an autopilot with a vehicle inside, on loopback sockets.

The sockets are open and the ready line is printed before NumPy and numba are loaded, so that a caller waits a tenth of a
second; what a client sends meanwhile waits in the sockets. Time starts when the compiled loops are there.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import gc
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from sitl_stub.arguments import ESTIMATORS, VEHICLES, numbers, open_ports, parser
from sitl_stub.stub_process import watch_parent

if TYPE_CHECKING:
    from sitl_stub.faults.scenario import Scenario
    from sitl_stub.firmware.common.autopilot import Autopilot
    from sitl_stub.mavlink.codec import LinkCounters
    from sitl_stub.mavlink.links import Port
    from sitl_stub.physics.vehicle import VehicleParameters
    from sitl_stub.server import Server


class _Stopped(BaseException):
    """A signal while loading. No Exception, so that no library mistakes it for an error of its own."""


def _look_at(
    options: argparse.Namespace, parameters: dict[str, float]
) -> tuple[VehicleParameters | None, Scenario | None]:
    """Whatever may have to be refused, before the ready line; what is surely good is loaded after it.

    Raises ValueError (VehicleError, ParameterError, FaultError).
    """
    if parameters:
        if options.firmware != "ardupilot":
            from sitl_stub.firmware.px4.parameters import stock_parameters
        else:
            from sitl_stub.firmware.ardupilot.parameters import stock_parameters
        table = stock_parameters()
        for name, value in parameters.items():
            table.set(name, value)
    if options.estimator not in ESTIMATORS:
        from sitl_stub.physics.presets import load_preset

        load_preset(options.estimator)
    shipped = (Path(__file__).parent / "physics" / "vehicles" / f"{options.vehicle}.toml").exists()
    if shipped and options.mass is None and options.scenario is None:
        return None, None
    vehicle = _vehicle(options)
    if options.scenario is None:
        return vehicle, None
    from sitl_stub.faults.scenario import Target, read_scenario

    return vehicle, read_scenario(options.scenario, Target(options.firmware, vehicle))


def _vehicle(options: argparse.Namespace) -> VehicleParameters:
    from sitl_stub.physics.vehicle import load_vehicle

    changes = {} if options.mass is None else {"mass_kg": options.mass}
    return load_vehicle(options.vehicle, **changes)


def _direct_faults(
    options: argparse.Namespace,
    scenario: Scenario | None,
    vehicle: VehicleParameters,
    server: Server,
    autopilot: Autopilot,
) -> None:
    """Let the faults at the autopilot, and whoever injects more at the server."""
    if scenario is None and not options.control:
        return
    from sitl_stub.faults.control import ControlChannel
    from sitl_stub.faults.director import FaultDirector
    from sitl_stub.faults.scenario import Scenario, Target

    director = FaultDirector(autopilot, scenario or Scenario(), options.seed)
    if options.control:
        target = Target(options.firmware, vehicle)
        server.control = ControlChannel(0, director, target, lambda line: print(line, flush=True))


@contextlib.contextmanager
def _scipy_out_of_sight() -> Iterator[None]:
    """Keep numba from importing SciPy where it is installed: 0.2 s for products of matrices that no loop here has."""
    if "scipy" in sys.modules:
        yield
        return
    sys.modules["scipy"] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules["scipy"]


def _build(
    options: argparse.Namespace,
    vehicle: VehicleParameters,
    wind: float,
    gust: float,
    parameters: dict[str, float],
) -> Autopilot:
    """The firmware; from here on numba is loaded."""
    place = (vehicle, options.estimator, options.seed, (wind, 0.0, 0.0), gust, parameters)
    if options.firmware == "ardupilot":
        from sitl_stub.firmware.ardupilot.build import build_ardupilot

        return build_ardupilot(*place, options.ready_after)
    from sitl_stub.firmware.px4.build import build_px4

    return build_px4(options.firmware, *place, options.ready_after)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0 done or stopped, 2 wrong arguments."""
    parent = os.getppid()
    options = parser().parse_args(arguments)
    if options.list_faults:
        from sitl_stub.faults.registry import described

        print(described())
        return 0
    if options.vehicle is None:
        options.vehicle = VEHICLES.get(options.firmware, "qball2")
    stopping = threading.Event()
    servers: list[Server] = []

    serving = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stopping.set()
        if not serving.is_set():
            raise _Stopped  # still loading: nothing to finish
        for one in servers:
            one.stop()

    signal.signal(signal.SIGINT, on_signal)
    signal.signal(signal.SIGTERM, on_signal)
    if options.die_with_parent is not None:
        end = functools.partial(os.kill, os.getpid(), signal.SIGTERM)
        watch = (end, options.die_with_parent or parent)
        threading.Thread(target=watch_parent, args=watch, daemon=True).start()
    ports: list[Port] = []
    try:
        mean, gust, parameters = numbers(options)
        looked_at, scenario = _look_at(options, parameters)
        from sitl_stub.server import Server

        ports = open_ports(options)
        server = Server(ports, options.speed, options.lockstep)
        servers.append(server)
        _print_ready(options, ports)
        # Everything that can be refused has been looked at.
        vehicle = looked_at or _vehicle(options)
        with _scipy_out_of_sight():
            # One that nobody hears compiles what is not in the cache yet: half a minute on a new machine, in which
            # a client that had heard a HEARTBEAT would take the silence for a lost link.
            _build(options, vehicle, mean, gust, parameters).step()
        autopilot = _build(options, vehicle, mean, gust, parameters)
        if options.airborne is not None:
            autopilot.take_off_alone(options.airborne)
        _direct_faults(options, scenario, vehicle, server, autopilot)
        serving.set()
    except _Stopped:
        for port in ports:
            port.close()
        _print_summary(options, 0.0, 0.0, [])
        return 0
    except ValueError as error:
        for port in ports:
            port.close()
        for line in str(error).splitlines():
            print(f"sitl-stub: {line}", file=sys.stderr)
        return 2

    def say(text: str) -> None:
        if not (options.json or options.quiet):
            print(f"[{autopilot.time_us * 1e-6:9.3f}] {text}", flush=True)

    server.say = say
    autopilot.voice.on_text = say
    server.duration_us = None if options.duration is None else int(options.duration * 1e6)
    server.exit_on_disarm = options.exit_on_disarm
    if stopping.is_set():
        server.stop()
    wall = time.monotonic()
    try:
        gc.freeze()  # what is loaded now lives to the end: no pass of the collector has to look at it again
        server.run(autopilot)
    finally:
        counters = [link.counters for port in ports for link in port.links]
        server.close()
    _print_summary(options, autopilot.time_us * 1e-6, time.monotonic() - wall, counters)
    return 0


def _print_ready(options: argparse.Namespace, ports: list[Port]) -> None:
    described = [port.describe() for port in ports]
    if options.json:
        line = {
            "ready": True,
            "pid": os.getpid(),
            "firmware": options.firmware,
            "vehicle": options.vehicle,
            "estimator": options.estimator,
            "seed": options.seed,
            "lockstep": options.lockstep,
            "endpoint": described[0]["endpoint"],
            "links": described,
        }
        print(json.dumps(line), flush=True)
        return
    pace = "lockstep" if options.lockstep else f"{options.speed:g} times real time"
    where = ", ".join(str(one["endpoint"]) for one in described)
    print(
        f"sitl-stub ready: {options.firmware}, vehicle {options.vehicle}, estimator {options.estimator}, "
        f"seed {options.seed}, {pace}; client endpoints: {where}",
        flush=True,
    )


def _print_summary(
    options: argparse.Namespace, simulated_s: float, wall_s: float, counters: Sequence[LinkCounters]
) -> None:
    received = sum(one.received for one in counters)
    sent = sum(one.sent for one in counters)
    dropped = sum(one.dropped for one in counters)
    summary = {
        "simulated_s": round(simulated_s, 3),
        "wall_s": round(wall_s, 3),
        "sent": sent,
        "received": received,
        "dropped": dropped,
    }
    try:
        if options.json:
            print(json.dumps(summary), flush=True)
        else:
            ratio = simulated_s / max(wall_s, 1e-3)
            print(
                f"sitl-stub: {simulated_s:.1f} s simulated in {wall_s:.1f} s ({ratio:.1f} times), "
                f"{sent} messages sent, {received} received, {dropped} dropped",
                flush=True,
            )
    except BrokenPipeError:
        pass
