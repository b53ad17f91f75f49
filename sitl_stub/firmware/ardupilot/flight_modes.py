"""What each of ArduCopter's modes asks of the controllers, and the ways on and off the ground they share.

Setpoints are written into the packed array of `layout.py`; shaping under acceleration and jerk limits is the
controllers' business. Sticks are RC channels: with none connected the throttle is at its lowest, as in ArduPilot's own
simulator, so that height-holding modes with a stick come down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.modes import Mode
from sitl_stub.firmware.ardupilot.shaping import sqrt_controller
from sitl_stub.firmware.common.vehicle_core import euler_of

if TYPE_CHECKING:
    from sitl_stub.firmware.ardupilot.autopilot import ArduPilot

BRAKE_ACCEL_M_S2 = 7.5
BRAKE_SPEED_Z_M_S = 2.5
RTL_ARRIVED_M = 2.0
LAND_PAUSE_US = 4_000_000
"""LAND_WITH_DELAY_MS."""
RTL_CLIMB_LEAST_M = 2.5
THROTTLE_DEAD = 0.1
"""Half width of the throttle stick's dead zone about the middle (THR_DZ 100 of 1000)."""
LOGIC_DT_S = 0.01


@dataclass(slots=True)
class Sticks:
    """RC channels 1 to 4, −1..1 (throttle 0..1). Nobody at the radio: centred, throttle down."""

    roll: float = 0.0
    pitch: float = 0.0
    """Nose up positive, as ArduPilot's channel 2."""
    throttle: float = 0.0
    yaw: float = 0.0


