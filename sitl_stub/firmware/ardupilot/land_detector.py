"""Whether the vehicle is on the ground, or lies there, as ArduCopter tells: from throttle, tilt, acceleration and speed,
not from its height. Of truth only the change of velocity is used, for the accelerometers that integrate it.
`land_detector.cpp`, `crash_check.cpp`.
"""

from __future__ import annotations

import math

import numpy as np

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.modes import Mode
from sitl_stub.firmware.ardupilot.state import ArduPilotState
from sitl_stub.physics import vehicle as body

LANDED_AFTER_S = 1.0
MAYBE_AFTER_S = 0.2
STATIONARY_M_S2 = 1.0
MOVING_M_S2 = 3.0
SLOW_M_S = 1.0
LARGE_ANGLE = math.radians(15.0)
LARGE_ERROR = math.radians(30.0)
ACCELERATION_CUTOFF_HZ = 1.0
LOGIC_DT_S = 0.01
CRASHED_AFTER_S = 2.0
CRASHED_SLOWER_M_S = 10.0
MIX_MINIMUM, MIX_MANUAL, MIX_MAXIMUM = 0.0, 1.0, 2.0


class LandDetector:
    """Land detector, the writer of `landed`; what depends on it: attitude against thrust (ATC_THR_MIX_...), crash check."""

    def __init__(self, state: ArduPilotState) -> None:
        self.state = state
        self.quiet_s = 0.0
        self._crashed_s = 0.0
        self._acceleration = np.zeros(3)
        self._velocity = np.zeros(3)
        """True: its change is what accelerometers have integrated, impacts on the ground included."""

    @property
    def maybe(self) -> bool:
        """Whether it looks like the ground since 0.2 s."""
        return self.state.landed or self.quiet_s >= MAYBE_AFTER_S

    def lift_off(self) -> None:
        """The motors have their full range, or the vehicle moves: the ground is left."""
        self.state.landed = False

    def disarmed(self) -> None:
        """Who is disarmed is taken to lie on the ground."""
        self.state.landed = True

    def update(self) -> str | None:
        """A hundred times a second; what tells of a crash after which it has to be disarmed, or None."""
        a = self.state
        core = a.core
        m, s = core.memory, core.setpoint
        _, x, y, _ = core.quaternion.tolist()
        velocity = core.state[body.VELOCITY_NED]
        share = LOGIC_DT_S / (LOGIC_DT_S + 1.0 / (2.0 * math.pi * ACCELERATION_CUTOFF_HZ))
        self._acceleration += share * ((velocity - self._velocity) / LOGIC_DT_S - self._acceleration)
        self._velocity[:] = velocity
        acceleration = float(np.linalg.norm(self._acceleration))
        _, tx, ty, _ = core.target_quaternion.tolist()
        tilt = math.acos(min(max(1.0 - 2.0 * (tx * tx + ty * ty), -1.0), 1.0))
        leaning = tilt > LARGE_ANGLE
        off = float(m[at.THRUST_ERROR_ANGLE]) > LARGE_ERROR
        if not a.armed:
            a.landed = True
            self.quiet_s = self._crashed_s = 0.0
            s[at.THROTTLE_MIX] = MIX_MINIMUM
            return None
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
        return self._crash(math.acos(min(max(1.0 - 2.0 * (x * x + y * y), -1.0), 1.0)), off, acceleration)

    def _crash(self, tilt: float, off: bool, acceleration: float) -> str | None:
        """FS_CRASH_CHECK: who lies on the side and cannot help it is disarmed."""
        a = self.state
        if (
            a.landed
            or a.parameters["FS_CRASH_CHECK"] == 0
            or a.mode is Mode.ACRO
            or acceleration >= MOVING_M_S2
            or tilt <= LARGE_ANGLE
            or not off
            or (a.position_known and float(np.linalg.norm(a.core.velocity_ned)) >= CRASHED_SLOWER_M_S)
        ):
            self._crashed_s = 0.0
            return None
        self._crashed_s += LOGIC_DT_S
        if self._crashed_s < CRASHED_AFTER_S:
            return None
        error = math.degrees(float(a.core.memory[at.THRUST_ERROR_ANGLE]))
        limit = math.degrees(LARGE_ERROR)
        figures = f"AngErr={error:.0f}>{limit:.0f}, Accel={acceleration:.1f}<{MOVING_M_S2:.1f}"
        return f"Crash: Disarming: {figures}"

    def _mix(self, leaning: bool, off: bool, acceleration: float) -> float:
        a = self.state
        if a.landed:
            return MIX_MINIMUM
        if a.mode.value.manual_throttle:
            return MIX_MANUAL if a.sticks.throttle > 0.0 else MIX_MINIMUM
        descending = float(a.core.memory[at.DESIRED_VELOCITY + 2]) < 0.0
        if (leaning and not a.is_landing) or off or acceleration > MOVING_M_S2 or not descending:
            return MIX_MAXIMUM
        return MIX_MINIMUM
