#!/usr/bin/env python3
"""What logging costs, and what a SIGKILL loses: our writer beside foxglove-sdk's and the mcap package's.

    python scripts/bench/log_writer.py [--seconds 8] [--kills 20]

Three questions, each in its own process: what one record costs the thread that logs it; how late a 250 Hz loop
wakes and how long its step takes while another thread writes; how much a SIGKILL at a random moment costs.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from pathlib import Path

import numpy as np

RATE_HZ = 250
WIDTHS = (15, 19, 13, 70, 60, 60, 4)  # state, reference, setpoint, terms, two networks, timing
FRAMES_PER_STEP = 5
WRITERS = ("none", "ours", "foxglove", "mcap")


class Nothing:
    """Logs nothing: what the loop does by itself."""

    def record(self, number, time_s, values):
        pass

    def mavlink(self, time_s, frame):
        pass

    def close(self):
        pass


class Ours(Nothing):
    """companion.flightlog."""

    def __init__(self, path):
        from companion.flightlog.channels import ChannelSpec, FieldSpec
        from companion.flightlog.writer import FlightLog

        self.log = FlightLog(path, overwrite=True)
        self.channels = [
            self.log.define(ChannelSpec(f"/c{i}", (FieldSpec("values", width),)))
            for i, width in enumerate(WIDTHS)
        ]

    def record(self, number, time_s, values):
        self.log.record(self.channels[number], time_s, values)

    def mavlink(self, time_s, frame):
        self.log.mavlink("in", time_s, frame)

    def close(self):
        self.log.close()


class Queued(Nothing):
    """The same queue and thread in front of another library's writer."""

    def __init__(self):
        self.queue, self.stop = deque(), threading.Event()
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def record(self, number, time_s, values):
        self.queue.append((number, time_s, values.tobytes()))

    def mavlink(self, time_s, frame):
        self.queue.append((len(WIDTHS), time_s, frame))

    def run(self):
        while not self.stop.wait(0.05):
            self.drain()
        self.drain()

    def drain(self):
        for _ in range(len(self.queue)):
            number, time_s, body = self.queue.popleft()
            self.write(number, round(time_s * 1e9), b"\0\1\0\0" + struct.pack("<d", time_s) + body)
        self.flush()

    def close(self):
        self.stop.set()
        self.thread.join()
        self.finish()


class Foxglove(Queued):
    """foxglove-sdk's writer (Rust)."""

    def __init__(self, path):
        import foxglove

        Path(path).unlink(missing_ok=True)
        self.context = context = foxglove.Context()  # the writer does not keep it alive
        self.writer = foxglove.open_mcap(str(path), context=context)
        schema = foxglove.Schema(name="a", encoding="ros2msg", data=b"float64[15] values")
        names = [f"/c{i}" for i in range(len(WIDTHS) + 1)]
        self.channels = [
            foxglove.Channel(name, message_encoding="cdr", schema=schema, context=context) for name in names
        ]
        super().__init__()

    def write(self, number, time_ns, data):
        self.channels[number].log(data, log_time=time_ns)

    def flush(self):
        self.writer.flush()

    def finish(self):
        self.writer.close()


class McapPackage(Queued):
    """The mcap package's writer (Python)."""

    def __init__(self, path):
        from mcap.writer import Writer

        self.writer = Writer(str(path))
        self.writer.start()
        schema = self.writer.register_schema("a", "ros2msg", b"float64[15] values")
        self.channels = [
            self.writer.register_channel(f"/c{i}", "cdr", schema) for i in range(len(WIDTHS) + 1)
        ]
        super().__init__()

    def write(self, number, time_ns, data):
        self.writer.add_message(self.channels[number], time_ns, data, time_ns)

    def flush(self):
        self.writer.flush()

    def finish(self):
        self.writer.finish()


def make(name, path):
    return (
        Nothing() if name == "none" else {"ours": Ours, "foxglove": Foxglove, "mcap": McapPackage}[name](path)
    )


