#!/usr/bin/env python3
"""What a stranger's flood does to a flight: 50,000 frames a second from another address, with the autopilot's own ids.

    python scripts/bench/flood.py [--seconds 60] [--rate 50000] [--at link] [--fifo] [--without-filter] [--json]

One flight against the stub in real time. The flood is on and off in turns of 2 s, so that what else the machine does falls
on both; the ratio is what to look at. `--without-filter` shows what the kernel's filter of senders is for.

`--at references` floods the port of `--trajectory live:udp:…` instead, whose client streams 50 points a second meanwhile;
`--at client` is that client itself run wild: 50,000 good points a second.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

TURN_S = 2.0
SETTLING_S = 0.2  # after each change
PAUSE_S = 0.002
LONGEST_BATCH_S = 0.02  # what is not sent for longer is not made up for


def flood(port: int, rate: float, at: str) -> None:
    """Send to `port` while stdin's last byte is `1`; says at the end how many a second it were."""
    from pymavlink.dialects.v20 import common as mavlink

    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = bytes(
        mavlink.MAVLink_attitude_quaternion_message(99_000, 0.0, 1.0, 0.0, 0.0, 9.0, 9.0, 9.0).pack(codec)
    )
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.connect(("127.0.0.1", port))
    client.connect(("127.0.0.1", port))
    client.setblocking(False)

    def point() -> bytes:
        return b'{"time": %.9f, "position": [0, 0, 1], "velocity": [0, 0, 0]}' % time.perf_counter()

    streamed = 0.0
    orders = sys.stdin.buffer
    os.set_blocking(orders.fileno(), False)
    on, sent, spent, since, due = False, 0, 0.0, 0.0, 0
    while True:
        order = orders.read(64)
        if order == b"":
            break
        if order:
            on, since, due = order[-1:] == b"1", time.perf_counter(), 0
        now = time.perf_counter()
        if at != "link" and now - streamed >= 0.02:
            streamed = now
            with contextlib.suppress(OSError):
                client.send(point())
        if on:
            batch = min(round(rate * (now - since)) - due, round(rate * LONGEST_BATCH_S))
            for _ in range(batch):
                try:
                    if at == "client":
                        client.send(point())
                    else:
                        wire.send(frame)
                except OSError:
                    continue
            sent, due = sent + batch, due + batch
        time.sleep(PAUSE_S)
        spent += time.perf_counter() - now if on else 0.0
    print(json.dumps({"sent": sent, "rate_hz": sent / spent if spent else 0.0}))


