"""How a receiver shows a lost transmitter in RC_CHANNELS and SYS_STATUS. Each receiver has its own way."""

from __future__ import annotations

APPEARANCES = ("throttle_low", "rssi_zero", "unhealthy", "no_signal", "preset", "frozen")
RECEIVER_BIT = 0x10000  # MAV_SYS_STATUS_SENSOR_RC_RECEIVER
PRESET_US = (1500, 1500, 1300, 1500)
LOW_US = 900  # below every transmitter's travel


class Radio:
    """The receiver; `lost` is one of APPEARANCES, empty while the transmitter is heard."""

    def __init__(self) -> None:
        self.lost = ""
        self._last: tuple[int, ...] = (1500, 1500, 1000, 1500)

    def received(self, sticks_us: tuple[int, ...], rssi: int) -> tuple[tuple[int, ...], int]:
        """Roll, pitch, throttle, yaw in µs and signal strength as the receiver gives them."""
        if not self.lost:
            self._last = sticks_us
            return sticks_us, rssi
        roll, pitch, _, yaw = self._last
        if self.lost == "throttle_low":
            return (roll, pitch, LOW_US, yaw), rssi
        if self.lost == "preset":
            return PRESET_US, rssi
        if self.lost == "no_signal":
            return (65535,) * 4, rssi
        return self._last, 0 if self.lost == "rssi_zero" else rssi

    @property
    def healthy(self) -> bool:
        """As SYS_STATUS has it; nobody else notices presets and repeated positions."""
        return self.lost != "unhealthy"
