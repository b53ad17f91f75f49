#!/usr/bin/env python3
"""Round trip of a setpoint over loopback UDP: attitude out of a peer, setpoint back, by pymavlink's link and MAVSDK's.

    python scripts/bench/link_round_trip.py [--rounds 4] [--seconds 3] [--rate 250] [--fifo]

The peer is a process of its own that sends ATTITUDE_QUATERNION and waits for the SET_ATTITUDE_TARGET with the same time.
The links take turns within one run, so that what else the machine does falls on both; the ratio is what to look at.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import time

LIBRARIES = ("pymavlink", "mavsdk")


def peer(port: int, seconds: float, rate: float) -> None:
    """Be the autopilot on `port`; prints the round trips in µs as JSON."""
    import select

    from pymavlink.dialects.v20 import common as mavlink

    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.bind(("127.0.0.1", 0))
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    trips, sent = [], {}

    def say(message: object) -> None:
        codec.seq = (codec.seq + 1) % 256
        wire.sendto(message.pack(codec), ("127.0.0.1", port))

    begun = time.perf_counter()
    heartbeat_due = begun
    for k in range(round(seconds * rate)):
        due = begun + k / rate
        while (left := due - time.perf_counter()) > 0.0:
            if not select.select([wire], [], [], left)[0]:
                continue
            arrived = time.perf_counter()
            message = codec.decode(bytearray(wire.recv(2048)))
            if message.get_type() == "SET_ATTITUDE_TARGET" and message.time_boot_ms in sent:
                trips.append((arrived - sent.pop(message.time_boot_ms)) * 1e6)
        if time.perf_counter() >= heartbeat_due:
            heartbeat_due += 1.0
            say(mavlink.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3))
        sent[k] = time.perf_counter()
        say(mavlink.MAVLink_attitude_quaternion_message(k, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3))
    warm = round(rate / 2)  # until both have heard each other
    print(
        json.dumps({"trips": trips[warm:], "lost": len([k for k in sent if warm < k < seconds * rate - 5])})
    )


def measure(library: str, seconds: float, rate: float) -> dict:
    """One turn of one link."""
    from companion.mavlink.connection import Connection, LinkLibrary
    from companion.mavlink.endpoint import parse_endpoint
    from companion.mavlink.link import mav

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    link = Connection(parse_endpoint(f"udpin:127.0.0.1:{port}"), LinkLibrary(library)).open()
    words = [sys.executable, __file__, "--peer", str(port), "--seconds", str(seconds), "--rate", str(rate)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    spent_before = time.process_time()
    while process.poll() is None:
        message = link.receive(0.05)
        if message is None or message.get_msgId() != mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
            continue
        attitude = [message.q1, message.q2, message.q3, message.q4]
        link.send(
            mav.MAVLink_set_attitude_target_message(
                message.time_boot_ms, 1, 1, 7, attitude, 0.0, 0.0, 0.0, 0.5
            )
        )
    spent = time.process_time() - spent_before
    link.close()
    assert process.stdout is not None
    return {**json.loads(process.stdout.read()), "cpu": spent / seconds}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=3.0, help="of one turn")
    parser.add_argument("--rate", type=float, default=250.0, help="states a second")
    parser.add_argument("--fifo", action="store_true", help="with SCHED_FIFO, as a flight has")
    parser.add_argument("--peer", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.peer is not None:
        peer(arguments.peer, arguments.seconds, arguments.rate)
        return
    if arguments.fifo:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    trips: dict[str, list[float]] = {name: [] for name in LIBRARIES}
    lost: dict[str, int] = dict.fromkeys(LIBRARIES, 0)
    cpu: dict[str, list[float]] = {name: [] for name in LIBRARIES}
    for _ in range(arguments.rounds):
        for library in LIBRARIES:
            result = measure(library, arguments.seconds, arguments.rate)
            trips[library] += result["trips"]
            lost[library] += result["lost"]
            cpu[library].append(result["cpu"])
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; {arguments.rate:.0f} Hz")
    quantiles = {}
    for library in LIBRARIES:
        values = sorted(trips[library])
        quantiles[library] = [values[round(q * (len(values) - 1))] for q in (0.5, 0.95, 0.99)]
        p50, p95, p99 = quantiles[library]
        print(
            f"{library:10} p50 {p50:7.0f} µs  p95 {p95:7.0f} µs  p99 {p99:7.0f} µs  "
            f"{len(values)} round trips, {lost[library]} lost, {statistics.mean(cpu[library]) * 100:.0f} % of a core"
        )
    ratios = [b / a for a, b in zip(*(quantiles[name] for name in LIBRARIES), strict=True)]
    print(f"mavsdk / pymavlink: p50 {ratios[0]:.2f}, p95 {ratios[1]:.2f}, p99 {ratios[2]:.2f}")


if __name__ == "__main__":
    main()