def _flooded(time_s):
    """Whether the flood is on at a time of the autopilot (or at each of many)."""
    return (time_s // TURN_S) % 2 == 1


def fly(seconds: float, rate: float, fifo: bool, target: str) -> dict:
    """One flight; the figures with and without the flood."""
    from companion.config.settings import load_settings
    from companion.control.structs import VehicleState
    from companion.flight.control_loop import ControlLoop
    from companion.flight.reporter import Reporter
    from companion.flight.session import SessionOptions
    from companion.flight.session import fly as fly_session
    from companion.flightlog.reader import read_log
    from companion.mavlink.connection import Connection
    from companion.mavlink.endpoint import parse_endpoint
    from sitl_stub.stub_process import Stub

    with Stub("px4", seed=1) as stub, tempfile.TemporaryDirectory() as folder:
        port, trajectory = stub.endpoint.rsplit(":", 1)[1], "lemniscate"
        if target != "link":
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind(("127.0.0.1", 0))
                port = str(probe.getsockname()[1])
            trajectory = f"live:udp:{port}"
        words = [sys.executable, __file__, "--flood", port, "--rate", str(rate), "--at", target]
        flooder = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        if fifo:  # the autopilot is another computer, and so is the stranger: neither may wait for what else runs here
            assert stub.process is not None
            os.sched_setscheduler(stub.process.pid, os.SCHED_FIFO, os.sched_param(60))
            os.sched_setscheduler(flooder.pid, os.SCHED_FIFO, os.sched_param(10))
        assert flooder.stdin is not None and flooder.stdout is not None

        answer, on = ControlLoop.on_state, [False]

        def on_state(loop: ControlLoop, state: VehicleState) -> None:
            """The loop's own step; the flood goes on and off by the autopilot's time."""
            if on[0] is not _flooded(state.time_s):
                on[0] = not on[0]
                flooder.stdin.write(b"1" if on[0] else b"0")
                flooder.stdin.flush()
            answer(loop, state)

        ControlLoop.on_state = on_state  # type: ignore[method-assign]
        settings = load_settings("qball2", {"trajectory": trajectory}, [f"flight.duration_s={seconds}"])
        log = Path(folder) / "flood.mcap"
        options = SessionOptions(Connection(parse_endpoint(stub.endpoint)), log, real_time=fifo)
        result = fly_session(settings, options, Reporter())
        flooder.stdin.close()
        told = json.loads(flooder.stdout.read())
        flooder.wait()
        record = read_log(log)
    if result.outcome.exit_code:
        raise SystemExit(f"the flight ended early: {result.text}")
    timing, reference = record.channels["/timing"], record.channels["/reference"]
    tracking = reference.time_s[np.isfinite(reference["tracking_time_s"])]
    at = timing.time_s
    settled = (at > tracking[0] + 1.0) & (at < tracking[-1]) & (at % TURN_S > SETTLING_S)
    with_flood = settled & _flooded(at)
    found = {"outcome": result.outcome.value, "flood_hz": told["rate_hz"], "sent": told["sent"]}
    nominal_s = 1.0 / settings.flight.rate_hz
    for name, chosen in (("quiet", settled & ~with_flood), ("flood", with_flood)):
        period, compute = timing["period_s"][chosen], timing["compute_s"][chosen]
        found[name] = {
            "steps": int(chosen.sum()),
            "period_ms": [round(1e3 * float(q), 3) for q in np.percentile(period, [50, 99])],
            "late_ms_p99": round(1e3 * float(np.percentile(np.abs(period - nominal_s), 99)), 3),
            "compute_ms": [round(1e3 * float(q), 3) for q in np.percentile(compute, [50, 99])],
        }
    found["p99_ratio"] = {
        "period": round(found["flood"]["period_ms"][1] / found["quiet"]["period_ms"][1], 3),
        "compute": round(found["flood"]["compute_ms"][1] / found["quiet"]["compute_ms"][1], 3),
    }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="of tracking")
    parser.add_argument("--rate", type=float, default=50_000.0, help="frames a second")
    parser.add_argument(
        "--at", default="link", choices=("link", "references", "client"), help="what is flooded"
    )
    parser.add_argument(
        "--fifo", action="store_true", help="real-time scheduling: of the flight, and of both peers"
    )
    parser.add_argument(
        "--without-filter", action="store_true", help="drop strangers after reading them only"
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--flood", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.flood is not None:
        flood(arguments.flood, arguments.rate, arguments.at)
        return
    if arguments.without_filter:
        import companion.mavlink.transport

        companion.mavlink.transport.hear_only = lambda *_: False
    found = fly(arguments.seconds, arguments.rate, arguments.fifo, arguments.at)
    if arguments.json:
        print(json.dumps(found, indent=2))
        return
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; flight {found['outcome']}; "
          f"flood {found['flood_hz']:.0f} frames/s, {found['sent']} in all")  # fmt: skip
    for name in ("quiet", "flood"):
        f = found[name]
        print(f"{name}  period p50/p99 {f['period_ms'][0]:.2f}/{f['period_ms'][1]:.2f} ms  "
              f"compute p50/p99 {f['compute_ms'][0]:.3f}/{f['compute_ms'][1]:.3f} ms  {f['steps']} steps")  # fmt: skip
    print(
        f"p99 with / without: period {found['p99_ratio']['period']}, compute {found['p99_ratio']['compute']}"
    )


if __name__ == "__main__":
    main()
