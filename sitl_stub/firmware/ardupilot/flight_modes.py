"""What each of ArduCopter's modes asks of the controllers; what they share is in `setpoints.py`.

Sticks are RC channels: with none connected the throttle is at its lowest, as in ArduPilot's own simulator, so that
height-holding modes with a stick come down.
"""

from __future__ import annotations

import math

import numpy as np

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.guided import Guided
from sitl_stub.firmware.ardupilot.land_detector import LOGIC_DT_S
from sitl_stub.firmware.ardupilot.modes import Mode
from sitl_stub.firmware.ardupilot.setpoints import Setpoints
from sitl_stub.firmware.ardupilot.shaping import sqrt_controller
from sitl_stub.firmware.ardupilot.state import ArduPilotState

BRAKE_ACCEL_M_S2 = 7.5
BRAKE_SPEED_Z_M_S = 2.5
RTL_ARRIVED_M = 2.0
LAND_PAUSE_US = 4_000_000
"""LAND_WITH_DELAY_MS."""
RTL_CLIMB_LEAST_M = 2.5
THROTTLE_DEAD = 0.1
"""Half width of the throttle stick's dead zone about the middle (THR_DZ 100 of 1000)."""


class FlightModes:
    """The modes of one vehicle."""

    def __init__(self, state: ArduPilotState, setpoints: Setpoints, guided: Guided) -> None:
        self.state = state
        self.setpoints = setpoints
        self.guided = guided
        self.rtl_height_m = 0.0
        self.takeoff_height_m: float | None = None
        """Target of NAV_TAKEOFF in modes with sticks, above the origin."""
        self._stage_since_us = 0
        self._descends_at_us = 0

    def enter(self, mode: Mode) -> None:
        """A mode begins: from where the vehicle is and as it moves."""
        a = self.state
        self._descends_at_us = 0
        core = a.core
        s, m = core.setpoint, core.memory
        self.takeoff_height_m = None
        was_positioning = m[at.NE_ACTIVE] > 0.0, m[at.UP_ACTIVE] > 0.0
        self.setpoints.start_position_control()
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
            self.guided.brake()
        elif mode is Mode.GUIDED_NOGPS:
            self.guided.begin_angle()
        elif mode is Mode.RTL:
            self._start_rtl()

    def run(self) -> bool:
        """A hundred times a second; whether a landing is over, and the motors are to stop."""
        a = self.state
        mode = a.mode
        down = False
        if not a.armed:
            self.setpoints.rest_on_ground()
        elif mode in (Mode.GUIDED, Mode.GUIDED_NOGPS):
            self.guided.run()
        elif mode is Mode.LAND:
            down = self._land()
        elif mode is Mode.RTL:
            down = self._return()
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
        return down

    def _limit_for_pilot(self) -> None:
        p, s = self.state.parameters, self.state.core.setpoint
        s[at.SPEED_UP] = p["PILOT_SPEED_UP"] * 0.01
        s[at.SPEED_DOWN] = (p["PILOT_SPEED_DN"] or p["PILOT_SPEED_UP"]) * 0.01
        s[at.ACCEL_UP] = p["PILOT_ACCEL_Z"] * 0.01
        s[at.SPEED_NE] = p["LOIT_SPEED"] * 0.01
        s[at.ACCEL_NE] = p["LOIT_ACC_MAX"] * 0.01

    def _stay(self) -> None:
        a = self.state
        if not a.auto_armed or a.landed:
            self.setpoints.rest_on_ground()
            return
        self.setpoints.follow_position()

    @property
    def pilot_climb_rate(self) -> float:
        """Climb rate the throttle stick asks for, m/s."""
        s = self.state.core.setpoint
        off = 2.0 * self.state.sticks.throttle - 1.0
        if abs(off) <= 2.0 * THROTTLE_DEAD:
            return 0.0
        part = (abs(off) - 2.0 * THROTTLE_DEAD) / (1.0 - 2.0 * THROTTLE_DEAD)
        return part * float(s[at.SPEED_UP]) if off > 0 else -part * float(s[at.SPEED_DOWN])

    def _hold_with_sticks(self) -> None:
        a = self.state
        core = a.core
        s, p = core.setpoint, a.parameters
        climb = self.pilot_climb_rate
        if climb > 0.0:
            self.setpoints.ask_to_fly()
        if self.takeoff_height_m is not None:
            if self.setpoints.run_take_off(self.takeoff_height_m) or climb < 0.0 < self.state.sticks.throttle:
                self.takeoff_height_m = None
            return
        if a.landed:
            if climb > 0.0:
                self.setpoints.spool_up_on_ground()
            else:
                self.setpoints.rest_on_ground()
            return
        self.setpoints.follow_position()
        s[at.UP_KIND] = at.KIND_VELOCITY
        s[at.VELOCITY + 2] = climb
        s[at.ACCELERATION + 2] = 0.0
        s[at.HEADING_KIND] = at.HEADING_RATE_ONLY
        s[at.HEADING_RATE] = math.radians(p["PILOT_Y_RATE"]) * self.state.sticks.yaw
        if a.mode is Mode.ALT_HOLD:
            self._lean_by_sticks()
            return
        s[at.NE_KIND] = at.KIND_VELOCITY
        cos_yaw, sin_yaw = math.cos(core.yaw), math.sin(core.yaw)
        forward, right = self.state.sticks.pitch, self.state.sticks.roll
        speed = float(s[at.SPEED_NE])
        s[at.VELOCITY] = speed * (cos_yaw * forward - sin_yaw * right)
        s[at.VELOCITY + 1] = speed * (sin_yaw * forward + cos_yaw * right)

    def _lean_by_sticks(self) -> None:
        a = self.state
        s = a.core.setpoint
        most = a.parameters["ANGLE_MAX"] * at.CENTIDEGREES
        s[at.LATERAL] = at.LATERAL_LEAN
        s[at.LEAN] = most * self.state.sticks.roll
        s[at.LEAN + 1] = -most * self.state.sticks.pitch

    def _fly_by_hand(self) -> None:
        a = self.state
        s, p = a.core.setpoint, a.parameters
        throttle = self.state.sticks.throttle
        if throttle > 0.0:
            self.setpoints.ask_to_fly()
        if a.landed and throttle <= 0.0:
            self.setpoints.rest_on_ground()
            return
        self.setpoints.follow_thrust()
        s[at.THROTTLE_CUTOFF_HZ] = p["PILOT_THR_FILT"]
        # the stick's middle is hover thrust: a cubic through (0, 0), (1/2, hover), (1, 1)
        hover = p["MOT_THST_HOVER"]
        expo = min(max(-(hover - 0.5) / 0.375, -0.5), 1.0)
        s[at.THRUST] = throttle * (1.0 - expo) + expo * throttle**3
        s[at.HEADING_RATE] = math.radians(p["PILOT_Y_RATE"]) * self.state.sticks.yaw
        if a.landed and a.core.spool_state == at.STATE_UNLIMITED:
            self.setpoints.land_detector.lift_off()
        if a.mode is Mode.ACRO:
            rate = math.radians(p["ACRO_RP_RATE"])
            s[at.LATERAL] = at.LATERAL_RATES
            s[at.RATES] = rate * self.state.sticks.roll
            s[at.RATES + 1] = -rate * self.state.sticks.pitch
            s[at.RATES + 2] = math.radians(p["ACRO_Y_RATE"]) * self.state.sticks.yaw
        else:
            self._lean_by_sticks()

    def _land(self) -> bool:
        a = self.state
        core, p = a.core, a.parameters
        s = core.setpoint
        if not a.auto_armed or a.landed:
            self.setpoints.rest_on_ground()
            return a.landed and core.spool_state == at.STATE_GROUND_IDLE
        slow = p["LAND_SPEED"] * 0.01
        fast = p["LAND_SPEED_HIGH"] * 0.01 if p["LAND_SPEED_HIGH"] > 0 else p["WPNAV_SPEED_DN"] * 0.01
        above_slow = max(p["LAND_ALT_LOW"], 100.0) * 0.01 - a.height_above_home_m
        rate = sqrt_controller(above_slow, p["PSC_POSZ_P"], p["WPNAV_ACCEL_Z"] * 0.01, LOGIC_DT_S)
        rate = min(max(rate, -max(fast, slow)), -slow)
        if a.mode is Mode.LAND and a.clock.time_us < self._descends_at_us:
            rate = 0.0
        s[at.IGNORE_DESCENT_LIMIT] = float(above_slow > 0.0 or self.setpoints.land_detector.maybe)
        s[at.UP_KIND] = at.KIND_VELOCITY
        s[at.VELOCITY + 2] = rate
        s[at.ACCELERATION + 2] = 0.0
        if not core.position_valid:
            s[at.SPOOL] = at.SPOOL_UNLIMITED
            s[at.VERTICAL] = at.VERTICAL_POSITION
            s[at.HEADING_RATE] = 0.0
            self._lean_by_sticks()
            return False
        s[at.NE_KIND] = at.KIND_VELOCITY
        s[at.VELOCITY : at.VELOCITY + 2] = 0.0
        s[at.SOFT_LANDING] = float(self.setpoints.land_detector.maybe)
        self.setpoints.follow_position()
        return False

    def pause_landing(self) -> None:
        """A failsafe has asked for LAND: stay for a while before the descent."""
        self._descends_at_us = self.state.clock.time_us + LAND_PAUSE_US

    def _start_rtl(self) -> None:
        a = self.state
        core, p = a.core, a.parameters
        height = -float(core.position_ned[2])
        away = a.distance_from_home_m
        above_home = max(p["RTL_ALT"] * 0.01, 0.0) - float(a.home_ned[2])
        wanted = max(height + p["RTL_CLIMB_MIN"] * 0.01, above_home)
        if p["RTL_CONE_SLOPE"] >= 0.5:
            cone = max(away * p["RTL_CONE_SLOPE"], height - -float(a.home_ned[2]) + RTL_CLIMB_LEAST_M)
            wanted = min(wanted, cone - float(a.home_ned[2]))
        self.rtl_height_m = max(wanted, height)
        self.state.rtl_stage = "climb"
        s = core.setpoint
        s[at.NE_KIND] = s[at.UP_KIND] = at.KIND_POSITION
        s[at.POSITION : at.POSITION + 2] = core.position_ned[:2]
        s[at.POSITION + 2] = self.rtl_height_m
        if p["RTL_SPEED"] > 0:
            s[at.SPEED_NE] = p["RTL_SPEED"] * 0.01

    def _return(self) -> bool:
        a = self.state
        s, p, core = a.core.setpoint, a.parameters, a.core
        if not a.auto_armed or (a.landed and self.state.rtl_stage != "land"):
            self.setpoints.rest_on_ground()
            return False
        now = a.clock.time_us
        if self.state.rtl_stage == "climb" and abs(-float(core.position_ned[2]) - self.rtl_height_m) < 0.5:
            s[at.POSITION : at.POSITION + 2] = a.home_ned[:2]
            self.state.rtl_stage = "return"
        elif self.state.rtl_stage == "return" and a.distance_from_home_m < RTL_ARRIVED_M:
            self.state.rtl_stage = "loiter"
            self._stage_since_us = now
        elif self.state.rtl_stage == "loiter" and now - self._stage_since_us >= p["RTL_LOIT_TIME"] * 1000:
            self.state.rtl_stage = "land"
            s[at.NE_KIND] = at.KIND_VELOCITY
        if self.state.rtl_stage == "land":
            return self._land()
        self.setpoints.follow_position()
        return False
