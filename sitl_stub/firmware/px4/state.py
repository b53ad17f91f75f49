"""What one PX4 knows of itself: what its parts read of each other, each field with its one writer."""

from __future__ import annotations

from dataclasses import dataclass

from sitl_stub.firmware.common.state import FirmwareState
from sitl_stub.firmware.px4.battery import BatteryLevel
from sitl_stub.firmware.px4.core import FlightCore
from sitl_stub.firmware.px4.land_detector import ON_GROUND, Ground
from sitl_stub.firmware.px4.modes import Mode

RADIO_ONLY, NO_STICKS = 0, 4
"""COM_RC_IN_MODE."""


@dataclass(frozen=True, slots=True)
class Px4Version:
    """What differs between releases."""

    name: str
    flight_sw_version: int
    takes_actuator_controls: bool
    """SET_ACTUATOR_CONTROL_TARGET does something (until 1.13)."""
    old_mixers: bool
    """Fixed mixers with 1.13's normalisation."""
    speaks_events: bool
    """Announces with EVENT rather than STATUSTEXT."""
    newer_reports: bool
    """Sends CURRENT_MODE, the way home in seconds, the receiver's integrity and remote identification."""


VERSION_1_17 = Px4Version("px4", 0x011100FF, False, False, True, True)
VERSION_1_13 = Px4Version("px4-1.13", 0x010D03FF, True, True, False, False)


@dataclass(kw_only=True)
class Px4State(FirmwareState):
    """One PX4."""

    core: FlightCore
    version: Px4Version
    ready_after_us: int
    intended: Mode = Mode.LOITER
    """What was last asked for. Writer: commander.py."""
    mode: Mode = Mode.LOITER
    """What flies. Writer: commander.py."""
    failsafe: bool = False
    """Whether `mode` is that of a failsafe. Writer: commander.py."""
    battery: BatteryLevel = BatteryLevel.OK
    """As it is now. Writer: commander.py."""
    ground: Ground = ON_GROUND
    """What the land detector found. Writer: autopilot.py."""
    home_quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Writer: commander.py, with `home_ned`."""
    home_set_us: int = 0
    """Time stamp of home's attitude. Writer: commander.py."""

    @property
    def estimator_ready(self) -> bool:
        """Whether the estimate has converged."""
        return self.clock.uptime_us >= int(0.75 * self.ready_after_us)

    @property
    def system_ready(self) -> bool:
        """Whether everything but the mode's own needs is there for arming."""
        return self.clock.uptime_us >= self.ready_after_us and self.core.attitude_valid

    @property
    def gps_fix(self) -> tuple[int, int]:
        """GPS_FIX_TYPE and the number of satellites."""
        if not self.core.position_aided:
            return 0, 0
        return (3, 10) if self.core.position_valid else (1, 10)

    @property
    def home_known(self) -> bool:
        """Whether HOME_POSITION has been set."""
        return self.clock.uptime_us >= int(0.55 * self.ready_after_us)

    @property
    def accepts_joystick(self) -> bool:
        """COM_RC_IN_MODE: 0 takes radio sticks only, 4 none; the rest take MANUAL_CONTROL."""
        return int(self.parameters["COM_RC_IN_MODE"]) not in (RADIO_ONLY, NO_STICKS)
