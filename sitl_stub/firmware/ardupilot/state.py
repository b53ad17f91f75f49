"""What one ArduCopter knows of itself: what its parts read of each other, each field with its one writer."""

from __future__ import annotations

from dataclasses import dataclass, field

from sitl_stub.firmware.ardupilot.battery import BatteryLevel
from sitl_stub.firmware.ardupilot.boot import Boot
from sitl_stub.firmware.ardupilot.core import ArduPilotCore
from sitl_stub.firmware.ardupilot.modes import Mode
from sitl_stub.firmware.ardupilot.parameters import ArduPilotParameters
from sitl_stub.firmware.common.globe import LocalOrigin
from sitl_stub.firmware.common.state import FirmwareState
from sitl_stub.firmware.common.sticks import Sticks

ORIGIN = LocalOrigin(-35.3632610, 149.1652299, 584.09)
ARMING_DELAY_US = 2_000_000


@dataclass(kw_only=True)
class ArduPilotState(FirmwareState):
    """One ArduCopter."""

    core: ArduPilotCore
    parameters: ArduPilotParameters
    boot: Boot
    """What is ready by now."""
    sticks: Sticks = field(default_factory=lambda: Sticks(throttle=0.0))
    """Nobody at the radio: centred, throttle down. Writer: the pilot, by radio, MANUAL_CONTROL, RC_CHANNELS_OVERRIDE."""
    mode: Mode = Mode.STABILIZE
    """Writer: commander.py."""
    landed: bool = True
    """Writer: land_detector.py."""
    auto_armed: bool = False
    """Whether flying has been asked for since arming; until then it stays on the ground. Writer: setpoints.py."""
    ground_control: bool = False
    """Whether the position controllers idle along on the ground (bits of SYS_STATUS, HEARTBEAT). Writer: setpoints.py."""
    rtl_stage: str = ""
    """climb, return, loiter, land. Writer: flight_modes.py."""
    battery: BatteryLevel = BatteryLevel.OK
    """The worst that has been declared; nothing takes it back until the firmware restarts. Writer: failsafes.py."""
    prearm_good: bool = False
    """Whether nothing stood against arming at the last look. Writer: autopilot.py."""
    log_until_us: int = 0
    """How long the log stays open unarmed. Writer: commander.py."""

    @property
    def in_arming_delay(self) -> bool:
        """The first two seconds after arming: the motors do not turn yet."""
        return self.armed and self.clock.time_us - self.armed_us <= ARMING_DELAY_US

    @property
    def is_landing(self) -> bool:
        """Whether LAND flies, or the end of RTL."""
        return self.mode is Mode.LAND or (self.mode is Mode.RTL and self.rtl_stage == "land")

    @property
    def position_known(self) -> bool:
        """Whether the estimator has a position it vouches for."""
        return self.boot.position_found and self.core.position_valid

    @property
    def has_gps(self) -> bool:
        """Whether there is a receiver (GPS1_TYPE). Without, the position is that of poses from outside, taken as given."""
        return self.parameters["GPS1_TYPE"] != 0.0

    @property
    def gps_found(self) -> bool:
        """Whether the receiver has been found."""
        return self.has_gps and self.boot.gps_found

    @property
    def home_known(self) -> bool:
        """Whether there is a home; without a GPS nobody sets one."""
        return self.has_gps and self.boot.home_known

    @property
    def logs(self) -> bool:
        """Whether the log is open."""
        return self.armed or self.clock.time_us < self.log_until_us
