"""Short flights against the stub for tests of links: the stub as a process, the companion in this one."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.autopilot.adapter import Finding
from companion.config.settings import load_settings
from companion.flight.phases import Phase
from companion.flight.reporter import Reporter
from companion.flight.session import SessionOptions, fly
from companion.mavlink.connection import Connection, LinkLibrary
from companion.mavlink.endpoint import parse_endpoint
from companion.mavlink.link import Link

SHORT = {
    "flight.trajectory": "hover",
    "flight.duration_s": 1.0,
    "flight.procedure.connect_timeout_s": 120.0,  # the stub may be compiling
    "flight.control_rate_hz": 100.0,
    "flight.procedure.hold_s": 0.5,
}


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def stub_behind(*options: str, lockstep: bool = True) -> Iterator[int]:
    """Run the stub; yields the UDP port that it speaks to."""
    process = subprocess.Popen(
        [sys.executable, "-m", "sitl_stub", "--port", "0", "--json", "--seed", "1"]
        + (["--lockstep"] if lockstep else [])
        + list(options),
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        yield int(json.loads(process.stdout.readline())["links"][0]["remote"][1])
    finally:
        process.terminate()
        process.wait(10)


class NoteTaker(Reporter):
    """Keeps what is said; calls `at[phase]` when a phase begins."""

    def __init__(self, at: Mapping[Phase, Callable[[], object]] | None = None) -> None:
        self.lines: list[str] = []
        self.findings: list[Finding] = []
        self.phases: list[Phase] = []
        self._at = dict(at or {})

    def say(self, text: str) -> None:
        self.lines.append(text)

    def progress(self, phase: Phase, time_s: float, of_s: float, text: str) -> None:
        if phase not in self.phases:
            self.phases.append(phase)
            self._at.pop(phase, lambda: None)()

    def finding(self, finding: Finding) -> None:
        self.findings.append(finding)


@dataclass
class Flown:
    """One flight as it ended."""

    outcome: str
    text: str
    counters: Counter[str]
    lines: list[str]
    findings: list[Finding]
    log: Path
    extra: dict[str, Any] = field(default_factory=dict)


def companion(
    endpoint: str,
    folder: Path,
    *,
    library: LinkLibrary = LinkLibrary.PYMAVLINK,
    signing_key: Path | None = None,
    level: str = "attitude",
    settings: Mapping[str, object] | None = None,
    at: Mapping[Phase, Callable[[], object]] | None = None,
    **options: Any,
) -> Flown:
    """Fly SHORT over `endpoint`; the log is `folder`/flight.mcap."""
    wishes = {**SHORT, **{f"flight.{key}": value for key, value in (settings or {}).items()}}
    loaded = load_settings("qball2", {"level": level}, [f"{key}={value}" for key, value in wishes.items()])
    reporter = NoteTaker(at)
    links: list[Link] = []

    class Watched(Connection):
        def open(self, say: Callable[[str], None] = lambda _: None) -> Link:
            link = super().open(say)
            links.append(link)
            return link

    log = folder / "flight.mcap"
    connection = Watched(parse_endpoint(endpoint), library, signing_key)
    result = fly(loaded, SessionOptions(connection, log, overwrite=True, **options), reporter)
    return Flown(result.outcome.value, result.text, links[0].counters, reporter.lines, reporter.findings, log)
