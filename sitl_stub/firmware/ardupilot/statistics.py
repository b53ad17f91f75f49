"""The statistics ArduPilot keeps in its parameters and announces when it saves them (`AP_Stats.cpp`).

Run time and flight time, whole seconds, go into STAT_RUNTIME and STAT_FLTTIME when more than 30 s have passed since the
last time, looked at once a second, and on every landing. What has changed is sent to everybody as PARAM_VALUE.
"""

from __future__ import annotations

from collections.abc import Callable

from sitl_stub.firmware.ardupilot.state import ArduPilotState

SAVE_AFTER_US = 30_000_000
LOOK_PHASE_US = 440_000
"""When within each second it looks, as in the capture."""


class Statistics:
    """Run time and flight time of one vehicle."""

    def __init__(self, state: ArduPilotState, announce: Callable[[str], None]) -> None:
        """`announce` tells everybody the value of a parameter."""
        self.state = state
        self._announce = announce
        self._saved_us = 0
        self._run_before_s = int(state.parameters["STAT_RUNTIME"])
        self._flown_before_s = int(state.parameters["STAT_FLTTIME"])
        self._flying_since_us: int | None = None
        self._flown_s = 0

    def update(self) -> None:
        """A hundred times a second."""
        a = self.state
        now = a.clock.uptime_us
        if a.landed and self._flying_since_us is not None:
            self._save(now)
            self._flying_since_us = None
        elif not a.landed and self._flying_since_us is None:
            self._flying_since_us = now
        if now % 1_000_000 == LOOK_PHASE_US and now - self._saved_us > SAVE_AFTER_US:
            self._save(now)

    def _save(self, now_us: int) -> None:
        if self._flying_since_us is not None:
            whole_s = (now_us - self._flying_since_us) // 1_000_000
            self._flown_s += whole_s
            self._flying_since_us += whole_s * 1_000_000
        self._keep("STAT_FLTTIME", self._flown_before_s + self._flown_s)
        self._keep("STAT_RUNTIME", self._run_before_s + now_us // 1_000_000)
        self._saved_us = now_us

    def _keep(self, name: str, seconds: int) -> None:
        a = self.state
        if int(a.parameters[name]) != seconds:
            a.parameters.set(name, float(seconds))
            self._announce(name)
