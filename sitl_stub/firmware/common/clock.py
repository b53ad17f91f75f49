"""An autopilot's clock: simulated time, since boot and as it goes into time stamps. Nothing in the stub reads another."""

from __future__ import annotations

from sitl_stub.firmware.common.vehicle_core import VehicleCore

LATEST_STAMP_US = (2**32 - 1) * 1000
"""What `time_boot_ms` can hold."""
SIMULATED_EPOCH_US = 1_795_335_292_521_929
"""Unix time of boot, µs: that of one of the captures. Fixed, so that SYSTEM_TIME repeats."""


class Clock:
    """Time of one autopilot, µs."""

    def __init__(self, core: VehicleCore) -> None:
        self._core = core
        self.booted_us = 0
        """When the firmware last started: later than now while it is restarting."""
        self.lockstep = False
        """Set by the server: TIMESYNC requests are then its business."""
        self._errors_us: dict[object, int] = {}
        self._offset_us = 0

    @property
    def time_us(self) -> int:
        """Simulated time since the beginning."""
        return self._core.time_us

    @property
    def uptime_us(self) -> int:
        """Simulated time since the firmware last started; negative while it is restarting."""
        return self._core.time_us - self.booted_us

    @property
    def stamp_us(self) -> int:
        """What goes into every time stamp: `uptime_us` unless a fault puts it wrong."""
        return min(max(self.uptime_us + self._offset_us, 0), LATEST_STAMP_US)

    @property
    def stamp_ms(self) -> int:
        """`stamp_us` as `time_boot_ms`."""
        return self.stamp_us // 1000

    def put_wrong(self, cause: object, by_us: int) -> None:
        """Let `cause` shift the stamps by so much; 0 takes its share back."""
        self._errors_us[cause] = by_us
        self._offset_us = sum(self._errors_us.values())

    def restart(self, silent_us: int) -> None:
        """Begin at 0 after so much silence, and right."""
        self.booted_us = self.time_us + silent_us
        self._errors_us.clear()
        self._offset_us = 0
