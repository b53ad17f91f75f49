"""What every firmware knows of itself. Its parts get this, with the brand's own fields, and never the autopilot."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.common.clock import Clock
from sitl_stub.firmware.common.globe import LocalOrigin
from sitl_stub.firmware.common.parameters import ParameterTable
from sitl_stub.firmware.common.plans import Plans
from sitl_stub.firmware.common.radio import Radio
from sitl_stub.firmware.common.sticks import Sticks
from sitl_stub.firmware.common.vehicle_core import VehicleCore
from sitl_stub.physics import vehicle as body


@dataclass(kw_only=True)
class FirmwareState:
    """Made anew whenever the firmware starts. Each field has one writer, named beside it."""

    core: VehicleCore
    parameters: ParameterTable
    clock: Clock
    origin: LocalOrigin
    """Where local (0, 0, 0) lies on the globe."""
    radio: Radio
    """The pilot's receiver, which outlives a restart."""
    plans: Plans = field(default_factory=Plans)
    """Mission, fence and rally points, which outlive a restart."""
    killed: bool = False
    """The pilot's kill switch: rotors stopped though armed. Writer: the pilot (`Autopilot.pilot_kill`)."""
    sticks: Sticks = field(default_factory=Sticks)
    """Writer: the pilot, by radio or MANUAL_CONTROL."""
    heartbeats: dict[tuple[int, int], int] = field(default_factory=dict)
    """Simulated time of the last HEARTBEAT by sender (system, component), µs. Writer: `Autopilot`."""
    armed: bool = False
    """Whether the rotors may turn. Writer: commander.py."""
    armed_us: int = 0
    """Simulated time of the last arming. Writer: commander.py."""
    home_ned: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """Writer: commander.py, on arming and for DO_SET_HOME."""

    @property
    def height_above_home_m(self) -> float:
        """Estimated height over home."""
        return float(self.home_ned[2] - self.core.position_ned[2])

    @property
    def distance_from_home_m(self) -> float:
        """Estimated horizontal distance from home."""
        offset = self.core.position_ned[:2] - self.home_ned[:2]
        return math.hypot(float(offset[0]), float(offset[1]))

    @property
    def altitude_m(self) -> float:
        """Estimated altitude above sea level."""
        return self.origin.altitude_of(float(self.core.position_ned[2]))

    @property
    def pressure_hpa(self) -> float:
        """Of the standard atmosphere at the estimated height."""
        return 1013.25 * float(max(1.0 - 2.25577e-5 * self.altitude_m, 0.0) ** 5.25588)

    @property
    def charge_left(self) -> float:
        """The battery's remaining share of its charge."""
        core = self.core
        return 1.0 - float(core.state[body.CHARGE_USED] / core.parameters_packed[body.BATTERY_CAPACITY])
