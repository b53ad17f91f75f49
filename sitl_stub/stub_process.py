"""`Stub`: the stub as a process of its own, for tests and scripts.

    with Stub(lockstep=True, seed=3) as stub:
        fly(stub.endpoint)

    with Stub(firmware="ardupilot", scenario="faults.toml") as stub:
        stub.inject("link_loss", for_s=2.0)

The process is gone when the block is left, however it is left; if this process dies, the stub notices and ends too.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any


class StubError(RuntimeError):
    """The stub did not start, or ended with an error; the text is its own."""


class Stub:
    """A running stub on free ports. Keyword arguments are the options of `sitl-stub`."""

    ANSWER_TIMEOUT_S = 60.0
    """Wall time an injected fault is waited for: on a new machine the stub compiles first."""

    def __init__(
        self,
        firmware: str = "px4",
        vehicle: str | None = None,
        estimator: str = "mocap",
        seed: int = 0,
        *,
        lockstep: bool = False,
        speed: float = 1.0,
        wind: str = "0",
        mass_kg: float | None = None,
        parameters: Mapping[str, float] | None = None,
        transport: str = "udp",
        duration_s: float | None = None,
        exit_on_disarm: bool = False,
        scenario: str | Path | None = None,
        arguments: Sequence[str] = (),
        ready_after_s: float | None = None,
        ready_timeout_s: float = 20.0,
    ) -> None:
        """`transport`: `udp` (the stub speaks first, as PX4), `udp-server` or `tcp`. `scenario`: a TOML file of faults.

        `arguments` are added as they are.
        """
        links = {
            "udp": ["--port", "0"],
            "udp-server": ["--udp-server", "127.0.0.1:0"],
            "tcp": ["--tcp", "127.0.0.1:0"],
        }
        if transport not in links:
            raise ValueError(f"transport {transport!r}: choose from {', '.join(links)}")
        command = [sys.executable, "-m", "sitl_stub", "--json", "--firmware", firmware]
        command += ["--vehicle", vehicle] if vehicle is not None else []
        command += [
            "--estimator",
            estimator,
            "--seed",
            str(seed),
            "--wind",
            wind,
            "--speed",
            str(speed),
            *links[transport],
        ]
        command += ["--lockstep"] if lockstep else []
        command += ["--exit-on-disarm"] if exit_on_disarm else []
        command += ["--mass", str(mass_kg)] if mass_kg is not None else []
        command += ["--duration", str(duration_s)] if duration_s is not None else []
        command += ["--ready-after", str(ready_after_s)] if ready_after_s is not None else []
        for name, value in (parameters or {}).items():
            command += ["--param", f"{name}={value}"]
        command += ["--scenario", str(scenario)] if scenario is not None else []
        self.command = [*command, "--control", *arguments]
        self.ready_timeout_s = ready_timeout_s
        self.process: subprocess.Popen[str] | None = None
        self.ready: dict[str, Any] = {}
        self.summary: dict[str, Any] | None = None
        """The stub's last line, once it has ended by itself or been stopped."""
        self.errors = ""
        """What it said on standard error, from then on too."""

    def __enter__(self) -> Stub:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def endpoint(self) -> str:
        """Where a client connects, in pymavlink's spelling (`udpin:127.0.0.1:PORT`)."""
        return str(self.ready["endpoint"])

    @property
    def mavsdk_address(self) -> str:
        """The same in MAVSDK's spelling (`udpin://127.0.0.1:PORT`)."""
        kind, host, port = self.endpoint.split(":")
        return f"{ {'tcp': 'tcpout'}.get(kind, kind) }://{host}:{port}"

    @property
    def running(self) -> bool:
        """Whether the process lives."""
        return self.process is not None and self.process.poll() is None

    def start(self) -> None:
        """Start and wait for the ready line; raises StubError with the stub's own message."""
        self.process = subprocess.Popen(
            [*self.command, "--die-with-parent", str(os.getpid())],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            stdin=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self.process.stdout, selectors.EVENT_READ)
            line = self.process.stdout.readline() if selector.select(self.ready_timeout_s) else ""
        try:
            self.ready = json.loads(line)
        except json.JSONDecodeError:
            self.process.kill()
            self._collect(5.0)
            raise StubError(
                self.errors or f"no ready line from the stub within {self.ready_timeout_s} s"
            ) from None

    def inject(
        self,
        kind: str,
        *,
        after: str | None = None,
        at_s: float | None = None,
        for_s: float | None = None,
        **parameters: Any,
    ) -> float | None:
        """Let a fault happen (kinds and parameters: `sitl-stub --list-faults`, docs/faults.md).

        Args:
            kind: its name.
            after: what `at_s` counts from the first time of: `start` (default), `armed`, `airborne`, `offboard`.
            at_s: simulated seconds; a time that is past, as when it is left out, means the next control period. In
                lockstep, called while the client has not answered TIMESYNC, that is always the same instant.
            for_s: how long, simulated seconds; left out: it stays.
            parameters: those of the kind.

        Returns:
            When it begins, simulated seconds; None while what it comes after has not happened.

        Raises:
            ValueError: a wrong kind, time or parameter, with the remedy.
            StubError: the stub does not run.
        """
        timing = {"after": after, "at_s": at_s, "for_s": for_s}
        given = {name: value for name, value in timing.items() if value is not None}
        answer = self._ask({"inject": kind, **given, **parameters})
        begins: float | None = answer.get("begins_s")
        return begins

    def clear(self) -> None:
        """End every fault and forget those to come, the scenario's among them. Raises StubError."""
        self._ask({"clear": True})

    def _ask(self, command: dict[str, Any]) -> dict[str, Any]:
        """Write one line to the control channel and read its answer."""
        process = self.process
        if process is None or process.stdin is None or process.stdout is None or not self.running:
            raise StubError("the stub does not run: no fault can be injected")
        line = json.dumps(command, default=_not_json)
        try:
            process.stdin.write(line + "\n")
            process.stdin.flush()
        except OSError as error:
            raise StubError(f"the stub takes no more commands ({error.strerror})") from None
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            text = process.stdout.readline() if selector.select(self.ANSWER_TIMEOUT_S) else ""
        answer: dict[str, Any] = json.loads(text) if text.strip() else {}
        if "control" not in answer:
            if answer:
                self.summary = answer
            raise StubError("the stub has ended" if text else "the stub did not answer")
        if answer["control"] != "ok":
            raise ValueError("\n".join(answer["problems"]))
        return answer

    def wait(self, timeout_s: float = 60.0) -> int:
        """Wait for the stub to end by itself; returns its exit code. Raises subprocess.TimeoutExpired."""
        assert self.process is not None
        self._collect(timeout_s)
        return self.process.returncode

    def stop(self) -> None:
        """End the process: politely, then not."""
        process = self.process
        if process is None:
            return
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM)
        try:
            self._collect(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            self._collect(5.0)
        except ValueError:
            pass  # its output has been read to the end already

    def _collect(self, timeout_s: float) -> None:
        """Read what it says until it has ended."""
        assert self.process is not None
        output, errors = self.process.communicate(timeout=timeout_s)
        self.errors = errors.strip()
        for line in output.splitlines():
            with contextlib.suppress(json.JSONDecodeError):
                self.summary = json.loads(line)


def _not_json(value: Any) -> Any:
    raise ValueError(f"a parameter of a fault cannot be {value!r}: give a number, a name or a list of names")


def watch_parent(stop: Any, parent: int, interval_s: float = 0.5) -> None:
    """Call `stop()` when the process `parent` is no longer the parent of this one (run in a daemon thread)."""
    while os.getppid() == parent:
        time.sleep(interval_s)
    stop()