class Flight:
    """Setpoints of the modes of one vehicle."""

    def __init__(self, autopilot: ArduPilot) -> None:
        self.autopilot = autopilot
        self.sticks = Sticks()
        self.rtl_stage = ""
        self.rtl_height_m = 0.0
        self.ground_control = False
        """Whether the position controllers idle along on the ground (their bits in SYS_STATUS and HEARTBEAT)."""
        self.takeoff_height_m: float | None = None
        """Target of NAV_TAKEOFF in modes with sticks, above the origin."""
        self._stage_since_us = 0
        self._descends_at_us = 0
        self._throttle = 0.0

    # --- limits ------------------------------------------------------------------------------------------------
    def limit_vertical(self) -> None:
        """WPNAV's climb and descent limits."""
        p, s = self.autopilot.parameters, self.autopilot.core.setpoint
        s[at.SPEED_UP] = p["WPNAV_SPEED_UP"] * 0.01
        s[at.SPEED_DOWN] = p["WPNAV_SPEED_DN"] * 0.01
        s[at.ACCEL_UP] = p["WPNAV_ACCEL_Z"] * 0.01

    def limit_horizontal(self) -> None:
        """WPNAV's speed and acceleration."""
        p, s = self.autopilot.parameters, self.autopilot.core.setpoint
        s[at.SPEED_NE] = p["WPNAV_SPEED"] * 0.01
        s[at.ACCEL_NE] = p["WPNAV_ACCEL"] * 0.01

    def start_position_control(self) -> None:
        """Begin position control anew from where the vehicle is and as it moves."""
        core = self.autopilot.core
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
        s = self.autopilot.core.setpoint
        in_air = s[at.SPOOL] == at.SPOOL_UNLIMITED and not self.autopilot.landed
        return bool(in_air and s[at.LATERAL] in (at.LATERAL_QUATERNION, at.LATERAL_RATES))

    def follow_attitude(self) -> None:
        """Let the loops follow attitude targets."""
        s = self.autopilot.core.setpoint
        s[at.SPOOL] = at.SPOOL_UNLIMITED
        s[at.LATERAL] = at.LATERAL_QUATERNION
        self.ground_control = False

    def follow_position(self) -> None:
        """Let the loops follow the position setpoint."""
        s = self.autopilot.core.setpoint
        s[at.SPOOL] = at.SPOOL_UNLIMITED
        s[at.LATERAL] = at.LATERAL_POSITION
        s[at.VERTICAL] = at.VERTICAL_POSITION
        self.ground_control = False

    def look_along_path(self, least_share: float) -> None:
        """Turn the nose where the desired velocity points, once that is more than a share of WPNAV_SPEED."""
        core = self.autopilot.core
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
    def rest_on_ground(self) -> None:
        """Motors to idle (if armed), level, integrals empty."""
        a = self.autopilot
        s = a.core.setpoint
        s[at.SPOOL] = at.SPOOL_GROUND_IDLE
        s[at.LATERAL] = at.LATERAL_RELAX
        s[at.VERTICAL] = at.VERTICAL_THRUST
        s[at.THROTTLE_CUTOFF_HZ] = 2.0
        s[at.THRUST] = 0.0
        s[at.IGNORE_DESCENT_LIMIT] = s[at.SOFT_LANDING] = 0.0
        a.core.memory[at.NE_ACTIVE] = a.core.memory[at.UP_ACTIVE] = 0.0
        self.ground_control = not a.mode.value.manual_throttle

    def spool_up_on_ground(self) -> None:
        """Motors up with no thrust; the ground is left when they have their full range."""
        a = self.autopilot
        s = a.core.setpoint
        s[at.SPOOL] = at.SPOOL_UNLIMITED
        s[at.LATERAL] = at.LATERAL_RELAX
        s[at.VERTICAL] = at.VERTICAL_THRUST
        s[at.THROTTLE_CUTOFF_HZ] = a.parameters["PILOT_THR_FILT"]
        s[at.THRUST] = 0.0
        self.ground_control = False
        if a.core.spool_state == at.STATE_UNLIMITED:
            a.landed = False

    def start_take_off(self) -> None:
        """A climb by command begins."""
        a = self.autopilot
        self.start_position_control()
        a.auto_armed = True
        self._throttle = 0.0

    def run_take_off(self, height_m: float) -> bool:
        """Thrust rises over TKOFF_SLEW_TIME until the vehicle moves, then climb to `height_m`; True when there."""
        a = self.autopilot
        core, p = a.core, a.parameters
        s = core.setpoint
        if not a.armed or not a.auto_armed:
            self.rest_on_ground()
            return False
        if core.spool_state != at.STATE_UNLIMITED or s[at.SPOOL] != at.SPOOL_UNLIMITED:
            landed = a.landed
            self.spool_up_on_ground()
            a.landed = landed
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
                a.landed = False
                core.memory[at.NE_ACTIVE] = core.memory[at.UP_ACTIVE] = 0.0
            return False
        s[at.NE_KIND] = at.KIND_VELOCITY
        s[at.VELOCITY : at.VELOCITY + 3] = 0.0
        s[at.ACCELERATION : at.ACCELERATION + 3] = 0.0
        s[at.UP_KIND] = at.KIND_POSITION
        s[at.POSITION + 2] = height_m
        self.follow_position()
        return bool(float(core.memory[at.DESIRED_POSITION + 2]) >= height_m - 0.05)

    # --- modes -------------------------------------------------------------------------------------------------
    def enter(self, mode: Mode) -> None:
        """A mode begins: from where the vehicle is and as it moves."""
        a = self.autopilot
        self._descends_at_us = 0
        core = a.core
        s, m = core.setpoint, core.memory
        self.takeoff_height_m = None
        was_positioning = m[at.NE_ACTIVE] > 0.0, m[at.UP_ACTIVE] > 0.0
        self.start_position_control()
        s[at.NE_KIND] = s[at.UP_KIND] = at.KIND_VELOCITY
        if mode in (Mode.LAND, Mode.BRAKE):
            m[at.NE_ACTIVE], m[at.UP_ACTIVE] = (float(value) for value in was_positioning)
        if mode is Mode.BRAKE:
            s[at.SPEED_NE] = max(float(np.linalg.norm(core.velocity_ned)), 0.1)
            s[at.ACCEL_NE] = s[at.ACCEL_UP] = BRAKE_ACCEL_M_S2
            s[at.SPEED_UP] = s[at.SPEED_DOWN] = BRAKE_SPEED_Z_M_S
            m[at.NE_ACTIVE] = 0.0
        elif mode in (Mode.LOITER, Mode.POSHOLD, Mode.ALT_HOLD):
            self._limit_for_pilot()
        elif mode is Mode.GUIDED:
            a.guided.brake()
        elif mode is Mode.GUIDED_NOGPS:
            a.guided.begin_angle()
        elif mode is Mode.RTL:
            self._start_rtl()

    def run(self) -> None:
        """A hundred times a second."""
        a = self.autopilot
        mode = a.mode
        if not a.armed:
            self.rest_on_ground()
        elif mode in (Mode.GUIDED, Mode.GUIDED_NOGPS):
            a.guided.run()
        elif mode is Mode.LAND:
            self._land()
        elif mode is Mode.RTL:
            self._return()
        elif mode is Mode.BRAKE:
            self._stay()
        elif mode in (Mode.STABILIZE, Mode.ACRO):
            self._fly_by_hand()
        elif mode is Mode.AUTO:
            self._stay()
        else:
            self._hold_with_sticks()
        if a.in_arming_delay or not a.armed or a.killed:
            a.core.setpoint[at.SPOOL] = at.SPOOL_SHUT_DOWN

    def _limit_for_pilot(self) -> None:
        p, s = self.autopilot.parameters, self.autopilot.core.setpoint
        s[at.SPEED_UP] = p["PILOT_SPEED_UP"] * 0.01
        s[at.SPEED_DOWN] = (p["PILOT_SPEED_DN"] or p["PILOT_SPEED_UP"]) * 0.01
        s[at.ACCEL_UP] = p["PILOT_ACCEL_Z"] * 0.01
        s[at.SPEED_NE] = p["LOIT_SPEED"] * 0.01
        s[at.ACCEL_NE] = p["LOIT_ACC_MAX"] * 0.01

    def _stay(self) -> None:
        a = self.autopilot
        if not a.auto_armed or a.landed:
            self.rest_on_ground()
            return
        self.follow_position()

    @property
    def pilot_climb_rate(self) -> float:
        """Climb rate the throttle stick asks for, m/s."""
        s = self.autopilot.core.setpoint
        off = 2.0 * self.sticks.throttle - 1.0
        if abs(off) <= 2.0 * THROTTLE_DEAD:
            return 0.0
        part = (abs(off) - 2.0 * THROTTLE_DEAD) / (1.0 - 2.0 * THROTTLE_DEAD)
        return part * float(s[at.SPEED_UP]) if off > 0 else -part * float(s[at.SPEED_DOWN])

    def _hold_with_sticks(self) -> None:
        a = self.autopilot
        core = a.core
        s, p = core.setpoint, a.parameters
        climb = self.pilot_climb_rate
        if climb > 0.0:
            a.auto_armed = True
        if self.takeoff_height_m is not None:
            if self.run_take_off(self.takeoff_height_m) or climb < 0.0 < self.sticks.throttle:
                self.takeoff_height_m = None
            return
        if a.landed:
            if climb > 0.0:
                self.spool_up_on_ground()
            else:
                self.rest_on_ground()
            return
        self.follow_position()
        s[at.UP_KIND] = at.KIND_VELOCITY
        s[at.VELOCITY + 2] = climb
        s[at.ACCELERATION + 2] = 0.0
        s[at.HEADING_KIND] = at.HEADING_RATE_ONLY
        s[at.HEADING_RATE] = math.radians(p["PILOT_Y_RATE"]) * self.sticks.yaw
        if a.mode is Mode.ALT_HOLD:
            self._lean_by_sticks()
            return
        s[at.NE_KIND] = at.KIND_VELOCITY
        cos_yaw, sin_yaw = math.cos(core.yaw), math.sin(core.yaw)
        forward, right = -self.sticks.pitch, self.sticks.roll
        speed = float(s[at.SPEED_NE])
        s[at.VELOCITY] = speed * (cos_yaw * forward - sin_yaw * right)
        s[at.VELOCITY + 1] = speed * (sin_yaw * forward + cos_yaw * right)

    def _lean_by_sticks(self) -> None:
        a = self.autopilot
        s = a.core.setpoint
        most = a.parameters["ANGLE_MAX"] * at.CENTIDEGREES
        s[at.LATERAL] = at.LATERAL_LEAN
        s[at.LEAN] = most * self.sticks.roll
        s[at.LEAN + 1] = most * self.sticks.pitch

    def _fly_by_hand(self) -> None:
        a = self.autopilot
        s, p = a.core.setpoint, a.parameters
        throttle = self.sticks.throttle
        if throttle > 0.0:
            a.auto_armed = True
        if a.landed and throttle <= 0.0:
            self.rest_on_ground()
            self.ground_control = False
            return
        self.ground_control = False
        s[at.SPOOL] = at.SPOOL_UNLIMITED
        s[at.VERTICAL] = at.VERTICAL_THRUST
        s[at.THROTTLE_CUTOFF_HZ] = p["PILOT_THR_FILT"]
        # the stick's middle is hover thrust: a cubic through (0, 0), (1/2, hover), (1, 1)
        hover = p["MOT_THST_HOVER"]
        expo = min(max(-(hover - 0.5) / 0.375, -0.5), 1.0)
        s[at.THRUST] = throttle * (1.0 - expo) + expo * throttle**3
        s[at.HEADING_RATE] = math.radians(p["PILOT_Y_RATE"]) * self.sticks.yaw
        if a.landed and a.core.spool_state == at.STATE_UNLIMITED:
            a.landed = False
        if a.mode is Mode.ACRO:
            rate = math.radians(p["ACRO_RP_RATE"])
            s[at.LATERAL] = at.LATERAL_RATES
            s[at.RATES] = rate * self.sticks.roll
            s[at.RATES + 1] = rate * self.sticks.pitch
            s[at.RATES + 2] = math.radians(p["ACRO_Y_RATE"]) * self.sticks.yaw
        else:
            self._lean_by_sticks()

    def _land(self) -> None:
        a = self.autopilot
        core, p = a.core, a.parameters
        s = core.setpoint
        if not a.auto_armed or a.landed:
            self.rest_on_ground()
            if a.landed and core.spool_state == at.STATE_GROUND_IDLE:
                a.disarm()
            return
        slow = p["LAND_SPEED"] * 0.01
        fast = p["LAND_SPEED_HIGH"] * 0.01 if p["LAND_SPEED_HIGH"] > 0 else p["WPNAV_SPEED_DN"] * 0.01
        above_slow = max(p["LAND_ALT_LOW"], 100.0) * 0.01 - a.height_above_home_m
        rate = sqrt_controller(above_slow, p["PSC_POSZ_P"], p["WPNAV_ACCEL_Z"] * 0.01, LOGIC_DT_S)
        rate = min(max(rate, -max(fast, slow)), -slow)
        if a.mode is Mode.LAND and a.time_us < self._descends_at_us:
            rate = 0.0
        s[at.IGNORE_DESCENT_LIMIT] = float(above_slow > 0.0 or a.maybe_landed)
        s[at.UP_KIND] = at.KIND_VELOCITY
        s[at.VELOCITY + 2] = rate
        s[at.ACCELERATION + 2] = 0.0
        if not core.position_valid:
            s[at.SPOOL] = at.SPOOL_UNLIMITED
            s[at.VERTICAL] = at.VERTICAL_POSITION
            s[at.HEADING_RATE] = 0.0
            self._lean_by_sticks()
            return
        s[at.NE_KIND] = at.KIND_VELOCITY
        s[at.VELOCITY : at.VELOCITY + 2] = 0.0
        s[at.SOFT_LANDING] = float(a.maybe_landed)
        self.follow_position()

    def pause_landing(self) -> None:
        """A failsafe has asked for LAND: stay for a while before the descent."""
        self._descends_at_us = self.autopilot.time_us + LAND_PAUSE_US

    def _start_rtl(self) -> None:
        a = self.autopilot
        core, p = a.core, a.parameters
        height = -float(core.position_ned[2])
        away = a.distance_from_home_m
        above_home = max(p["RTL_ALT"] * 0.01, 0.0) - float(a.home_ned[2])
        wanted = max(height + p["RTL_CLIMB_MIN"] * 0.01, above_home)
        if p["RTL_CONE_SLOPE"] >= 0.5:
            cone = max(away * p["RTL_CONE_SLOPE"], height - -float(a.home_ned[2]) + RTL_CLIMB_LEAST_M)
            wanted = min(wanted, cone - float(a.home_ned[2]))
        self.rtl_height_m = max(wanted, height)
        self.rtl_stage = "climb"
        s = core.setpoint
        s[at.NE_KIND] = s[at.UP_KIND] = at.KIND_POSITION
        s[at.POSITION : at.POSITION + 2] = core.position_ned[:2]
        s[at.POSITION + 2] = self.rtl_height_m
        if p["RTL_SPEED"] > 0:
            s[at.SPEED_NE] = p["RTL_SPEED"] * 0.01

    def _return(self) -> None:
        a = self.autopilot
        s, p, core = a.core.setpoint, a.parameters, a.core
        if not a.auto_armed or (a.landed and self.rtl_stage != "land"):
            self.rest_on_ground()
            return
        now = a.time_us
        if self.rtl_stage == "climb" and abs(-float(core.position_ned[2]) - self.rtl_height_m) < 0.5:
            s[at.POSITION : at.POSITION + 2] = a.home_ned[:2]
            self.rtl_stage = "return"
        elif self.rtl_stage == "return" and a.distance_from_home_m < RTL_ARRIVED_M:
            self.rtl_stage = "loiter"
            self._stage_since_us = now
        elif self.rtl_stage == "loiter" and now - self._stage_since_us >= p["RTL_LOIT_TIME"] * 1000:
            self.rtl_stage = "land"
            s[at.NE_KIND] = at.KIND_VELOCITY
        if self.rtl_stage == "land":
            self._land()
        else:
            self.follow_position()
