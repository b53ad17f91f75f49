"""How ArduCopter comes up: what is ready when, and what it says on the way.

Times are those of the capture and of the same build at real time, in seconds since boot; with another `ready_after_s`
all of them are scaled by it over 42 s, the moment the estimator first has a position.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl_stub.physics import estimator as belief
from sitl_stub.physics import vehicle as body

if TYPE_CHECKING:
    from sitl_stub.firmware.ardupilot.autopilot import ArduPilot

CAPTURED_READY_S = 41.6
EKF_STARTED_S = 5.0
GPS_FOUND_S = 9.83
HOME_S = 20.02
AHRS_READY_S = 22.2
ACCELEROMETERS_AGREE_S = 22.9
FIRST_REPORT_US, REPORTS_EVERY_US = 30_440_000, 31_000_000
YAW_ALIGNED_ABOVE_M = 2.5
IN_AIR_ABOVE_M = 0.05
HARD_LANDING_M_S = 0.1
"""The simulator tells of touch-downs faster than this."""
AIDING_STOPS_S = 15.0
"""EKF3's tiltDriftTimeMax_ms."""
CRITICAL, WARNING, INFO = 2, 4, 6

SAYINGS: tuple[tuple[float, str], ...] = (
    (1.0, "Barometer 1 calibration complete"),
    (1.0, "Barometer 2 calibration complete"),
    (2.5, "ArduPilot Ready"),
    (2.5, "AHRS: DCM active"),
    (4.5, "EKF3 IMU0 initialised"),
    (4.5, "EKF3 IMU1 initialised"),
    (4.7, "AHRS: EKF3 active"),
    (5.80, "EKF3 IMU0 tilt alignment complete"),
    (5.80, "EKF3 IMU1 tilt alignment complete"),
    (5.90, "EKF3 IMU0 MAG0 initial yaw alignment complete"),
    (5.90, "EKF3 IMU1 MAG0 initial yaw alignment complete"),
    (9.81, "GPS 1: probing for u-blox at 230400 baud"),
    (9.83, "GPS 1: detected u-blox"),
    (20.02, "EKF3 IMU0 origin set"),
    (20.05, "Field Elevation Set: 584m"),
    (20.21, "EKF3 IMU1 origin set"),
    (41.6, "EKF3 IMU0 is using GPS"),
    (41.6, "EKF3 IMU1 is using GPS"),
)


class Boot:
    """What one vehicle has ready."""

    def __init__(self, autopilot: ArduPilot, ready_after_s: float) -> None:
        self.autopilot = autopilot
        self.scale = max(ready_after_s, 0.0) / 42.0
        self._said = 0
        self._home_told = False
        self._next_report_us = FIRST_REPORT_US

    def _past(self, captured_s: float) -> bool:
        return self.autopilot.uptime_us >= captured_s * self.scale * 1e6

    @property
    def ekf_started(self) -> bool:
        """The filter has its attitude."""
        return self._past(EKF_STARTED_S)

    @property
    def gps_found(self) -> bool:
        """The receiver answers."""
        return self._past(GPS_FOUND_S)

    @property
    def home_known(self) -> bool:
        """The filter has its origin, and home is there."""
        return self._past(HOME_S)

    @property
    def ahrs_ready(self) -> bool:
        """Attitude vouched for."""
        return self._past(AHRS_READY_S)

    @property
    def accelerometers_agree(self) -> bool:
        """The last of the checks that need nothing but time."""
        return self._past(ACCELEROMETERS_AGREE_S)

    @property
    def position_found(self) -> bool:
        """The filter uses the receiver: there is a position."""
        return self._past(CAPTURED_READY_S)

    def update(self) -> None:
        """Say what is due; every 31 s what still stands against arming."""
        a = self.autopilot
        while self._said < len(SAYINGS) and self._past(SAYINGS[self._said][0]):
            if a.has_gps or "GPS" not in SAYINGS[self._said][1]:
                a.say(INFO, SAYINGS[self._said][1])
            self._said += 1
        if not self._home_told and self.home_known:
            self._home_told = True
            for link in a.links:
                a.streams.build(link, 49)
                a.streams.build(link, 242)
        if a.uptime_us >= self._next_report_us:
            self._next_report_us += REPORTS_EVERY_US
            if not a.armed:
                for refusal in a.arming_refusals():
                    a.say(CRITICAL, f"PreArm: {refusal}")


class Happenings:
    """What the filter and the simulator say in flight."""

    def __init__(self, autopilot: ArduPilot) -> None:
        self.autopilot = autopilot
        self._yaw_aligned = False
        self._in_air = False
        self._aiding = True
        self._sinking_m_s = 0.0

    def _tell_aiding(self) -> None:
        """The filter gives its position up for good after a while without measurements, and takes it up again."""
        a = self.autopilot
        aiding = float(a.core.estimator.arrays.memory[belief.TIME_UNAIDED]) <= AIDING_STOPS_S
        if aiding == self._aiding:
            return
        self._aiding = aiding
        source = "GPS" if a.has_gps else "external nav data"
        for unit in (0, 1):
            if aiding:
                a.say(INFO, f"EKF3 IMU{unit} is using {source}")
            else:
                a.say(WARNING, f"EKF3 IMU{unit} stopped aiding")

    def update(self) -> None:
        """A hundred times a second."""
        a = self.autopilot
        state = a.core.state
        self._tell_aiding()
        if a.armed and not self._yaw_aligned and a.height_above_home_m > YAW_ALIGNED_ABOVE_M:
            self._yaw_aligned = True
            for unit in (0, 1):
                a.say(INFO, f"EKF3 IMU{unit} MAG0 in-flight yaw alignment complete")
        if self._in_air and float(state[body.IMPACT_SPEED]) > HARD_LANDING_M_S:
            a.say(INFO, f"SIM Hit ground at {self._sinking_m_s:.6f} m/s")
            self._in_air = False
        core = a.core
        clearance = float(core.environment[body.GROUND_DOWN] - state[body.POSITION + 2])
        if clearance - core.vehicle.foot_height_m > IN_AIR_ABOVE_M:
            self._in_air = True
            state[body.IMPACT_SPEED] = 0.0
        if self._in_air:
            self._sinking_m_s = float(state[body.VELOCITY + 2])
