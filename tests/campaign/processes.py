"""Both programs as processes forked from one that has everything loaded: their own main functions, exit codes and words.

A fork costs 10 ms where a start costs 2 s. `warm_up` loads; it must be called before any thread is started.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass
class Child:
    """A forked process."""

    pid: int
    code: int | None = None
    """Exit code, negative for a signal; None while it runs."""
    cpu_s: float = 0.0

    def poll(self) -> int | None:
        """Exit code, or None while it runs."""
        if self.code is None:
            pid, status, used = os.wait4(self.pid, os.WNOHANG)
            if pid:
                self.code = os.waitstatus_to_exitcode(status)
                self.cpu_s = used.ru_utime + used.ru_stime
        return self.code

    def wait(self, timeout_s: float) -> int | None:
        """Exit code, or None when it still runs after `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        pause_s = 0.002
        while self.poll() is None and time.monotonic() < deadline:
            time.sleep(pause_s)
            pause_s = min(0.05, 1.5 * pause_s)
        return self.code

    def end(self, patience_s: float = 5.0) -> int:
        """SIGTERM, then SIGKILL; returns the exit code."""
        for number, timeout_s in ((signal.SIGTERM, patience_s), (signal.SIGKILL, 30.0)):
            if self.poll() is None:
                os.kill(self.pid, number)
                self.wait(timeout_s)
        assert self.code is not None
        return self.code


def fork(main: Callable[[], int], output: Path, errors: Path, folder: Path) -> Child:
    """Run `main` in a fork of this process, in a process group of its own, with its words in two files."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return Child(pid)
    code = 70
    try:
        os.setpgid(0, 0)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for path, number in ((output, 1), (errors, 2)):
            descriptor = os.open(path, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o644)
            os.dup2(descriptor, number)
            os.close(descriptor)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", closefd=False)
        os.chdir(folder)
        code = main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)


def warm_up(stub_firmwares: Sequence[str]) -> None:
    """Import both programs and load every compiled function that a flight of these firmwares needs."""
    import sitl_stub.server  # noqa: F401
    from companion.config.settings import load_settings
    from companion.control.prediction import Predictor
    from companion.control.registry import build_law
    from sitl_stub.firmware.ardupilot.build import build_ardupilot
    from sitl_stub.firmware.px4.build import build_px4
    from sitl_stub.physics.vehicle import load_vehicle

    nowhere: tuple[Any, ...] = ((1.0, 0.0, 0.0), 1.0, {}, 1.0)
    for firmware in stub_firmwares:
        if firmware == "ardupilot":
            build_ardupilot(load_vehicle("arducopter"), "gps", 1, *nowhere).step()
        else:
            build_px4(firmware, load_vehicle("qball2"), "gps", 1, *nowhere).step()
        for level in ("attitude", "body_rate", "actuator"):
            for controller in ("dtlannc", "tlmbc", "nnsmc"):
                settings = load_settings("qball2", {"level": level, "controller": controller})
                law = build_law(controller, settings.gains, settings.profile, settings.level, 1)
                law.warm_up()
                Predictor(settings.profile, settings.level)
    gc.collect()
    gc.freeze()
