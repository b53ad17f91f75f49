"""The terminal of a flight: stopped, full or gone, it costs words and never time."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time

import pytest

SAY_MUCH = """
import time
from companion.cli.console import ConsoleReporter
reporter = ConsoleReporter()
slowest_s = 0.0
for _ in range(5000):
    began_s = time.monotonic()
    reporter.say("x" * 100 + "\u03c8")
    slowest_s = max(slowest_s, time.monotonic() - began_s)
reporter.close()
print(slowest_s)
"""


@pytest.mark.parametrize("reader", ["stopped", "gone"])
def test_a_terminal_that_takes_nothing_holds_nobody_up(reader):
    read_end, write_end = os.pipe()
    fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, 4096)
    if reader == "gone":
        os.close(read_end)
    began_s = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", SAY_MUCH], stdout=subprocess.PIPE, stderr=write_end, timeout=60, check=True
    )
    os.close(write_end)
    if reader == "stopped":
        os.close(read_end)
    assert float(done.stdout) < 0.5
    assert time.monotonic() - began_s < 30.0


def test_all_words_arrive_in_order_and_what_the_encoding_lacks_is_replaced():
    code = (
        "from companion.cli.console import ConsoleReporter as C; c = C(); "
        "[c.say(f'{i} \\u03c8') for i in range(500)]; c.close()"
    )
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment, check=True)
    assert done.stderr.decode("ascii").splitlines() == [f"{i} ?" for i in range(500)]
