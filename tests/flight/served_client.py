"""A client of `companion serve` for tests: an ordinary pymavlink program that goes by the vehicle's clock, in lockstep."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from link_flights import free_port
from pymavlink import mavutil

from sitl_stub import Stub

mavlink = mavutil.mavlink
PATIENCE_S = 120.0
POSITION_AND_VELOCITY = 0x0DC0
"""type_mask of MAVSDK's set_position_velocity_ned without a yaw."""
Setpoint = tuple[float, float, float, float, float, float]
"""North, east, down, m; their velocities, m/s."""
HOVER: Setpoint = (0.0, 0.0, -3.0, 0.0, 0.0, 0.0)
LOITER, OFFBOARD = (4, 3), (6, 0)
READY_TO_BE_FLOWN = {"GUID_OPTIONS": 8.0, "ATC_ANGLE_BOOST": 0.0}


class Served:
    """`companion serve` as a process, and what it says."""

    def __init__(self, endpoint: str, folder: Path, *words: str) -> None:
        self.port = free_port()
        self.said: list[str] = []
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", "companion.cli.main", "serve", "--endpoint", endpoint),
                *("--clients", f"udpout:127.0.0.1:{self.port}", *words),
            ],
            cwd=folder,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        self.said.extend(line.rstrip() for line in self.process.stderr)

    def heard(self, words: str) -> bool:
        """Whether it has said something with `words` in it."""
        return any(words in line for line in self.said)

    @property
    def law(self) -> int:
        """Process id of the law."""
        words = ["pgrep", "-P", str(self.process.pid), "-f", "spawn_main"]
        return int(subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()[-1])

    def stop(self) -> int:
        """Ask it to end; its exit code."""
        self.process.send_signal(signal.SIGTERM)
        try:
            code = self.process.wait(20.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        self._reader.join(5.0)
        return code

    def kill(self) -> None:
        """Kill it as nobody should."""
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait(10.0)


class Client:
    """See the module. `answers`: whether it answers the stub's TIMESYNC, where nobody else does."""

    def __init__(self, address: str, answers: bool) -> None:
        self.link: Any = mavutil.mavlink_connection(address, source_system=245, source_component=190)
        self._answers = answers
        self.texts: list[str] = []
        self.modes: list[tuple[int, int]] = []
        self.errors: list[tuple[float, float, float]] = []
        """Where the vehicle was from where it was asked to be, m."""
        self.position: tuple[float, float, float] = (math.nan, math.nan, math.nan)
        self.armed = False
        self.now_s = 0.0
        self._sent_s = -math.inf
        assert self.link.wait_heartbeat(timeout=PATIENCE_S) is not None
        self.link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
        self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 20_000)

    def command(self, number: int, *parameters: float) -> None:
        filled = [*parameters, *[0.0] * (7 - len(parameters))]
        self.link.mav.command_long_send(1, 1, number, 0, *filled)

    def mode(self, main: int, sub: int = 0) -> None:
        """Ask for a mode, in PX4's numbers; of ArduPilot by its custom_mode."""
        self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, main, sub)

    def fly(
        self,
        for_s: float,
        ask: Callable[[float], Setpoint | None] = lambda _: HOVER,
        until: Callable[[], bool] = lambda: False,
        mask: int = POSITION_AND_VELOCITY,
    ) -> bool:
        """Send what `ask` says of the time since now, 50 times a second of the vehicle's time; whether `until` held."""
        begun_s: float | None = None
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            message = self.link.recv_match(blocking=True, timeout=0.5)
            if until():
                return True
            if message is None or not self._take(message):
                continue
            begun_s = self.now_s if begun_s is None else begun_s
            passed_s = self.now_s - begun_s
            if passed_s > for_s:
                return False
            asked = ask(passed_s)
            if asked is None:
                continue
            north, east, down, *_ = asked
            x, y, z = self.position
            self.errors.append((x - north, y - east, z - down))
            if self.now_s - self._sent_s >= 0.0199:
                self._sent_s = self.now_s
                self.link.mav.set_position_target_local_ned_send(
                    round(self.now_s * 1e3), 1, 1, mavlink.MAV_FRAME_LOCAL_NED, mask, *asked, *[0.0] * 5
                )
        raise AssertionError("the vehicle's time stands still")

    def _take(self, message: Any) -> bool:
        kind = message.get_type()
        if kind == "TIMESYNC" and message.tc1 == 0 and self._answers:
            self.link.mav.timesync_send(time.monotonic_ns(), message.ts1)
        elif kind == "STATUSTEXT":
            self.texts.append(message.text)
        elif kind == "HEARTBEAT" and message.get_srcComponent() == 1:
            mode = (message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24)
            mode = mode if any(mode) else (message.custom_mode, 0)
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            if not self.modes or self.modes[-1] != mode:
                self.modes.append(mode)
        elif kind == "LOCAL_POSITION_NED":
            self.now_s = message.time_boot_ms * 1e-3
            self.position = (message.x, message.y, message.z)
            return True
        return False

    def rms_m(self) -> float:
        """Of the errors so far, which are forgotten."""
        errors, self.errors = np.array(self.errors), []
        return float(np.sqrt((errors**2).sum(axis=1).mean()))

    def close(self) -> None:
        self.link.close()


@contextmanager
def served(
    firmware: str, folder: Path, *words: str, airborne: bool = True
) -> Iterator[tuple[Stub, Served, Client]]:
    """A stub in lockstep, serve that stands by, and a client of it."""
    with stub_for(firmware, airborne) as stub:
        serve = Served(stub.endpoint, folder, *words)
        client = None
        try:
            client = Client(f"udpin:127.0.0.1:{serve.port}", answers=False)
            assert client.fly(60.0, until=lambda: serve.heard("standing by")), serve.said
            yield stub, serve, client
        finally:
            if serve.process.poll() is None:
                serve.stop()
            if client is not None:
                client.close()


def stub_for(firmware: str, airborne: bool = True, **options: Any) -> Stub:
    """A stub that can be flown, in lockstep."""
    return Stub(
        firmware,
        seed=1,
        lockstep=True,
        ready_after_s=1.0,
        ready_timeout_s=PATIENCE_S,
        parameters=READY_TO_BE_FLOWN if firmware == "ardupilot" else {},
        arguments=["--airborne", "3"] if airborne else [],
        **options,
    )
