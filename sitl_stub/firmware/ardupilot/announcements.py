"""What ArduCopter says of its own: on coming up, and what its filter and the simulator say in flight."""

from __future__ import annotations

from sitl_stub.firmware.ardupilot.commander import Commander
from sitl_stub.firmware.ardupilot.state import ArduPilotState
from sitl_stub.firmware.ardupilot.voice import ArduPilotVoice
from sitl_stub.firmware.common.mavlink_ids import Severity
from sitl_stub.firmware.common.streams import StreamTable
from sitl_stub.physics import estimator as belief
from sitl_stub.physics import vehicle as body

FIRST_REPORT_US, REPORTS_EVERY_US = 30_440_000, 31_000_000
YAW_ALIGNED_ABOVE_M = 2.5
IN_AIR_ABOVE_M = 0.05
HARD_LANDING_M_S = 0.1
"""The simulator tells of touch-downs faster than this."""
AIDING_STOPS_S = 15.0
"""EKF3's tiltDriftTimeMax_ms."""

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


class Announcements:
    """What one vehicle says."""

    def __init__(
        self, state: ArduPilotState, voice: ArduPilotVoice, commander: Commander, streams: StreamTable
    ) -> None:
        self.state = state
        self.voice = voice
        self._commander = commander
        self._streams = streams
        self._said = 0
        self._home_told = False
        self._next_report_us = FIRST_REPORT_US
        self._yaw_aligned = False
        self._in_air = False
        self._aiding = True
        self._sinking_m_s = 0.0

    def tell_of_boot(self) -> None:
        """A hundred times a second, first: what is due of SAYINGS; every 31 s what still stands against arming."""
        a = self.state
        while self._said < len(SAYINGS) and a.boot.past(SAYINGS[self._said][0]):
            if a.has_gps or "GPS" not in SAYINGS[self._said][1]:
                self.voice.say(Severity.INFO, SAYINGS[self._said][1])
            self._said += 1
        if not self._home_told and a.boot.home_known:
            self._home_told = True
            for link in self.voice.links:
                self._streams.send_named(link, "GPS_GLOBAL_ORIGIN", "HOME_POSITION")
        if a.clock.uptime_us >= self._next_report_us:
            self._next_report_us += REPORTS_EVERY_US
            if not a.armed:
                for refusal in self._commander.arming_refusals():
                    self.voice.say(Severity.CRITICAL, f"PreArm: {refusal}")

    def _tell_aiding(self) -> None:
        """The filter gives its position up for good after a while without measurements, and takes it up again."""
        a = self.state
        aiding = float(a.core.estimator.arrays.memory[belief.TIME_UNAIDED]) <= AIDING_STOPS_S
        if aiding == self._aiding:
            return
        self._aiding = aiding
        source = "GPS" if a.has_gps else "external nav data"
        for unit in (0, 1):
            if aiding:
                self.voice.say(Severity.INFO, f"EKF3 IMU{unit} is using {source}")
            else:
                self.voice.say(Severity.WARNING, f"EKF3 IMU{unit} stopped aiding")

    def update(self) -> None:
        """A hundred times a second, in the end."""
        a = self.state
        truth = a.core.state
        self._tell_aiding()
        if a.armed and not self._yaw_aligned and a.height_above_home_m > YAW_ALIGNED_ABOVE_M:
            self._yaw_aligned = True
            for unit in (0, 1):
                self.voice.say(Severity.INFO, f"EKF3 IMU{unit} MAG0 in-flight yaw alignment complete")
        if self._in_air and float(truth[body.IMPACT_SPEED]) > HARD_LANDING_M_S:
            self.voice.say(Severity.INFO, f"SIM Hit ground at {self._sinking_m_s:.6f} m/s")
            self._in_air = False
        if a.core.clearance_m > IN_AIR_ABOVE_M:
            self._in_air = True
            truth[body.IMPACT_SPEED] = 0.0
        if self._in_air:
            self._sinking_m_s = float(truth[body.VELOCITY + 2])
