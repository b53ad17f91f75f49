"""Whether the vehicle is on the ground, as ArduCopter tells: from throttle, tilt, acceleration and speed, not truth."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sitl_stub.firmware import ardupilot_layout as at
from sitl_stub.firmware.ardupilot_modes import Mode
from sitl_stub.firmware.ardupilot_shaping import rotate

if TYPE_CHECKING:
    from sitl_stub.firmware.ardupilot import ArduPilot

LANDED_AFTER_S = 1.0
MAYBE_AFTER_S = 0.2
STATIONARY_M_S2 = 1.0
MOVING_M_S2 = 3.0
SLOW_M_S = 1.0
LARGE_ANGLE = math.radians(15.0)
LARGE_ERROR = math.radians(30.0)
ACCELERATION_CUTOFF_HZ = 1.0
LOGIC_DT_S = 0.01
MIX_MINIMUM, MIX_MANUAL, MIX_MAXIMUM = 0.0, 1.0, 2.0


class GroundSense:
    """Land detector, and how far attitude goes before thrust (ATC_THR_MIX_...), which it depends on."""

    def __init__(self, autopilot: ArduPilot) -> None:
        self.autopilot = autopilot
        self.quiet_s = 0.0
        self._acceleration = np.zeros(3)

    @property
    def maybe(self) -> bool:
        """Whether it looks like the ground since 0.2 s."""
        return self.autopilot.landed or self.quiet_s >= MAYBE_AFTER_S

    def update(self) -> None:
        """A hundred times a second."""
        a = self.autopilot
        core = a.core
        m, s = core.memory, core.setpoint
        w, x, y, z = core.quaternion.tolist()
        fx, fy, fz = core.specific_force_frd.tolist()
        force = np.array(rotate((w, x, y, z), (fx, fy, fz)))
        force[2] += 9.80665
        share = LOGIC_DT_S / (LOGIC_DT_S + 1.0 / (2.0 * math.pi * ACCELERATION_CUTOFF_HZ))
        self._acceleration += share * (force - self._acceleration)
        acceleration = float(np.linalg.norm(self._acceleration))
        _, tx, ty, _ = core.target_quaternion.tolist()
        tilt = math.acos(min(max(1.0 - 2.0 * (tx * tx + ty * ty), -1.0), 1.0))
        leaning = tilt > LARGE_ANGLE
        off = float(m[at.THRUST_ERROR_ANGLE]) > LARGE_ERROR
        if not a.armed:
            a.landed = True
            self.quiet_s = 0.0
            s[at.THROTTLE_MIX] = MIX_MINIMUM
            return
        quiet = (
            m[at.LIMIT_LOWER] > 0.0
            and float(m[at.RPY_MIX]) < 1.25 * core.gains[at.MIX_MIN]
            and not leaning
            and not off
            and acceleration <= STATIONARY_M_S2
            and abs(float(core.velocity_ned[2])) < SLOW_M_S
        )
        if a.landed:
            self.quiet_s = 0.0
        elif quiet:
            self.quiet_s += LOGIC_DT_S
            if self.quiet_s >= LANDED_AFTER_S:
                a.landed = True
        else:
            self.quiet_s = 0.0
        s[at.THROTTLE_MIX] = self._mix(leaning, off, acceleration)

    def _mix(self, leaning: bool, off: bool, acceleration: float) -> float:
        a = self.autopilot
        if a.landed:
            return MIX_MINIMUM
        if a.mode.value.manual_throttle:
            return MIX_MANUAL if a.flight.sticks.throttle > 0.0 else MIX_MINIMUM
        landing = a.mode is Mode.LAND or (a.mode is Mode.RTL and a.flight.rtl_stage == "land")
        descending = float(a.core.memory[at.DESIRED_VELOCITY + 2]) < 0.0
        if (leaning and not landing) or off or acceleration > MOVING_M_S2 or not descending:
            return MIX_MAXIMUM
        return MIX_MINIMUM
