"""The arguments of `sitl-stub`: what they are, and the numbers and sockets they ask for."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sitl_stub.mavlink.links import Port

FIRMWARES = ("px4", "px4-1.13", "ardupilot")
VEHICLES = {"ardupilot": "arducopter"}
"""The vehicle of a firmware when none is asked for; qball2 for the others."""
ESTIMATORS = ("mocap", "gps", "perfect")
"""Presets of the estimator that are surely there (`physics/presets.py`)."""

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
  sitl-stub --vehicle random:7                 one of a family from 0.25 to 35 kg, as a sensible owner tuned it
  sitl-stub --scenario faults.toml --seed 7    what goes wrong when, from a file (docs/faults.md)
  sitl-stub --list-faults                      every fault with its parameters, units and defaults
  sitl-stub --port 0 --json                    free ports throughout; the client's endpoint is in the line
"""


def parser() -> argparse.ArgumentParser:
    """Every option of the command."""
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
        help="qball2, px4_sih, arducopter, random:SEED or a .toml file (default qball2; arducopter for ArduPilot)",
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
    vehicle.add_argument(
        "--airborne",
        type=float,
        metavar="HEIGHT",
        help="begin in the air: armed, in the autopilot's own hold (AUTO.LOITER or LOITER), so many metres up",
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


class Refusal(ValueError):
    """A wrong argument: one line, exit code 2."""


def numbers(options: argparse.Namespace) -> tuple[float, float, dict[str, float]]:
    """Mean wind, gust, parameters from the arguments."""
    try:
        parts = [float(part) for part in options.wind.split(",")]
        if not 1 <= len(parts) <= 2 or parts[-1] < 0:
            raise ValueError
    except ValueError:
        raise Refusal(f"--wind {options.wind!r}: give MEAN or MEAN,GUST in m/s, for example 4,1.5") from None
    parameters: dict[str, float] = {}
    for text in options.param:
        name, equals, value = text.partition("=")
        try:
            parameters[name.strip().upper()] = float(value)
        except ValueError:
            equals = ""
        if not equals:
            raise Refusal(f"--param {text!r}: give NAME=NUMBER, for example MC_ROLL_P=6")
    if not 0.01 <= options.speed <= 1000:
        raise Refusal(f"--speed {options.speed}: give a number from 0.01 to 1000")
    if options.ready_after is not None and not 0.0 <= options.ready_after <= 3600.0:
        raise Refusal(f"--ready-after {options.ready_after}: give seconds from 0 to 3600")
    if options.seed < 0:
        raise Refusal(f"--seed {options.seed}: must not be negative")
    if options.airborne is not None and not 0.5 <= options.airborne <= 100.0:
        raise Refusal(f"--airborne {options.airborne}: give metres from 0.5 to 100")
    return parts[0], parts[1] if len(parts) > 1 else 0.0, parameters


def _split_remote(text: str, default_local: int) -> tuple[str, int]:
    remote, at, local = text.partition("@")
    if not at:
        return remote, default_local
    if not local.isdigit() or int(local) > 65535:
        raise Refusal(f"{text!r}: after @ comes the stub's own port, 0 for any")
    return remote, int(local)


def open_ports(options: argparse.Namespace) -> list[Port]:
    """Every socket asked for; raises AddressError."""
    from sitl_stub.mavlink.links import AddressError, parse_address, reserve_client_port
    from sitl_stub.mavlink.tcp import TcpPort
    from sitl_stub.mavlink.udp import UdpPort

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
