"""The command `sitl-stub`: an autopilot with a vehicle inside, on loopback sockets.

The sockets are open and the ready line is printed before numba is loaded, so that a caller waits milliseconds; time
starts when the compiled loops are there.
"""

from __future__ import annotations

import argparse
import functools
import gc
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from types import FrameType
from typing import TYPE_CHECKING

from sitl_stub.stub_process import watch_parent

if TYPE_CHECKING:
    from sitl_stub.faults.scenario import Scenario, Target
    from sitl_stub.firmware.autopilot import Autopilot
    from sitl_stub.mavlink.codec import LinkCounters
    from sitl_stub.mavlink.links import Port
    from sitl_stub.physics.vehicle import VehicleParameters
    from sitl_stub.server import Server

FIRMWARES = ("px4", "px4-1.13", "ardupilot")
VEHICLES = {"ardupilot": "arducopter"}
"""The vehicle of a firmware when none is asked for; qball2 for the others."""
ONBOARD_REMOTE, ONBOARD_LOCAL = "127.0.0.1:14540", 14580
GCS_REMOTE, GCS_LOCAL = "127.0.0.1:14550", 18570
ARDUPILOT_TCP = "127.0.0.1:5760"

EXAMPLES = """examples:
  sitl-stub                                    PX4 with the report's vehicle; speaks to udp 14540 and 14550, as PX4 does
  sitl-stub --lockstep --seed 3 --exit-on-disarm
                                               as fast as the client answers TIMESYNC, the same bits every time
  sitl-stub --tcp 127.0.0.1:5760 --speed 4     a TCP server, four times real time
  sitl-stub --udp 127.0.0.1:15000@0 --json     own free port, one JSON line when the sockets are open
  sitl-stub --firmware px4-1.13                the last PX4 that took actuator controls
  sitl-stub --firmware ardupilot               ArduCopter 4.7: a TCP server on 5760, and speaks to udp 14550
  sitl-stub --firmware ardupilot --ready-after 1 --param GUID_OPTIONS=8
  sitl-stub --vehicle px4_sih --estimator gps --wind 4,1.5 --param MC_ROLL_P=6
  sitl-stub --scenario faults.toml --seed 7    what goes wrong when, from a file (docs/faults.md)
  sitl-stub --list-faults                      every fault with its parameters, units and defaults
  sitl-stub --port 0 --json                    free ports throughout; the client's endpoint is in the line
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sitl-stub",
        description="A stand-in autopilot in pure Python: PX4's or ArduCopter's behaviour on the wire, "
        "a 6-DOF multirotor inside.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    vehicle = parser.add_argument_group("vehicle")
    vehicle.add_argument(
        "--firmware",
        choices=FIRMWARES,
        default="px4",
        help="whose behaviour (default px4: 1.17; ardupilot: Copter 4.7)",
    )
    vehicle.add_argument(
        "--vehicle",
        metavar="NAME",
        help="qball2, px4_sih, arducopter or a .toml file (default qball2; arducopter for ArduPilot)",
    )
    vehicle.add_argument(
        "--mass", type=float, metavar="KG", help="true mass, where it differs from the vehicle's file"
    )
    vehicle.add_argument(
        "--estimator", default="mocap", metavar="PRESET", help="mocap, gps or perfect (default mocap)"
    )
    vehicle.add_argument("--seed", type=int, default=0, help="of noise and gusts (default 0)")
    vehicle.add_argument(
        "--wind",
        default="0",
        metavar="MEAN[,GUST]",
        help="m/s from the south, and strength of gusts (default 0)",
    )
    vehicle.add_argument(
        "--param", action="append", default=[], metavar="NAME=VALUE", help="set a parameter; may be repeated"
    )
    vehicle.add_argument(
        "--ready-after",
        type=float,
        metavar="S",
        help="simulated time until ready to fly (default as the firmware: 1 s, PX4 with GPS 4.2 s, ArduPilot 42 s)",
    )
    links = parser.add_argument_group("links (default: --udp 127.0.0.1:14540@14580 and ground station 14550)")
    links.add_argument(
        "--udp",
        action="append",
        default=[],
        metavar="HOST:PORT[@LOCAL]",
        help="send to this client first, as PX4 does",
    )
    links.add_argument(
        "--gcs",
        action="append",
        default=[],
        metavar="HOST:PORT[@LOCAL]",
        help="the same, with ground-station rates",
    )
    links.add_argument(
        "--udp-server", action="append", default=[], metavar="HOST:PORT", help="wait for clients on UDP"
    )
    links.add_argument(
        "--tcp", action="append", default=[], metavar="HOST:PORT", help="wait for clients on TCP"
    )
    links.add_argument(
        "--port", type=int, choices=[0], help="0: one onboard UDP link on free ports (see the ready line)"
    )
    pace = parser.add_argument_group("time")
    pace.add_argument("--speed", type=float, default=1.0, help="simulated seconds per second (default 1)")
    pace.add_argument(
        "--lockstep", action="store_true", help="simulated time waits for the client's TIMESYNC answers"
    )
    pace.add_argument("--duration", type=float, metavar="S", help="stop after this much simulated time")
    pace.add_argument(
        "--exit-on-disarm", action="store_true", help="stop when disarmed after having been armed"
    )
    faults = parser.add_argument_group("faults")
    faults.add_argument("--scenario", metavar="FILE.toml", help="faults and their times")
    faults.add_argument("--list-faults", action="store_true", help="print every kind of fault, and stop")
    faults.add_argument(
        "--control",
        action="store_true",
        help='take faults as JSON lines on standard input: {"inject": "link_loss", "for_s": 2}, {"clear": true}',
    )
    parser.add_argument("--json", action="store_true", help="print the ready line and the summary as JSON")
    # The parent says who it is: one that is killed while this starts is no longer to be found out afterwards.
    parser.add_argument(
        "--die-with-parent", nargs="?", type=int, const=0, metavar="PID", help=argparse.SUPPRESS
    )
    parser.add_argument("--quiet", action="store_true", help="print the ready line and errors only")
    return parser


class _Stopped(BaseException):
    """A signal while loading. No Exception, so that no library mistakes it for an error of its own."""


class _Refusal(Exception):
    """A wrong argument: one line, exit code 2."""


def _split_remote(text: str, default_local: int) -> tuple[str, int]:
    remote, at, local = text.partition("@")
    if not at:
        return remote, default_local
    if not local.isdigit() or int(local) > 65535:
        raise _Refusal(f"{text!r}: after @ comes the stub's own port, 0 for any")
    return remote, int(local)


def open_ports(options: argparse.Namespace) -> list[Port]:
    """Every socket asked for; raises AddressError."""
    from sitl_stub.mavlink.links import (
        AddressError,
        TcpPort,
        UdpPort,
        parse_address,
        reserve_client_port,
    )

    ports: list[Port] = []
    try:
        if options.port == 0:
            ports.append(UdpPort(("127.0.0.1", 0), ("127.0.0.1", reserve_client_port()), "onboard"))
        elif options.udp or options.gcs or options.udp_server or options.tcp:
            pass
        elif options.firmware == "ardupilot":
            ports.append(TcpPort(parse_address(ARDUPILOT_TCP, "--tcp"), "onboard"))
            ports.append(UdpPort(("127.0.0.1", 0), parse_address(GCS_REMOTE, "--udp"), "onboard"))
        else:
            ports.append(
                UdpPort(("127.0.0.1", ONBOARD_LOCAL), parse_address(ONBOARD_REMOTE, "--udp"), "onboard")
            )
            ports.append(UdpPort(("127.0.0.1", GCS_LOCAL), parse_address(GCS_REMOTE, "--gcs"), "gcs"))
        for flag, role, texts in (("--udp", "onboard", options.udp), ("--gcs", "gcs", options.gcs)):
            for text in texts:
                remote_text, local = _split_remote(text, 0)
                remote = parse_address(remote_text, flag)
                own_host = "127.0.0.1" if remote[0].startswith(("127.", "localhost")) else "0.0.0.0"
                ports.append(UdpPort((own_host, local), remote, role))
        for text in options.udp_server:
            ports.append(UdpPort(parse_address(text, "--udp-server"), None, "onboard"))
        for text in options.tcp:
            ports.append(TcpPort(parse_address(text, "--tcp"), "onboard"))
    except AddressError:
        for port in ports:
            port.close()
        raise
    return ports


def _numbers(options: argparse.Namespace) -> tuple[float, float, dict[str, float]]:
    """Mean wind, gust, parameters from the arguments."""
    try:
        parts = [float(part) for part in options.wind.split(",")]
        if not 1 <= len(parts) <= 2 or parts[-1] < 0:
            raise ValueError
    except ValueError:
        raise _Refusal(f"--wind {options.wind!r}: give MEAN or MEAN,GUST in m/s, for example 4,1.5") from None
    parameters: dict[str, float] = {}
    for text in options.param:
        name, equals, value = text.partition("=")
        try:
            parameters[name.strip().upper()] = float(value)
        except ValueError:
            equals = ""
        if not equals:
            raise _Refusal(f"--param {text!r}: give NAME=NUMBER, for example MC_ROLL_P=6")
    if not 0.01 <= options.speed <= 1000:
        raise _Refusal(f"--speed {options.speed}: give a number from 0.01 to 1000")
    if options.ready_after is not None and not 0.0 <= options.ready_after <= 3600.0:
        raise _Refusal(f"--ready-after {options.ready_after}: give seconds from 0 to 3600")
    if options.seed < 0:
        raise _Refusal(f"--seed {options.seed}: must not be negative")
    return parts[0], parts[1] if len(parts) > 1 else 0.0, parameters


def _vehicle(options: argparse.Namespace, parameters: dict[str, float]) -> VehicleParameters:
    """The vehicle; also looks at estimator and parameters, so that a refusal comes before the ready line."""
    from sitl_stub.firmware.ardupilot_parameters import stock_parameters
    from sitl_stub.firmware.parameters import ParameterTable, shipped_parameters
    from sitl_stub.physics.presets import load_preset
    from sitl_stub.physics.vehicle import load_vehicle

    load_preset(options.estimator)
    table: ParameterTable
    if options.firmware == "ardupilot":
        table = stock_parameters()
    else:
        table = ParameterTable(shipped_parameters("px4_parameters.json"))
    for name, value in parameters.items():
        table.set(name, value)
    changes = {} if options.mass is None else {"mass_kg": options.mass}
    return load_vehicle(options.vehicle, **changes)


def _scenario(options: argparse.Namespace, target: Target) -> Scenario | None:
    """The scenario asked for; None where no fault can ever happen. Raises FaultError."""
    from sitl_stub.faults.scenario import Scenario, read_scenario

    if options.scenario is not None:
        return read_scenario(options.scenario, target)
    return Scenario() if options.control else None


def _direct_faults(
    options: argparse.Namespace,
    scenario: Scenario | None,
    target: Target,
    server: Server,
    autopilot: Autopilot,
) -> None:
    """Let the faults at the autopilot, and whoever injects more at the server."""
    if scenario is None:
        return
    from sitl_stub.faults.control import ControlChannel
    from sitl_stub.faults.director import FaultDirector

    director = FaultDirector(autopilot, scenario, options.seed)
    if options.control:
        server.control = ControlChannel(0, director, target, lambda line: print(line, flush=True))


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
        from sitl_stub.firmware.ardupilot_build import build_ardupilot

        return build_ardupilot(*place, options.ready_after)
    from sitl_stub.firmware.px4_build import build_px4

    return build_px4(options.firmware, *place, options.ready_after)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code: 0 done or stopped, 2 wrong arguments."""
    parent = os.getppid()
    options = _parser().parse_args(arguments)
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
        mean, gust, parameters = _numbers(options)
        from sitl_stub.faults.scenario import Target
        from sitl_stub.server import Server

        vehicle = _vehicle(options, parameters)
        target = Target(options.firmware, vehicle)
        scenario = _scenario(options, target)
        ports = open_ports(options)
        server = Server(ports, options.speed, options.lockstep)
        servers.append(server)
        _print_ready(options, ports)
        # Everything that can be refused has been looked at.
        # One that nobody hears compiles what is not in the cache yet: half a minute on a new machine, in which
        # a client that had heard a HEARTBEAT would take the silence for a lost link.
        _build(options, vehicle, mean, gust, parameters).step()
        autopilot = _build(options, vehicle, mean, gust, parameters)
        _direct_faults(options, scenario, target, server, autopilot)
        serving.set()
    except _Stopped:
        for port in ports:
            port.close()
        _print_summary(options, 0.0, 0.0, [])
        return 0
    except (_Refusal, ValueError) as error:
        for port in ports:
            port.close()
        for line in str(error).splitlines():
            print(f"sitl-stub: {line}", file=sys.stderr)
        return 2

    def say(text: str) -> None:
        if not (options.json or options.quiet):
            print(f"[{autopilot.time_us * 1e-6:9.3f}] {text}", flush=True)

    server.say = say
    autopilot.on_text = say
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
