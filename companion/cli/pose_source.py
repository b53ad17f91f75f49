"""`companion pose-source`: stand in for a motion-capture system, for trying `companion fly --outside-poses`."""

from __future__ import annotations

import argparse
import math
import sys
import time
from typing import Any

from companion.cli.fly import system_id
from companion.config.errors import UserError

EPILOG = """examples:
  companion pose-source --truth udpin:127.0.0.1:14550 --to 127.0.0.1:14600     a simulator's true pose
  companion pose-source --circle --to 127.0.0.1:14600 --form json              no simulator: a drawn circle
  companion pose-source --truth udpin:127.0.0.1:14550 --to 127.0.0.1:14600 --noise-mm 2 --latency-ms 15 --drop 0.02

The other side: companion fly --endpoint … --outside-poses 14600. Ctrl-C ends it. docs/links.md has the datagram.
"""


def add_parser(subparsers: Any) -> None:
    """Add the command to `companion`."""
    parser = subparsers.add_parser(
        "pose-source",
        help="stand in for a motion-capture system",
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--truth", metavar="ADDRESS", help="a simulator's MAVLink link with HIL_STATE_QUATERNION"
    )
    parser.add_argument(
        "--system", type=system_id, metavar="N", help="of the simulator, where several are heard"
    )
    what.add_argument("--circle", action="store_true", help="a level circle, 1 m radius, 10 s")
    parser.add_argument("--to", required=True, metavar="HOST:PORT", help="where the poses go")
    parser.add_argument(
        "--rate", type=float, default=100.0, metavar="HZ", help="poses a second (default 100)"
    )
    parser.add_argument("--form", choices=("binary", "json"), default="binary", help="of the datagrams")
    parser.add_argument(
        "--noise-mm", type=float, default=0.0, metavar="MM", help="standard deviation, each axis"
    )
    parser.add_argument(
        "--noise-deg", type=float, default=0.0, metavar="DEG", help="the same of the attitude"
    )
    parser.add_argument("--latency-ms", type=float, default=0.0, metavar="MS", help="datagrams leave so late")
    parser.add_argument("--drop", type=float, default=0.0, metavar="RATIO", help="share that never leaves")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of noise and drops")
    parser.add_argument("--seconds", type=float, default=math.inf, metavar="S", help="end after this time")


def run(arguments: argparse.Namespace) -> int:
    """Send poses until Ctrl-C. Raises UserError for wrong input."""
    from companion.cli.fly import pose_address
    from companion.mavlink.endpoint import parse_endpoint
    from companion.mavlink.pose_source import Imperfection, PoseSender, circle_poses, true_poses
    from companion.mavlink.transport import open_transport

    if not 1.0 <= arguments.rate <= 1000.0:
        raise UserError(f"--rate {arguments.rate:g}: give 1 to 1000 Hz")
    if (
        not 0.0 <= arguments.drop <= 1.0
        or min(arguments.noise_mm, arguments.noise_deg, arguments.latency_ms) < 0.0
    ):
        raise UserError("noise and latency cannot be negative, --drop is a share from 0 to 1")
    target = pose_address(arguments.to, "--to")
    assert target is not None
    flaws = Imperfection(
        arguments.noise_mm * 1e-3,
        math.radians(arguments.noise_deg),
        10.0 * arguments.noise_mm * 1e-3,  # as differences over 0.1 s would have
        arguments.latency_ms * 1e-3,
        arguments.drop,
    )
    transport = open_transport(parse_endpoint(arguments.truth)) if arguments.truth else None
    poses = (
        true_poses(transport, arguments.rate, system=arguments.system)
        if transport
        else circle_poses(arguments.rate)
    )
    sender = PoseSender(target, flaws, arguments.seed, arguments.form == "binary")
    begun_s = time.monotonic()
    told_s = begun_s
    try:
        for pose in poses:
            now_s = time.monotonic()
            if pose is not None:
                sender.add(pose, now_s)
            sender.flush(now_s)
            if now_s - told_s > 5.0:
                told_s = now_s
                _tell(sender.counters["sent"], now_s - begun_s, arguments.truth)
            if now_s - begun_s > arguments.seconds:
                break
    except KeyboardInterrupt:
        pass
    finally:
        sender.close()
        if transport is not None:
            transport.close()
    _tell(sender.counters["sent"], time.monotonic() - begun_s, arguments.truth)
    return 0


def _tell(sent: int, elapsed_s: float, truth: str | None) -> None:
    nothing = f"; nothing with HIL_STATE_QUATERNION arrives at {truth}" if truth and not sent else ""
    print(f"{sent} poses in {elapsed_s:.0f} s{nothing}", file=sys.stderr, flush=True)
