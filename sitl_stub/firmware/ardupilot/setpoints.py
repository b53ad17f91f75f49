"""What ArduCopter's modes share: what the controllers follow, their limits, and the ways on and off the ground.

Setpoints are written into the packed array of `layout.py`; shaping under acceleration and jerk limits is the
controllers' business.
"""

from __future__ import annotations

import math

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.land_detector import LOGIC_DT_S, LandDetector
from sitl_stub.firmware.ardupilot.state import ArduPilotState
from sitl_stub.firmware.common.vehicle_core import euler_of


class Setpoints:
    """Setpoints of one vehicle, and whether flying has been asked for."""

    def __init__(self, state: ArduPilotState, land_detector: LandDetector) -> None:
        self.state = state
        self.land_detector = land_detector
        self._throttle = 0.0

    # --- limits ------------------------------------------------------------------------------------------------
    def limit_vertical(self) -> None:
        """WPNAV's climb and descent limits."""
        p, s = self.state.parameters, self.state.core.setpoint
        s[at.SPEED_UP] = p["WPNAV_SPEED_UP"] * 0.01
        s[at.SPEED_DOWN] = p["WPNAV_SPEED_DN"] * 0.01
        s[at.ACCEL_UP] = p["WPNAV_ACCEL_Z"] * 0.01

    def limit_horizontal(self) -> None:
        """WPNAV's speed and acceleration."""
        p, s = self.state.parameters, self.state.core.setpoint
        s[at.SPEED_NE] = p["WPNAV_SPEED"] * 0.01
        s[at.ACCEL_NE] = p["WPNAV_ACCEL"] * 0.01

    def start_position_control(self) -> None:
        """Begin position control anew from where the vehicle is and as it moves."""
        core = self.state.core
        self.limit_horizontal()
        self.limit_vertical()
        core.memory[at.NE_ACTIVE] = core.memory[at.UP_ACTIVE] = 0.0
        s = core.setpoint
        s[at.HEADING_KIND] = at.HEADING_RATE_ONLY
        s[at.HEADING_RATE] = 0.0
        s[at.VELOCITY : at.VELOCITY + 3] = 0.0
        s[at.ACCELERATION : at.ACCELERATION + 3] = 0.0
        s[at.IGNORE_DESCENT_LIMIT] = s[at.SOFT_LANDING] = 0.0

    # --- what is being followed --------------------------------------------------------------------------------
    @property
    def follows_attitude(self) -> bool:
        """Whether the loops follow attitude or rate targets in the air."""
        s = self.state.core.setpoint
        in_air = s[at.SPOOL] == at.SPOOL_UNLIMITED and not self.state.landed
        return bool(in_air and s[at.LATERAL] in (at.LATERAL_QUATERNION, at.LATERAL_RATES))

    def follow_attitude(self) -> None:
        """Let the loops follow attitude targets."""
        s = self.state.core.setpoint
        s[at.SPOOL] = at.SPOOL_UNLIMITED
        s[at.LATERAL] = at.LATERAL_QUATERNION
        self.state.ground_control = False

    def follow_position(self) -> None:
        """Let the loops follow the position setpoint."""
        s = self.state.core.setpoint
        s[at.SPOOL] = at.SPOOL_UNLIMITED
        s[at.LATERAL] = at.LATERAL_POSITION
        s[at.VERTICAL] = at.VERTICAL_POSITION
        self.state.ground_control = False

    def follow_thrust(self) -> None:
        """Let the loops follow a thrust, whatever holds the attitude."""
        s = self.state.core.setpoint
        s[at.SPOOL] = at.SPOOL_UNLIMITED
        s[at.VERTICAL] = at.VERTICAL_THRUST
        self.state.ground_control = False

    def look_along_path(self, least_share: float) -> None:
        """Turn the nose where the desired velocity points, once that is more than a share of WPNAV_SPEED."""
        core = self.state.core
        s, m = core.setpoint, core.memory
        vx, vy = float(m[at.DESIRED_VELOCITY]), float(m[at.DESIRED_VELOCITY + 1])
        ax, ay = float(m[at.DESIRED_ACCELERATION]), float(m[at.DESIRED_ACCELERATION + 1])
        square = vx * vx + vy * vy
        s[at.HEADING_KIND] = at.HEADING_ANGLE
        if math.sqrt(square) > least_share * s[at.SPEED_NE]:
            s[at.HEADING] = math.atan2(vy, vx)
            s[at.HEADING_RATE] = (vx * ay - vy * ax) / square
        else:
            s[at.HEADING] = euler_of(core.target_quaternion)[2]
            s[at.HEADING_RATE] = 0.0

    # --- on and off the ground ---------------------------------------------------------------------------------
    def ask_to_fly(self) -> None:
        """A stick or a target asks for flight."""
        self.state.auto_armed = True

    def forget_flight(self) -> None:
        """Armed or disarmed anew: nothing has been asked for yet."""
        self.state.auto_armed = False

    def rest_on_ground(self) -> None:
        """Motors to idle (if armed), level, integrals empty."""
        a = self.state
        s = a.core.setpoint
        s[at.SPOOL] = at.SPOOL_GROUND_IDLE
        s[at.LATERAL] = at.LATERAL_RELAX
        s[at.VERTICAL] = at.VERTICAL_THRUST
        s[at.THROTTLE_CUTOFF_HZ] = 2.0
        s[at.THRUST] = 0.0
        s[at.IGNORE_DESCENT_LIMIT] = s[at.SOFT_LANDING] = 0.0
        a.core.memory[at.NE_ACTIVE] = a.core.memory[at.UP_ACTIVE] = 0.0
        a.ground_control = not a.mode.value.manual_throttle

    def _motors_up(self) -> None:
        a = self.state
        s = a.core.setpoint
        s[at.SPOOL] = at.SPOOL_UNLIMITED
        s[at.LATERAL] = at.LATERAL_RELAX
        s[at.VERTICAL] = at.VERTICAL_THRUST
        s[at.THROTTLE_CUTOFF_HZ] = a.parameters["PILOT_THR_FILT"]
        s[at.THRUST] = 0.0
        a.ground_control = False

    def spool_up_on_ground(self) -> None:
        """Motors up with no thrust; the ground is left when they have their full range."""
        self._motors_up()
        if self.state.core.spool_state == at.STATE_UNLIMITED:
            self.land_detector.lift_off()

    def start_take_off(self) -> None:
        """A climb by command begins."""
        self.start_position_control()
        self.ask_to_fly()
        self._throttle = 0.0

    def run_take_off(self, height_m: float) -> bool:
        """Thrust rises over TKOFF_SLEW_TIME until the vehicle moves, then climb to `height_m`; True when there."""
        a = self.state
        core, p = a.core, a.parameters
        s = core.setpoint
        if not a.armed or not a.auto_armed:
            self.rest_on_ground()
            return False
        if core.spool_state != at.STATE_UNLIMITED or s[at.SPOOL] != at.SPOOL_UNLIMITED:
            self._motors_up()
            self._throttle = 0.0
            return False
        if a.landed:
            self._throttle = min(self._throttle + LOGIC_DT_S / max(p["TKOFF_SLEW_TIME"], 0.1), 1.0)
            s[at.LATERAL] = at.LATERAL_RELAX
            s[at.VERTICAL] = at.VERTICAL_THRUST
            s[at.THROTTLE_CUTOFF_HZ] = 0.0
            s[at.THRUST] = self._throttle
            rising = float(core.memory[at.MEASURED_LIFT]) >= 0.5 * s[at.ACCEL_UP]
            rising |= -float(core.velocity_ned[2]) >= 0.1 * s[at.SPEED_UP]
            if rising or self._throttle >= min(p["TKOFF_THR_MAX"], 0.9):
                self.land_detector.lift_off()
                core.memory[at.NE_ACTIVE] = core.memory[at.UP_ACTIVE] = 0.0
            return False
        s[at.NE_KIND] = at.KIND_VELOCITY
        s[at.VELOCITY : at.VELOCITY + 3] = 0.0
        s[at.ACCELERATION : at.ACCELERATION + 3] = 0.0
        s[at.UP_KIND] = at.KIND_POSITION
        s[at.POSITION + 2] = height_m
        self.follow_position()
        return bool(float(core.memory[at.DESIRED_POSITION + 2]) >= height_m - 0.05)
