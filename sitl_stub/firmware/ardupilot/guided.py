"""GUIDED: what SET_ATTITUDE_TARGET and SET_POSITION_TARGET_LOCAL_NED mean to ArduCopter, and how long they hold.

Nothing here is ever acknowledged. A message that is not well formed (throttle ignored, some rates missing, a quaternion
off unit length, an impossible mask) makes the vehicle brake to a halt; after GUID_TIMEOUT without attitude targets it
levels and holds height, without velocity targets it stops, still in GUIDED.
"""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.modes import Mode
from sitl_stub.firmware.ardupilot.setpoints import Setpoints
from sitl_stub.firmware.ardupilot.shaping import from_euler
from sitl_stub.firmware.ardupilot.state import ArduPilotState
from sitl_stub.firmware.common.vehicle_core import euler_of
from sitl_stub.mavlink.codec import Received

IGNORE_RATES = 0b111
IGNORE_THROTTLE = 64
IGNORE_ATTITUDE = 128
IGNORE_POSITION = 0b111
IGNORE_VELOCITY = 0b111 << 3
IGNORE_ACCELERATION = 0b111 << 6
IS_FORCE = 1 << 9
IGNORE_YAW = 1 << 10
IGNORE_YAW_RATE = 1 << 11
LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED = 1, 7, 8, 9
THRUST_AS_THRUST = 8
UNIT_LENGTH_TOLERANCE = 1e-3
"""|q|² may be this far off one."""
FASTEST_SANE = 100.0
"""m/s; ArduCopter checks speeds so, the stub accelerations too."""
FURTHEST_SANE_M = 1e6
"""Nothing is that far; ArduCopter does not check, and would set off."""
TURNS_ALONG_ABOVE = 0.05
"""Share of WPNAV_SPEED above which the nose follows the path when no heading is given (WP_YAW_BEHAVIOR)."""


class Target(Enum):
    """What GUIDED is following."""

    VELOCITY = "velocity"
    """Velocity and acceleration; also standing still, which is how GUIDED begins."""
    POSITION = "position"
    """A place to go to and stop at."""
    TRAJECTORY = "trajectory"
    """Position with velocity and acceleration."""
    ACCELERATION = "acceleration"
    """Acceleration only."""
    ANGLE = "angle"
    """Attitude or rates, with thrust or climb rate."""
    TAKE_OFF = "take-off"
    """MAV_CMD_NAV_TAKEOFF."""


