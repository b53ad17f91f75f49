#!/usr/bin/env python3
"""How well references of another program are flown: the report's lemniscate streamed to a flight of the stub in lockstep.

    python scripts/bench/live_references.py [--firmware px4] [--seconds 24] [--json]

Each row is one flight; its error is that of the true position against what the client asks for then (built in: against
the plan), from 6 s after the first point on. The budget is the issue's: over that of the built-in trajectory for p, v, a at
most 1.1 times, for positions alone 2 times, and with loss, jitter and reordering at most 0.1 m more.
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from companion.config.settings import load_settings
from companion.control.structs import Vector
from companion.flight.reporter import Reporter
from companion.flight.session import SessionOptions, fly
from companion.flightlog.reader import FlightRecord, read_log
from companion.mavlink.connection import Connection
from companion.mavlink.endpoint import parse_endpoint
from sitl_stub import Stub

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from tests.flight.live_client import LEAD_IN_S, Streamer, as_json, as_mavlink, streaming

WORSE = {"loss": 0.05, "jitter_s": 0.04}
ROWS: list[tuple[str, str, str, dict[str, float], float, float]] = [
    # name, kind, what is sent, the network, times the built-in RMS at most, metres more at most
    ("UDP, p v a", "udp", "pvayt", {}, 1.1, 0.0),
    ("MAVLink, p v a", "mavlink", "pvayt", {}, 1.1, 0.0),
    ("MAVLink, p v a, no times", "mavlink", "pvay", {}, 1.1, 0.0),
    ("UDP, p v", "udp", "pvyt", {}, 1.1, 0.0),
    ("UDP, positions alone", "udp", "pt", {}, 2.0, 0.0),
    ("MAVLink, positions alone", "mavlink", "pt", {}, 2.0, 0.0),
    ("UDP, p v a, 5 % loss, 40 ms jitter", "udp", "pvayt", WORSE, 1.0, 0.1),
    ("UDP, positions alone, 5 % loss, 40 ms jitter", "udp", "pt", WORSE, 1.0, 0.1),
    ("MAVLink, p v a, no times, 5 % loss, 40 ms jitter", "mavlink", "pvay", WORSE, 1.0, 0.1),
]


def one_flight(
    firmware: str, trajectory: str, duration_s: float, folder: Path, streamer: Streamer | None
) -> FlightRecord:
    """Fly once. Raises SystemExit where the flight ended early."""
    profile = "arducopter_sitl" if firmware == "ardupilot" else "qball2"
    log = folder / "live.mcap"
    overrides = [
        "flight.procedure.connect_timeout_s=300",
        "flight.procedure.hold_s=1",
        "flight.control_rate_hz=100",
    ]
    settings = load_settings(
        profile, {"trajectory": trajectory, "duration_s": duration_s, "seed": 1}, overrides
    )
    with (
        Stub(firmware, seed=1, lockstep=True) as stub,
        streaming(streamer.pump if streamer else lambda *_: None),
    ):
        options = SessionOptions(
            Connection(parse_endpoint(stub.endpoint)), log, overwrite=True, fix=True, real_time=False
        )
        result = fly(settings, options, Reporter())
    if result.outcome.exit_code:
        raise SystemExit(f"{trajectory}: the flight ended early: {result.text}")
    return read_log(log)


def rms_m(errors_m: Vector) -> float:
    return float(np.sqrt((errors_m**2).mean()))


def built_in_errors_m(record: FlightRecord) -> Vector:
    """(n,) distances of the true position from the reference while tracking, from LEAD_IN_S on."""
    truth, reference = record.channels["/truth"], record.channels["/reference"]
    begun_s, ended_s = (event.time_s for event in record.events_of("tracking"))
    chosen = (truth.time_s > begun_s + LEAD_IN_S) & (truth.time_s < ended_s)
    times = truth.time_s[chosen]
    asked = np.stack([np.interp(times, reference.time_s, p) for p in reference["position_enu"].T], axis=1)
    found: Vector = np.linalg.norm(truth["position_enu"][chosen] - asked, axis=1)
    return found


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--firmware", default="px4", choices=("px4", "ardupilot"))
    parser.add_argument("--seconds", type=float, default=24.0, help="of tracking that count")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    duration_s = LEAD_IN_S + arguments.seconds
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        built_in_m = rms_m(
            built_in_errors_m(one_flight(arguments.firmware, "lemniscate", duration_s, folder, None))
        )
        for row, kind, what, network, times, more_m in ROWS:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind(("127.0.0.1", 0))
                port = probe.getsockname()[1]
            message = as_json(what) if kind == "udp" else as_mavlink(what)
            streamer = Streamer(port, message, **network)
            record = one_flight(arguments.firmware, f"live:{kind}:{port}", duration_s, folder, streamer)
            error_m = rms_m(streamer.errors_m(record, LEAD_IN_S))
            within = error_m <= times * built_in_m + more_m
            found.append({"row": row, "rms_m": error_m, "times": error_m / built_in_m, "within": within})
            if not arguments.json:
                if len(found) == 1:
                    print(f"{'built in':50} {built_in_m:7.4f} m")
                print(
                    f"{row:50} {error_m:7.4f} m  {error_m / built_in_m:5.2f} times  {'' if within else 'TOO MUCH'}",
                    flush=True,
                )
    if arguments.json:
        print(json.dumps({"built_in_m": built_in_m, "rows": found}))
    if not all(row["within"] for row in found):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
