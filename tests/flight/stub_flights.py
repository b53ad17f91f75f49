"""Flights against the stub for tests of how a flight ends: the stub as a process, the companion in this one or its own."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.config.settings import load_settings
from companion.flight.phases import Phase
from companion.flight.reporter import Reporter
from companion.flight.session import SessionOptions, fly
from companion.flight.stage import FlightResult
from companion.flightlog.reader import FlightRecord, read_log
from companion.mavlink.connection import Connection
from companion.mavlink.endpoint import parse_endpoint
from companion.mavlink.link import mav
from sitl_stub.stub_process import Stub

SHORT = (
    "flight.duration_s=3",
    "flight.takeoff_height_m=1.0",
    "flight.procedure.hold_s=3.0",
    "flight.procedure.connect_timeout_s=120",  # the stub may be compiling
)
STUB_FREE_SPEED = 10.0  # times real time, once the stub has nobody to wait for


class Watching(Reporter):
    """Keeps what is said, and does `at[phase]` when a phase begins: every action falls at a moment of the flight."""

    def __init__(self, at: Mapping[Phase, Callable[[], object]]) -> None:
        self.lines: list[str] = []
        self.phases: list[Phase] = []
        self._at = dict(at)

    def say(self, text: str) -> None:
        self.lines.append(text)

    def progress(self, phase: Phase, time_s: float, of_s: float, text: str) -> None:
        if not self.phases or phase is not self.phases[-1]:
            self.phases.append(phase)
            self._at.pop(phase, lambda: None)()


@dataclass(frozen=True)
class Flown:
    """One flight as it ended."""

    result: FlightResult
    record: FlightRecord
    reporter: Watching
    log: Path

    @property
    def ended(self) -> str:
        """The last word in the log."""
        return str(self.record.events_of("ended")[-1].fields["outcome"])

    @property
    def armed(self) -> list[bool]:
        """How arming went, as the log has it."""
        return [event.fields["armed"] for event in self.record.events_of("armed")]

    @property
    def modes(self) -> list[str]:
        """The autopilot's modes, in order."""
        return [event.fields["mode"] for event in self.record.events_of("mode")]

    def setpoints_after(self, kind: str, **fields: object) -> int:
        """How many SET_ATTITUDE_TARGET went out after the first event of `kind` with these fields."""
        first = next(
            event.time_s
            for event in self.record.events_of(kind)
            if all(event.fields[name] == value for name, value in fields.items())
        )
        times_ns, frames = self.record.mavlink["out"]
        offset_ns = self.record.utc_offset_ns
        setpoint = mav.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET
        return sum(
            (time_ns - offset_ns) * 1e-9 > first + 1e-6
            for time_ns, frame in zip(times_ns, frames, strict=True)
            if frame[7] | frame[8] << 8 | frame[9] << 16 == setpoint
        )


def fly_short(
    stub: Stub,
    folder: Path,
    at: Mapping[Phase, Callable[[], object]] | None = None,
    settings: Sequence[str] = (),
    level: str = "attitude",
    trajectory: str = "lemniscate",
    system: int | None = None,
    profile: str | None = "qball2",
    **options: Any,
) -> Flown:
    """Fly SHORT in this process and read the log back."""
    loaded = load_settings(profile, {"level": level, "trajectory": trajectory}, [*SHORT, *settings])
    reporter, log = Watching(at or {}), folder / "flight.mcap"
    session = SessionOptions(
        Connection(parse_endpoint(stub.endpoint), system=system), log, overwrite=True, **options
    )
    result = fly(loaded, session, reporter)
    return Flown(result, read_log(log), reporter, log)


def interrupt() -> None:
    """Ctrl-C in this process."""
    os.kill(os.getpid(), signal.SIGINT)


class Pilot:
    """A ground station on the stub's second link; pass `options` to the stub."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(10.0)
        self._codec = mav.MAVLink(None, srcSystem=255, srcComponent=190)
        self.options = ["--gcs", f"127.0.0.1:{self._socket.getsockname()[1]}"]

    def command(self, number: int, *parameters: float) -> None:
        """COMMAND_LONG to the autopilot."""
        _, autopilot = self._socket.recvfrom(2048)
        filled = (*parameters, *(0.0,) * (7 - len(parameters)))
        message = mav.MAVLink_command_long_message(1, 1, number, 0, *filled)
        self._socket.sendto(message.pack(self._codec), autopilot)

    def mode(self, main: int, sub: int) -> None:
        """Switch PX4's mode."""
        self.command(mav.MAV_CMD_DO_SET_MODE, 1.0, main, sub)

    def stop_motors(self) -> None:
        """Disarm, with the magic number that works in the air too."""
        self.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 21196.0)

    def close(self) -> None:
        self._socket.close()


class CompanionProcess:
    """`companion fly` as a process of its own; its words are collected while it runs."""

    def __init__(self, arguments: Sequence[str], folder: Path) -> None:
        self.lines: list[str] = []
        self.said = threading.Condition()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "companion.cli.main", *arguments],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            with self.said:
                self.lines.append(line.rstrip())
                self.said.notify_all()

    def until_said(self, text: str, timeout_s: float = 120.0) -> None:
        """Wait for a line with `text`. Raises AssertionError with all that was said instead."""
        with self.said:
            heard = self.said.wait_for(lambda: any(text in line for line in self.lines), timeout_s)
        assert heard, f"{text!r} was never said:\n" + "\n".join(self.lines)

    def end(self, timeout_s: float = 120.0) -> tuple[int, str]:
        """Wait for the end; exit code and standard output."""
        assert self.process.stdout is not None
        output = self.process.stdout.read()
        code = self.process.wait(timeout_s)
        self._reader.join(5.0)
        return code, output


@contextmanager
def companion_process(arguments: Sequence[str], folder: Path) -> Iterator[CompanionProcess]:
    """Run `companion`; it is gone when the block is left."""
    running = CompanionProcess(arguments, folder)
    try:
        yield running
    finally:
        if running.process.poll() is None:
            running.process.kill()
        running.process.wait()


def lockstep_stub(
    *options: str, firmware: str = "px4", seed: int = 1, ends_when_disarmed: bool = False
) -> Stub:
    """A stub that waits for the companion, and runs at STUB_FREE_SPEED when there is none."""
    return Stub(
        firmware,
        seed=seed,
        lockstep=True,
        speed=STUB_FREE_SPEED,
        exit_on_disarm=ends_when_disarmed,
        arguments=options,
    )


def kill(stub: Stub) -> None:
    """SIGKILL, and be sure."""
    assert stub.process is not None
    stub.process.kill()
    stub.process.wait()


def wait_briefly() -> None:
    """Longer than signals that count as one wish (`Interrupts.ONE_WISH_S`)."""
    time.sleep(0.6)