class Guided:
    """Targets of one vehicle in GUIDED."""

    def __init__(self, state: ArduPilotState, setpoints: Setpoints) -> None:
        self.state = state
        self.setpoints = setpoints
        self.target = Target.VELOCITY
        self.last_us = 0
        self.climb_rate_m_s = 0.0
        self.thrust = 0.0
        self.use_thrust = False
        self.take_off_height_m = 0.0
        self._attitude = np.zeros(at.SETPOINT_SIZE)
        self._heading_along_path = False

    # --- messages ----------------------------------------------------------------------------------------------
    def take_attitude(self, message: Received) -> None:
        """SET_ATTITUDE_TARGET."""
        v = message.values
        mask = v["type_mask"]
        quaternion: tuple[float, ...] | None = None
        if not mask & IGNORE_ATTITUDE:
            quaternion = tuple(float(value) for value in v["q"])
        rates_ignored = mask & IGNORE_RATES
        badly_formed = bool(mask & IGNORE_THROTTLE) or rates_ignored not in (0, IGNORE_RATES)
        if quaternion is not None:
            norm = math.sqrt(sum(value * value for value in quaternion))
            badly_formed |= not abs(norm * norm - 1.0) <= UNIT_LENGTH_TOLERANCE
        rates = (0.0, 0.0, 0.0)
        if not rates_ignored:
            rates = (float(v["body_roll_rate"]), float(v["body_pitch_rate"]), float(v["body_yaw_rate"]))
        thrust = float(v["thrust"])
        if badly_formed or not all(math.isfinite(value) for value in (*rates, thrust)):
            self.brake()
            return
        p = self.state.parameters
        if self.target is not Target.ANGLE:
            self.target = Target.ANGLE
            self.setpoints.limit_vertical()
        if int(p["GUID_OPTIONS"]) & THRUST_AS_THRUST:
            self.use_thrust = True
            self.thrust = min(max(thrust, -1.0), 1.0)
            self.climb_rate_m_s = 0.0
        else:
            self.use_thrust = False
            self.thrust = 0.0
            part = 2.0 * (min(max(thrust, 0.0), 1.0) - 0.5)
            speed = p["WPNAV_SPEED_UP"] if part > 0 else p["WPNAV_SPEED_DN"]
            self.climb_rate_m_s = part * speed * 0.01
        a = self._attitude
        a[at.LATERAL] = at.LATERAL_RATES if quaternion is None else at.LATERAL_QUATERNION
        if quaternion is not None:
            a[at.QUATERNION : at.QUATERNION + 4] = quaternion
        a[at.RATES : at.RATES + 3] = rates
        self.last_us = self.state.clock.time_us
        self._put_attitude()

    def take_position(self, message: Received) -> None:
        """SET_POSITION_TARGET_LOCAL_NED."""
        v = message.values
        mask, frame = v["type_mask"], v["coordinate_frame"]
        has_position = not mask & IGNORE_POSITION
        has_velocity = not mask & IGNORE_VELOCITY
        has_acceleration = not mask & IGNORE_ACCELERATION
        kinds = {
            (True, True): Target.TRAJECTORY,
            (False, True): Target.VELOCITY,
        }
        target = kinds.get((has_position, has_velocity))
        if target is None and not has_velocity:
            if has_acceleration and not has_position:
                target = Target.ACCELERATION
            elif has_position and not has_acceleration:
                target = Target.POSITION
        known = frame in (LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED)
        vectors = [
            tuple(float(v[name]) if used else 0.0 for name in names)
            for used, names in (
                (has_position, ("x", "y", "z")),
                (has_velocity, ("vx", "vy", "vz")),
                (has_acceleration, ("afx", "afy", "afz")),
            )
        ]
        sane = all(math.isfinite(value) for vector in vectors for value in vector)
        sane &= all(abs(value) <= FASTEST_SANE for vector in vectors[1:] for value in vector)
        sane &= all(abs(value) <= FURTHEST_SANE_M for value in vectors[0])
        sane &= bool(mask & IGNORE_YAW) or math.isfinite(v["yaw"])
        sane &= bool(mask & IGNORE_YAW_RATE) or math.isfinite(v["yaw_rate"])
        if target is None or not known or not sane or (mask & IS_FORCE and has_acceleration):
            self.brake()
            return
        core = self.state.core
        turned = frame in (BODY_NED, BODY_OFFSET_NED)
        if turned:
            vectors = [self._turned(vector, core.yaw) for vector in vectors]
        position, velocity, acceleration = (np.array((x, y, -z)) for x, y, z in vectors)
        if frame != LOCAL_NED:
            north, east, down = core.position_ned
            position = position + np.array((north, east, -down))
        heading = None if mask & IGNORE_YAW else float(v["yaw"]) + (core.yaw if turned else 0.0)
        rate = None if mask & IGNORE_YAW_RATE else float(v["yaw_rate"])
        self._follow(target, position, velocity, acceleration, heading, rate)

    @staticmethod
    def _turned(vector: tuple[float, ...], yaw: float) -> tuple[float, ...]:
        c, s = math.cos(yaw), math.sin(yaw)
        return (c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2])

    def go_to(self, position_neu: tuple[float, float, float], heading: float | None = None) -> None:
        """Fly to a place and stop (DO_REPOSITION, SET_POSITION_TARGET_GLOBAL_INT)."""
        self._follow(Target.POSITION, np.array(position_neu), np.zeros(3), np.zeros(3), heading, None)

    def turn_to(self, heading: float) -> None:
        """CONDITION_YAW."""
        s = self.state.core.setpoint
        self._heading_along_path = False
        s[at.HEADING_KIND] = at.HEADING_ANGLE
        s[at.HEADING] = heading
        s[at.HEADING_RATE] = 0.0

    def _follow(
        self,
        target: Target,
        position: np.ndarray,
        velocity: np.ndarray,
        acceleration: np.ndarray,
        heading: float | None,
        heading_rate: float | None,
    ) -> None:
        s = self.state.core.setpoint
        if self.target is not target:
            self.setpoints.start_position_control()
            self.target = target
        kind = {
            Target.POSITION: at.KIND_POSITION,
            Target.TRAJECTORY: at.KIND_TRAJECTORY,
            Target.VELOCITY: at.KIND_VELOCITY,
            Target.ACCELERATION: at.KIND_ACCELERATION,
        }[target]
        s[at.NE_KIND] = s[at.UP_KIND] = kind
        s[at.POSITION : at.POSITION + 3] = position
        s[at.VELOCITY : at.VELOCITY + 3] = velocity
        s[at.ACCELERATION : at.ACCELERATION + 3] = acceleration
        self._heading_along_path = heading is None and heading_rate is None
        if heading is not None:
            s[at.HEADING_KIND] = at.HEADING_ANGLE
            s[at.HEADING] = heading
            s[at.HEADING_RATE] = heading_rate or 0.0
        elif heading_rate is not None:
            s[at.HEADING_KIND] = at.HEADING_RATE_ONLY
            s[at.HEADING_RATE] = heading_rate
        self.last_us = self.state.clock.time_us

    # --- states ------------------------------------------------------------------------------------------------
    def brake(self) -> None:
        """Begin GUIDED anew: stop and stay. Without a position (GUIDED_NOGPS): level, hold height."""
        if self.state.mode is Mode.GUIDED_NOGPS:
            self.begin_angle()
            return
        self.setpoints.start_position_control()
        s = self.state.core.setpoint
        self.target = Target.VELOCITY
        s[at.NE_KIND] = s[at.UP_KIND] = at.KIND_VELOCITY
        s[at.VELOCITY : at.VELOCITY + 3] = 0.0
        s[at.ACCELERATION : at.ACCELERATION + 3] = 0.0
        self._heading_along_path = True
        self.last_us = self.state.clock.time_us

    def begin_angle(self) -> None:
        """Level, present heading, hold height: how GUIDED_NOGPS begins."""
        self.target = Target.ANGLE
        self.use_thrust = False
        self.thrust = self.climb_rate_m_s = 0.0
        self.setpoints.limit_vertical()
        self._level()
        self.last_us = self.state.clock.time_us

    def take_off(self, height_m: float) -> None:
        """MAV_CMD_NAV_TAKEOFF to a height above the estimator's origin."""
        self.target = Target.TAKE_OFF
        self.take_off_height_m = height_m
        self.setpoints.start_take_off()

    def _level(self) -> None:
        a = self._attitude
        yaw = euler_of(self.state.core.target_quaternion)[2]
        a[at.LATERAL] = at.LATERAL_QUATERNION
        a[at.QUATERNION : at.QUATERNION + 4] = from_euler(0.0, 0.0, yaw)
        a[at.RATES : at.RATES + 3] = 0.0

    @property
    def timed_out(self) -> bool:
        """Whether the last target is older than GUID_TIMEOUT."""
        timeout = max(self.state.parameters["GUID_TIMEOUT"], 0.1)
        return self.state.clock.time_us - self.last_us > timeout * 1e6

    def _put_attitude(self) -> None:
        """Give the attitude target to the loops at once, if they are following attitude targets already."""
        a, s = self._attitude, self.state.core.setpoint
        if not self.setpoints.follows_attitude:
            return
        s[at.LATERAL] = a[at.LATERAL]
        s[at.QUATERNION : at.RATES + 3] = a[at.QUATERNION : at.RATES + 3]
        if self.use_thrust:
            s[at.VERTICAL] = at.VERTICAL_THRUST
            s[at.THRUST] = self.thrust
            s[at.THROTTLE_CUTOFF_HZ] = self.state.parameters["PILOT_THR_FILT"]
        else:
            s[at.VERTICAL] = at.VERTICAL_POSITION
            s[at.UP_KIND] = at.KIND_VELOCITY
            s[at.VELOCITY + 2] = self.climb_rate_m_s
            s[at.ACCELERATION + 2] = 0.0

    def run(self) -> None:
        """A hundred times a second."""
        if self.target is Target.TAKE_OFF:
            self.setpoints.run_take_off(self.take_off_height_m)
        elif self.target is Target.ANGLE:
            self._run_angle()
        else:
            self._run_position()

    def _run_angle(self) -> None:
        a = self.state
        if self.timed_out and (self.use_thrust or self.climb_rate_m_s or a.core.setpoint[at.LATERAL]):
            self._level()
            self.use_thrust = False
            self.thrust = self.climb_rate_m_s = 0.0
        rising = (self.thrust if self.use_thrust else self.climb_rate_m_s) > 0.0
        if rising and a.armed:
            self.setpoints.ask_to_fly()
        if not a.armed or not a.auto_armed or (a.landed and not rising):
            self.setpoints.rest_on_ground()
        elif a.landed:
            self.setpoints.spool_up_on_ground()
        else:
            if not self.setpoints.follows_attitude:
                self.setpoints.follow_attitude()
                self._put_attitude()
            elif self.timed_out:
                self._put_attitude()

    def _run_position(self) -> None:
        a, s = self.state, self.state.core.setpoint
        if not a.armed or not a.auto_armed or a.landed:
            self.setpoints.rest_on_ground()
            return
        if self.timed_out:
            if self.target is Target.ACCELERATION:
                s[at.NE_KIND] = s[at.UP_KIND] = at.KIND_VELOCITY
            if self.target is not Target.POSITION:
                s[at.VELOCITY : at.VELOCITY + 3] = 0.0
                s[at.ACCELERATION : at.ACCELERATION + 3] = 0.0
            if s[at.HEADING_KIND] == at.HEADING_RATE_ONLY:
                s[at.HEADING_RATE] = 0.0
        if self._heading_along_path:
            self.setpoints.look_along_path(TURNS_ALONG_ABOVE)
        self.setpoints.follow_position()
