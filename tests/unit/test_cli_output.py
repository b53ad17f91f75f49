"""Standard output and error that are full, gone, stopped or closed, and Ctrl-C while libraries load: every command."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time

import pytest

from companion.cli.main import COMMANDS

PRINTS_MUCH = """
import sys
from companion.cli import main as cli
class Command:
    add_parser = staticmethod(lambda parsers: parsers.add_parser("fly"))
    @staticmethod
    def run(arguments):
        print("x" * 300_000, file=sys.stderr)
        print("x" * 300_000)
        return 3
cli.COMMANDS, cli._module = ("fly",), lambda name: Command
sys.exit(cli.main(["fly"]))
"""
INTERRUPTED_AT_IMPORT = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job inherits that it is ignored
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == WHERE:
            sys.meta_path.remove(self)
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder())
from companion.cli.main import main
sys.exit(main(ARGUMENTS))
"""
INTERRUPTED_IN_A_CALLBACK = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from companion.cli import main as cli
class Callback:
    def __del__(self):
        raise KeyboardInterrupt
class Command:
    add_parser = staticmethod(lambda parsers: parsers.add_parser("fly"))
    @staticmethod
    def run(arguments):
        Callback()
        time.sleep(30.0)
        return 0
cli.COMMANDS, cli._module = ("fly",), lambda name: Command
sys.exit(cli.main(["fly"]))
"""


def run(code: str, **streams: object) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", code], check=False, timeout=60, **streams)


def dead(kind: str) -> tuple[int, list[int]]:
    """A descriptor that takes nothing, and what has to stay open meanwhile."""
    if kind == "full disk":
        return os.open("/dev/full", os.O_WRONLY), []
    read_end, write_end = os.pipe()
    if kind == "gone":
        os.close(read_end)
        return write_end, []
    fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, 4096)
    return write_end, [read_end]


@pytest.mark.parametrize("kind", ["full disk", "gone", "stopped"])
@pytest.mark.parametrize("which", ["stdout", "stderr", "both"])
def test_a_command_keeps_its_exit_code_whatever_printing_meets(kind, which):
    descriptor, others = dead(kind)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    for name in ("stdout", "stderr") if which == "both" else (which,):
        streams[name] = descriptor
    began_s = time.monotonic()
    done = run(PRINTS_MUCH, **streams)
    for each in (descriptor, *others):
        os.close(each)
    assert done.returncode == 3
    assert time.monotonic() - began_s < 20.0
    if which == "stdout":
        lost = {"full disk": b"No space left on device", "stopped": b"takes nothing", "gone": b""}[kind]
        assert b"Traceback" not in done.stderr and lost in done.stderr
        assert (b"results are lost" in done.stderr) is (kind != "gone")
    if which == "stderr":
        assert len(done.stdout) == 300_001


def test_a_log_never_gets_the_number_of_a_closed_standard_stream(tmp_path):
    """Started with both closed, whatever is opened first would be descriptor 1, and be printed into."""
    opened = tmp_path / "opened"
    code = PRINTS_MUCH.replace("        return 3", f"        return open({str(opened)!r}, 'w').fileno()")
    code = code.replace("    def run(arguments):", "    def run(arguments):\n        import os")
    words = ["sh", "-c", 'exec "$0" -c "$1" >&- 2>&-', sys.executable, code]
    done = subprocess.run(words, check=False, timeout=60)
    assert done.returncode > 2


@pytest.mark.parametrize(
    "where", ["argparse", "companion.config.errors", "companion.cli.tune", "numpy", "numba"]
)
def test_ctrl_c_while_libraries_load_is_silent(where):
    code = INTERRUPTED_AT_IMPORT.replace("WHERE", repr(where))
    done = run(
        code.replace("ARGUMENTS", '["fly", "--endpoint", "udpin:127.0.0.1:1", "--log", "/nowhere/x"]'),
        capture_output=True,
    )
    assert (done.returncode, done.stderr, done.stdout) == (130, b"", b"")


@pytest.mark.parametrize("command", COMMANDS)
def test_ctrl_c_while_any_command_loads_is_silent(command):
    code = INTERRUPTED_AT_IMPORT.replace("WHERE", repr(f"companion.cli.{command.replace('-', '_')}"))
    done = run(code.replace("ARGUMENTS", repr([command, "--help"])), capture_output=True)
    assert (done.returncode, done.stderr, done.stdout) == (130, b"", b"")


def test_an_interrupt_that_python_drops_in_a_callback_still_ends_the_command():
    done = run(INTERRUPTED_IN_A_CALLBACK, capture_output=True)
    assert (done.returncode, done.stderr) == (130, b"")
