#!/usr/bin/env python3
"""What `companion serve` costs those between whom it stands: delay and loss of messages that are passed on.

    python scripts/bench/serve.py [--seconds 10] [--rate 5000] [--clients 3] [--fifo] [--json]

An autopilot and a client, a process each, send one another `--rate` messages a second at once, straight and through the
forwarder in turns of a second, so that what else the machine does falls on both; the difference is what to look at. The
other clients listen.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import socket
import struct
import subprocess
import sys
import time

import numpy as np

HERE = "127.0.0.1"
TURN_S = 1.0
_STAMP = struct.Struct("<d")
_HEAD = bytes([0xFD, 9 + 8, 0, 0, 0, 1, 1, 0xFE, 0xFF, 0x7F])  # of a message that no dialect has
_SETTLE_S = 0.3


def peer(port: int, to: int, rate: float, seconds: float, greet: bool) -> None:
    """Send stamped messages to `to` and note when those of the other side come; prints the delays in s as JSON."""
    from companion.mavlink.layouts import mav

    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    wire.bind((HERE, port))
    wire.setblocking(False)
    kind = (2, 12, 81, 0, 4, 3) if greet else (6, 8, 0, 0, 0, 3)
    codec = mav.MAVLink(None, srcSystem=1 if greet else 245, srcComponent=1 if greet else 190)
    beat = mav.MAVLink_heartbeat_message(*kind).pack(codec)
    arrivals = select.poll()
    arrivals.register(wire, select.POLLIN)
    begun = time.monotonic()
    delays: list[float] = []
    sent, beat_due = 0, 0.0
    while (now := time.monotonic()) < begun + seconds + 2 * _SETTLE_S:
        try:
            while True:
                data = wire.recv(2048)
                if len(data) == len(_HEAD) + 19:
                    delays.append(time.monotonic() - _STAMP.unpack_from(data, len(_HEAD))[0])
        except OSError:
            pass
        if now >= beat_due:
            beat_due = now + 0.5
            wire.sendto(beat, (HERE, to))
        due = round((now - begun - _SETTLE_S) * rate) if now < begun + _SETTLE_S + seconds else sent
        for _ in range(min(due - sent, 50)):
            body = _STAMP.pack(time.monotonic()) + bytes(9)
            try:
                wire.sendto(_HEAD + body + b"\x12\x34", (HERE, to))
            except OSError:
                continue
            sent += 1
        arrivals.poll(0 if due > sent else 1e3 / rate + 0.1)
    print(json.dumps({"sent": sent, "delays": delays}))


def turn(rate: float, seconds: float, through: bool, clients: int, fifo: bool) -> list[dict]:
    """Both directions of one turn: what was sent, and the delays of what came."""
    ports = free_ports(2 + clients)
    vehicle, client, served = ports[0], ports[1], ports[2:]
    words = [sys.executable, __file__, "--rate", str(rate), "--seconds", str(seconds), "--peer"]
    forwarder = None
    if through:
        listening = free_ports(1)[0]
        doors = [f"{HERE}:{client}", *(f"{HERE}:{port}" for port in served[1:])]
        forwarder = subprocess.Popen(
            [sys.executable, __file__, "--forward", f"udpin:{HERE}:{listening}", *doors]
            + (["--fifo"] if fifo else []),
            stdout=subprocess.PIPE,
            text=True,
        )
        assert forwarder.stdout is not None
        forwarder.stdout.readline()
        listeners = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in served[1:]]
        for listener, port in zip(listeners, served[1:], strict=True):
            listener.bind((HERE, port))
        to_vehicle, to_client = int(forwarder.stdout.readline()), listening
    else:
        to_vehicle, to_client, listeners = vehicle, client, []
    processes = [
        subprocess.Popen([*words, f"{vehicle},{to_client},1"], stdout=subprocess.PIPE, text=True),
        subprocess.Popen([*words, f"{client},{to_vehicle},0"], stdout=subprocess.PIPE, text=True),
    ]
    if fifo:
        for process in processes:
            os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(60))
    told = [json.loads(process.communicate()[0]) for process in processes]
    if forwarder is not None:
        forwarder.terminate()
        forwarder.wait()
    for listener in listeners:
        listener.close()
    return [
        {"sent": told[0]["sent"], "delays": told[1]["delays"]},
        {"sent": told[1]["sent"], "delays": told[0]["delays"]},
    ]


def forward(endpoint: str, clients: list[str]) -> None:
    """Be the forwarder; says the port of its first client."""
    from companion.mavlink.endpoint import parse_endpoint
    from companion.mavlink.transport import UdpTransport
    from companion.serve.client_wires import open_door
    from companion.serve.forwarder import Forwarder

    doors = [open_door(f"udpout:{client}") for client in clients]
    forwarder = Forwarder(UdpTransport(parse_endpoint(endpoint)), doors, print)
    file = doors[0].clients[0].fileno()
    with socket.fromfd(file, socket.AF_INET, socket.SOCK_DGRAM) as wire:
        print(f"ready\n{wire.getsockname()[1]}", flush=True)
    while True:
        forwarder.step()


def free_ports(count: int) -> list[int]:
    """UDP ports that nobody has."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for each in sockets:
        each.bind((HERE, 0))
    ports = [int(each.getsockname()[1]) for each in sockets]
    for each in sockets:
        each.close()
    return ports


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="of each way, straight and through us")
    parser.add_argument("--rate", type=float, default=5000.0, help="messages a second, each way")
    parser.add_argument("--clients", type=int, default=3)
    parser.add_argument("--fifo", action="store_true", help="real-time scheduling, as a flight has")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--peer", help=argparse.SUPPRESS)
    parser.add_argument("--forward", nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.peer is not None:
        port, to, greet = (int(word) for word in arguments.peer.split(","))
        peer(port, to, arguments.rate, arguments.seconds, bool(greet))
        return
    if arguments.forward is not None:
        if arguments.fifo:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
        forward(arguments.forward[0], arguments.forward[1:])
        return
    found: dict[str, dict[str, float]] = {}
    turns: dict[bool, list[dict]] = {False: [], True: []}
    for _ in range(round(arguments.seconds / TURN_S)):
        for through, kept in turns.items():
            kept += turn(arguments.rate, TURN_S, through, arguments.clients, arguments.fifo)
    for through, kept in turns.items():
        delays_ms = 1e3 * np.concatenate([each["delays"] for each in kept])
        p50, p99 = np.percentile(delays_ms, (50, 99))
        sent = sum(each["sent"] for each in kept)
        found["through serve" if through else "straight"] = {
            "sent": sent,
            "lost": sent - len(delays_ms),
            "p50_ms": round(float(p50), 3),
            "p99_ms": round(float(p99), 3),
            "longest_ms": round(float(delays_ms.max()), 3),
        }
    added = found["through serve"]["p99_ms"] - found["straight"]["p99_ms"]
    if arguments.json:
        print(json.dumps({**found, "added_p99_ms": round(added, 3)}, indent=2))
        return
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; {arguments.rate:.0f} messages/s each way, "
          f"{arguments.clients} clients")  # fmt: skip
    for name, f in found.items():
        print(f"{name:14} {f['sent']} sent, {f['lost']} lost; delay p50 {f['p50_ms']:.3f} ms, p99 {f['p99_ms']:.3f} ms, "
              f"longest {f['longest_ms']:.3f} ms")  # fmt: skip
    print(f"added at p99: {added:.3f} ms")


if __name__ == "__main__":
    main()
