"""Poses from a source in another process, through the companion, to the autopilot's end of the wire, during a flight."""

import math
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from link_flights import companion, free_port, stub_behind
from pymavlink.dialects.v20 import all as mavlink
from wire_relay import Relay, UdpWire

pytestmark = pytest.mark.flight


@contextmanager
def pose_source(*options: str) -> Iterator[None]:
    command = [sys.executable, "-m", "companion.cli.main", "pose-source", *options]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(10)


def test_a_circle_arrives_in_the_autopilots_frame_and_in_our_time(tmp_path: Path) -> None:
    received: list[mavlink.MAVLink_odometry_message] = []
    codec = mavlink.MAVLink(None)
    codec.robust_parsing = True

    def watch(datagram: bytes) -> list[bytes]:
        received.extend(
            m for m in codec.parse_buffer(bytearray(datagram)) or [] if m.get_type() == "ODOMETRY"
        )
        return [datagram]

    port, pose_port = free_port(), free_port()
    began = time.monotonic()
    with (
        pose_source("--circle", "--to", f"127.0.0.1:{pose_port}", "--rate", "120"),
        stub_behind() as stub_port,
        Relay(stub_port, UdpWire(port), up=watch),
    ):
        flown = companion(f"udpin:127.0.0.1:{port}", tmp_path, outside_poses=("127.0.0.1", pose_port))
    ended = time.monotonic()
    assert flown.outcome == "completed", flown.text
    warned = {f.subject for f in flown.findings if f.verdict.value == "warning"}
    assert (
        "use of poses" in warned
    )  # they are of something else, and this autopilot takes nothing from them: no refusal
    assert any("poses from outside: the first one arrived" in line for line in flown.lines)
    assert len(received) > 30
    times = [m.time_usec * 1e-6 for m in received]
    assert began < times[0] and times[-1] < ended
    assert all(b - a > 0.009 for a, b in pairwise(times))
    assert len(times) < 51.0 * (times[-1] - times[0]) + 2  # 50 Hz of 120
    # Source: ENU (cos a, sin a, 1), a = 2π t / 10 s, nose along the path. NED: north = sin a, east = cos a, and the
    # heading clockwise from north is −a: counter-clockwise circle, heading north where a = 0.
    angles = []
    for m in received:
        assert math.hypot(m.x, m.y) == pytest.approx(1.0, abs=1e-5) and m.z == pytest.approx(-1.0)
        assert (m.frame_id, m.child_frame_id) == (1, 12)
        angle = math.atan2(m.x, m.y)
        heading = 2.0 * math.atan2(m.q[3], m.q[0])
        assert math.remainder(heading + angle, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-4)
        angles.append(angle)
    # By the time stamps the circle is run at its own speed; the mapping of clocks settles within the first seconds.
    turns = [
        math.remainder(b - a - 0.2 * math.pi * (tb - ta), 2.0 * math.pi)
        for (a, b), (ta, tb) in zip(pairwise(angles), pairwise(times), strict=True)
    ]
    assert sorted(abs(t) for t in turns)[int(0.9 * len(turns))] < 2e-3  # 3 ms


def test_the_port_is_told_when_it_is_taken(tmp_path: Path) -> None:
    from companion.config.errors import UserError

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(UserError, match=r"--outside-poses .* is another program listening there"):
            companion(f"udpin:127.0.0.1:{free_port()}", tmp_path, outside_poses=taken.getsockname())
