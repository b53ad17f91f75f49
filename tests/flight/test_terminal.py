"""The terminal dies, fills or is stopped in flight, and stays so: the flight goes on, and its end is told truly."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import subprocess
import sys

import pytest
from stub_flights import lockstep_stub

from companion.flightlog.reader import read_log

pytestmark = pytest.mark.flight
CTRL_S = b"\x13"
START = """
import fcntl, sys, termios
if sys.stdin.isatty():
    fcntl.ioctl(0, termios.TIOCSCTTY)
from companion.cli.main import main
sys.exit(main())
"""
"""A terminal is the process's own, so that its end is a SIGHUP."""


def until_tracking(descriptor: int) -> None:
    heard = b""
    while b"[track]" not in heard:
        piece = os.read(descriptor, 4096)
        assert piece, heard.decode()
        heard += piece


@pytest.mark.parametrize("firmware", ["px4", "ardupilot"])
@pytest.mark.parametrize("end", ["pipe gone", "pipe full", "terminal closed", "terminal stopped"])
def test_a_flight_outlives_its_terminal(tmp_path, firmware, end):
    """Both results and words go there; the table after the flight meets the same."""
    terminal = end.startswith("terminal")
    ours, theirs = pty.openpty() if terminal else os.pipe()
    if end == "pipe full":
        fcntl.fcntl(theirs, fcntl.F_SETPIPE_SZ, 4096)
        os.write(theirs, bytes(4096))
    with lockstep_stub(firmware=firmware) as stub:
        words = ["fly", "--endpoint", stub.endpoint, "--log", "flight.mcap", "--fix", "--trajectory", "hover"]
        words += ["--duration", "2", "--set", "flight.procedure.hold_s=0.2"]
        words += ["--set", "flight.takeoff_height_m=1.0", "--set", "flight.procedure.connect_timeout_s=120"]
        flying = subprocess.Popen(
            [sys.executable, "-c", START, *words],
            cwd=tmp_path,
            stdin=theirs if terminal else subprocess.DEVNULL,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
        )
        try:
            os.close(theirs)
            if end != "pipe full":
                until_tracking(ours)
            if end == "terminal stopped":
                os.write(ours, CTRL_S)
            elif end != "pipe full":
                os.close(ours)  # a terminal's end is a SIGHUP, too
            if end == "pipe gone":
                for each in (signal.SIGHUP, signal.SIGTSTP, signal.SIGTTOU):
                    flying.send_signal(each)
            assert flying.wait(120.0) == 0
        finally:
            flying.kill()
            flying.wait()
    if end in ("pipe full", "terminal stopped"):
        os.close(ours)
    record = read_log(tmp_path / "flight.mcap")
    assert record.cut == ""
    assert record.events_of("ended")[-1].fields["outcome"] == "completed"
    assert record.events_of("ended")[-1].fields["text"].startswith("flown as planned, landed and disarmed")
    assert [event.fields["armed"] for event in record.events_of("armed")] == [True, False]
    assert record.events_of("phase")[-1].fields["phase"] == "done"
