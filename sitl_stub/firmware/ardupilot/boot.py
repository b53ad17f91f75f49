"""How ArduCopter comes up: what is ready when (what it says on the way is in `announcements.py`).

Times are those of the capture and of the same build at real time, in seconds since boot; with another `ready_after_s`
all of them are scaled by it over 42 s, the moment the estimator first has a position.
"""

from __future__ import annotations

from sitl_stub.firmware.common.clock import Clock

CAPTURED_READY_S = 41.6
EKF_STARTED_S = 5.0
GPS_FOUND_S = 9.83
HOME_S = 20.02
AHRS_READY_S = 22.2
ACCELEROMETERS_AGREE_S = 22.9


class Boot:
    """What one vehicle has ready."""

    def __init__(self, clock: Clock, ready_after_s: float) -> None:
        self._clock = clock
        self._scale = max(ready_after_s, 0.0) / 42.0

    def past(self, captured_s: float) -> bool:
        """Whether the moment has come that came then in the capture."""
        return self._clock.uptime_us >= captured_s * self._scale * 1e6

    @property
    def ekf_started(self) -> bool:
        """The filter has its attitude."""
        return self.past(EKF_STARTED_S)

    @property
    def gps_found(self) -> bool:
        """The receiver answers."""
        return self.past(GPS_FOUND_S)

    @property
    def home_known(self) -> bool:
        """The filter has its origin, and home is there."""
        return self.past(HOME_S)

    @property
    def ahrs_ready(self) -> bool:
        """Attitude vouched for."""
        return self.past(AHRS_READY_S)

    @property
    def accelerometers_agree(self) -> bool:
        """The last of the checks that need nothing but time."""
        return self.past(ACCELEROMETERS_AGREE_S)

    @property
    def position_found(self) -> bool:
        """The filter uses the receiver: there is a position."""
        return self.past(CAPTURED_READY_S)