def fly(name, path, seconds, announce):
    """Run a loop as a flight does; print what it cost, or announce every step on stdout."""
    log = make(name, path)
    rng = np.random.default_rng(0)
    records = [rng.normal(size=width) for width in WIDTHS]
    frame = bytes(rng.integers(0, 256, 44, dtype=np.uint8))
    steps = int(seconds * RATE_HZ)
    late, cost = np.zeros(steps), np.zeros(steps)
    if announce:
        os.write(1, bytes(8))
    start = time.perf_counter()
    cpu = time.process_time()
    for i in range(steps):
        due = start + i / RATE_HZ
        while (left := due - time.perf_counter()) > 0:
            time.sleep(left)
        begun = time.perf_counter()
        now = begun - start
        for number, values in enumerate(records):
            values[0] = now
            log.record(number, now, values)
        for _ in range(FRAMES_PER_STEP):
            log.mavlink(now, frame)
        late[i], cost[i] = begun - due, time.perf_counter() - begun
        if announce:
            os.write(1, struct.pack("<d", now))
    cpu = time.process_time() - cpu
    log.close()
    count = len(WIDTHS) + FRAMES_PER_STEP
    worst = np.percentile
    print(
        json.dumps(
            {
                "writer": name,
                "us_per_record": 1e6 * float(np.median(cost)) / count,
                "step_us_p50_p99_max": [1e6 * float(x) for x in (*worst(cost, [50, 99]), cost.max())],
                "late_us_p50_p99_max": [1e6 * float(x) for x in (*worst(late, [50, 99]), late.max())],
                "cpu_percent": 100 * cpu / seconds,
                "bytes_per_s": (Path(path).stat().st_size if name != "none" else 0) / seconds,
            }
        )
    )


def lost_at_kill(path, rng):
    """Start our writer, kill it, and return what is missing, in seconds."""
    from companion.flightlog.reader import read_log

    command = [sys.executable, __file__, "--child", "ours", str(path), "--announce", "--seconds", "30"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE)
    child.stdout.read(8)
    time.sleep(rng.uniform(0.1, 1.5))
    child.send_signal(signal.SIGKILL)
    said = child.communicate()[0]
    said = said[: len(said) // 8 * 8]
    last = struct.unpack("<d", said[-8:])[0]
    return last - read_log(path).channels["/c0"].time_s[-1]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=8.0, help="of each loop")
    parser.add_argument("--kills", type=int, default=20, help="how often our writer is killed")
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--announce", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        fly(*arguments.child, arguments.seconds, arguments.announce)
        return
    with tempfile.TemporaryDirectory() as folder:
        print(f"{RATE_HZ} Hz, {len(WIDTHS) + FRAMES_PER_STEP} records a step, {sum(WIDTHS)} numbers a step")
        print("writer     µs/record   step µs p50/p99/max      late µs p50/p99/max       CPU %    kB/s")
        for name in WRITERS:
            command = [sys.executable, __file__, "--child", name, f"{folder}/{name}.mcap"]
            out = subprocess.run(
                [*command, "--seconds", str(arguments.seconds)], capture_output=True, check=True, text=True
            )
            found = json.loads(out.stdout)
            step, late = (
                "/".join(f"{x:.0f}" for x in found[f"{key}_us_p50_p99_max"]) for key in ("step", "late")
            )
            print(
                f"{name:10} {found['us_per_record']:8.2f}   {step:22}   {late:22} "
                f"{found['cpu_percent']:8.1f} {found['bytes_per_s'] / 1e3:8.0f}"
            )
        rng = random.Random(1)
        lost = [lost_at_kill(Path(folder) / f"kill{i}.mcap", rng) for i in range(arguments.kills)]
        if lost:
            print(
                f"lost at SIGKILL ({len(lost)} times): median {np.median(lost):.3f} s, worst {max(lost):.3f} s"
            )


if __name__ == "__main__":
    main()
