"""What PX4's own modes ask of the position controller: hold, take-off, land, return, and sticks.

Setpoints move under limits of speed and acceleration (MPC_XY_CRUISE, MPC_Z_V_AUTO_UP/DN, MPC_ACC_HOR, MPC_LAND_SPEED ...);
`follower.py` moves them. Nothing slows to MPC_LAND_CRWL near the ground: the capture's vehicle has no distance sensor.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.px4.follower import Follower
from sitl_stub.firmware.px4.mission import Mission
from sitl_stub.firmware.px4.modes import Mode
from sitl_stub.firmware.px4.orbit import Orbit
from sitl_stub.firmware.px4.state import Px4State

NAN = float("nan")
NOWHERE = (NAN, NAN, NAN)
ARRIVED_M = 0.3


class Navigator:
    """Setpoints of every mode but OFFBOARD."""

    def __init__(self, state: Px4State) -> None:
        self.state = state
        self.mode: Mode | None = None
        self.follower = Follower()
        self.target = np.zeros(3)
        self.yaw = 0.0
        self.started_us = 0
        self.stage = ""
        self.sticks = state.sticks
        self.mission = Mission(state)
        self.orbit = Orbit(state)
        self.vertical_velocity = 0.0
        self.reposition: NDArray[np.float64] | None = None
        self.takeoff_altitude_m: float | None = None
        """Asked for by the next MAV_CMD_NAV_TAKEOFF, above home."""
        self.climb_m = 0.0
        """The take-off's height above home."""

    def enter(self, mode: Mode) -> None:
        """A mode begins: from where the vehicle is and as it moves."""
        core = self.state.core
        p = self.state.parameters
        previous = self.mode
        self.mode = mode
        self.started_us = core.time_us
        self.stage = "start"
        self.yaw = core.yaw
        self.reposition = None
        if not (previous is Mode.TAKEOFF and mode is Mode.LOITER):
            self.follower.start(core.position_ned, core.velocity_ned)
            self.target = np.array(core.position_ned)
            # where it can stop
            speed = float(np.linalg.norm(core.velocity_ned[:2]))
            if speed > 0.1:
                self.target[:2] += core.velocity_ned[:2] * speed / (2.0 * p["MPC_ACC_HOR"])
        if mode is Mode.TAKEOFF:
            asked = self.takeoff_altitude_m
            self.climb_m = float(p["MIS_TAKEOFF_ALT"]) if asked is None else asked
            self.target[2] = min(float(self.state.home_ned[2]) - self.climb_m, float(self.target[2]))
            self.takeoff_altitude_m = None
        self.vertical_velocity = float(core.velocity_ned[2])
        if mode is Mode.MISSION:
            self.mission.enter()

    def update(self, dt_s: float) -> bool:
        """Move the present mode's setpoint on by `dt_s` and give it to the loops; whether a climb of TAKEOFF is over."""
        mode = self.mode
        if mode is Mode.LOITER:
            self._hold(dt_s)
        elif mode is Mode.TAKEOFF:
            return self._take_off(dt_s)
        elif mode is Mode.RTL:
            self._return(dt_s)
        elif mode is Mode.MISSION:
            self._fly_mission(dt_s)
        elif mode is Mode.ORBIT:
            self._circle(dt_s)
        elif mode in (Mode.LAND, Mode.PRECISION_LAND):
            self._land(dt_s)
        elif mode is Mode.POSCTL:
            self._position_by_sticks(dt_s)
        elif mode is Mode.ALTCTL:
            self._altitude_by_sticks(dt_s)
        elif mode is Mode.ACRO:
            self._rates_by_sticks()
        elif mode in (Mode.STABILIZED, Mode.MANUAL):
            self._attitude_by_sticks(dt_s)
        return False

    def _follow(self, dt_s: float, up: float, down: float) -> None:
        p = self.state.parameters
        self.follower.move(
            self.target, p["MPC_XY_CRUISE"], up, down, p["MPC_ACC_HOR"], p["MPC_ACC_DOWN_MAX"], dt_s
        )
        f = self.follower
        self._send(tuple(f.position), tuple(f.velocity))

    def _send(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        self.state.core.follow_trajectory(
            (position[0], position[1], position[2]),
            (velocity[0], velocity[1], velocity[2]),
            NOWHERE,
            self.yaw,
        )

    def _travel(self, dt_s: float) -> None:
        p = self.state.parameters
        self._follow(dt_s, p["MPC_Z_V_AUTO_UP"], p["MPC_Z_V_AUTO_DN"])

    def _hold(self, dt_s: float) -> None:
        if self.reposition is not None:
            self.target = self.reposition
            self.reposition = None
        if self.state.ground.landed:
            self._stay_on_ground()
            return
        self._travel(dt_s)

    def _stay_on_ground(self) -> None:
        core = self.state.core
        self.follower.start(core.position_ned, np.zeros(3))
        self.target = np.array(core.position_ned)
        self.yaw = core.yaw
        core.follow_attitude(core.quaternion, 0.0)

    def _take_off(self, dt_s: float) -> bool:
        core, p = self.state.core, self.state.parameters
        waited = (core.time_us - max(self.started_us, self.state.armed_us)) * 1e-6
        spool_up = p["COM_SPOOLUP_TIME"]
        if self.state.ground.landed and waited < spool_up:
            self._stay_on_ground()
            self.target[2] = min(float(self.state.home_ned[2]) - self.climb_m, float(core.position_ned[2]))
            return False
        ramp = p["MPC_TKO_RAMP_T"]
        progress = (waited - spool_up) / ramp if ramp > 0 else 1.0
        if progress < 1.0 and float(core.position_ned[2]) > float(self.state.home_ned[2]) - 0.3:
            # The velocity setpoint rises from one that means no thrust to the climb speed, so that thrust ramps up.
            from_down = 9.81 / p["MPC_Z_VEL_P_ACC"]
            climb = from_down + (-p["MPC_TKO_SPEED"] - from_down) * max(progress, 0.0)
            self.follower.start(core.position_ned, np.array([0.0, 0.0, min(climb, 0.0)]))
            self._send((self.target[0], self.target[1], NAN), (0.0, 0.0, climb))
            return False
        self._follow(dt_s, p["MPC_TKO_SPEED"], 1.0)
        return abs(float(core.position_ned[2] - self.target[2])) < ARRIVED_M

    def _circle(self, dt_s: float) -> None:
        inwards = self.orbit.move(self.follower, dt_s)
        self.yaw = self.orbit.yaw
        (x, y, z), (vx, vy, vz) = self.follower.position.tolist(), self.follower.velocity.tolist()
        self.state.core.follow_trajectory((x, y, z), (vx, vy, vz), inwards, self.yaw)

    def _fly_mission(self, dt_s: float) -> None:
        core, p, mission = self.state.core, self.state.parameters, self.mission
        if self.stage == "start":
            self.stage = "under way"
            height = mission.first_height_m
            if self.state.ground.landed and math.isfinite(height):
                self.stage, self.climb_m = "climb", max(height, float(p["MIS_TAKEOFF_ALT"]))
                self.target[2] = min(float(self.state.home_ned[2]) - self.climb_m, float(self.target[2]))
        if self.stage == "climb":
            if self._take_off(dt_s):
                self.stage = "under way"
            return
        goal = mission.step()
        if goal is None:
            if self.state.ground.landed:
                self._stay_on_ground()
            else:
                self._travel(dt_s)
            return
        if goal.lands:
            if self.stage != "land":
                self.stage, self.vertical_velocity = "land", float(core.velocity_ned[2])
            self.target[:2] = goal.target_ned[:2]
            self._land(dt_s)
            return
        if self.stage == "land":
            self.follower.start(core.position_ned, core.velocity_ned)
            self.stage = "under way"
        self.target = np.array(goal.target_ned)
        if goal.target_ned[2] >= float(self.state.home_ned[2]):  # on the way to where it lands
            self.target[2] = self.follower.position[2]
        turn = math.remainder(goal.yaw_rad - self.yaw, 2.0 * math.pi)
        most = math.radians(p["MPC_YAWRAUTO_MAX"]) * dt_s
        self.yaw += min(max(turn, -most), most)
        self.follower.move(
            self.target,
            goal.speed_m_s,
            p["MPC_Z_V_AUTO_UP"],
            p["MPC_Z_V_AUTO_DN"],
            p["MPC_ACC_HOR"],
            p["MPC_ACC_DOWN_MAX"],
            dt_s,
        )
        self._send(tuple(self.follower.position), tuple(self.follower.velocity))

    def _land(self, dt_s: float) -> None:
        core, p = self.state.core, self.state.parameters
        if self.state.ground.contact:
            core.follow_attitude(np.array([math.cos(self.yaw / 2), 0.0, 0.0, math.sin(self.yaw / 2)]), 0.0)
            return
        height = self.state.height_above_home_m
        fast, slow = p["MPC_Z_V_AUTO_DN"], p["MPC_LAND_SPEED"]
        high, low = p["MPC_LAND_ALT1"], p["MPC_LAND_ALT2"]
        share = min(max((height - low) / max(high - low, 0.1), 0.0), 1.0)
        speed = slow + (max(fast, slow) - slow) * share
        change = p["MPC_ACC_DOWN_MAX"] * dt_s
        self.vertical_velocity += min(max(speed - self.vertical_velocity, -change), change)
        if not core.position_valid:
            self._send(NOWHERE, (NAN, NAN, self.vertical_velocity))
            return
        self.follower.move(self.target, 1.0, 1.0, 1.0, p["MPC_ACC_HOR"], p["MPC_ACC_DOWN_MAX"], dt_s)
        place, moving = self.follower.position, self.follower.velocity
        self._send((place[0], place[1], NAN), (moving[0], moving[1], self.vertical_velocity))

    def return_height(self, away_m: float, height_m: float) -> float:
        """Height above home, m, to which a return climbs from `height_m` (PX4's `RTL::computeReturnAltitude`).

        Near home it stays inside a cone about it instead of climbing to RTL_RETURN_ALT.
        """
        p = self.state.parameters
        highest, cone_deg = float(p["RTL_RETURN_ALT"]), float(p["RTL_CONE_ANG"])
        wanted = highest
        if cone_deg > 0.0:
            accepted = float(p["NAV_ACC_RAD"])
            if away_m <= accepted:
                wanted = 2.0 * away_m
            elif away_m <= p["RTL_MIN_DIST"]:
                inside = away_m / math.tan(math.radians(min(max(cone_deg, 1.0), 89.0)))
                wanted = max(min(inside, highest), 2.0 * accepted)
        return max(height_m, min(wanted, highest))

    def _return(self, dt_s: float) -> None:
        p, home = self.state.parameters, self.state.home_ned
        core, away = self.state.core, self.state.distance_from_home_m
        if self.stage == "start":
            self.target[2] = home[2] - self.return_height(away, self.state.height_above_home_m)
            self.stage = "climb"
        if self.stage == "climb" and abs(float(core.position_ned[2] - self.target[2])) < p["NAV_MC_ALT_RAD"]:
            self.target[:2] = home[:2]
            self.stage = "return"
        if self.stage == "return" and away < 1.0:
            self.stage = "land"
            self.vertical_velocity = float(core.velocity_ned[2])
        if self.stage == "land":
            self._land(dt_s)
        else:
            self._travel(dt_s)

    # --- sticks ------------------------------------------------------------------------------------------------
    def _turn(self, dt_s: float) -> float:
        rate = math.radians(self.state.parameters["MPC_MAN_Y_MAX"]) * self.sticks.yaw
        self.yaw = math.remainder(self.yaw + rate * dt_s, 2.0 * math.pi)
        return rate

    def _climb(self) -> float:
        p = self.state.parameters
        up = 2.0 * self.sticks.throttle - 1.0
        if abs(up) < 0.1:
            return 0.0
        return -up * (p["MPC_Z_VEL_MAX_UP"] if up > 0 else p["MPC_Z_VEL_MAX_DN"])

    def _position_by_sticks(self, dt_s: float) -> None:
        core, p = self.state.core, self.state.parameters
        if self.state.ground.landed and self.sticks.throttle < 0.6:
            self._stay_on_ground()
            return
        self._turn(dt_s)
        s = self.sticks
        forward, right = (0.0 if abs(value) < 0.1 else value for value in (s.pitch, s.roll))
        cos_yaw, sin_yaw = math.cos(self.yaw), math.sin(self.yaw)
        speed = p["MPC_VEL_MANUAL"]
        wanted = np.array(
            [
                speed * (cos_yaw * forward - sin_yaw * right),
                speed * (sin_yaw * forward + cos_yaw * right),
                self._climb(),
            ]
        )
        f = self.follower
        most = p["MPC_ACC_HOR_MAX"] * dt_s
        f.velocity += np.clip(wanted - f.velocity, -most, most)
        f.position += f.velocity * dt_s
        offset = f.position - core.position_ned
        distance = float(np.linalg.norm(offset))
        if distance > p["MPC_XY_ERR_MAX"]:
            f.position = core.position_ned + offset / distance * p["MPC_XY_ERR_MAX"]
        self._send(tuple(f.position), tuple(f.velocity))

    def _stick_tilt(self) -> NDArray[np.float64]:
        most = math.radians(self.state.parameters["MPC_MAN_TILT_MAX"])
        roll, pitch = most * self.sticks.roll, -most * self.sticks.pitch
        cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
        cy, sy = math.cos(self.yaw / 2), math.sin(self.yaw / 2)
        return np.array(
            [
                cy * cp * cr + sy * sp * sr,
                cy * cp * sr - sy * sp * cr,
                cy * sp * cr + sy * cp * sr,
                sy * cp * cr - cy * sp * sr,
            ]
        )

    def _altitude_by_sticks(self, dt_s: float) -> None:
        if self.state.ground.landed and self.sticks.throttle < 0.6:
            self._stay_on_ground()
            return
        self._turn(dt_s)
        most = math.tan(math.radians(self.state.parameters["MPC_MAN_TILT_MAX"])) * 9.81
        forward, right = most * self.sticks.pitch, most * self.sticks.roll
        cos_yaw, sin_yaw = math.cos(self.yaw), math.sin(self.yaw)
        climb = self._climb()
        f = self.follower
        f.position[2] += climb * dt_s
        self.state.core.follow_trajectory(
            (NAN, NAN, float(f.position[2])),
            (NAN, NAN, climb),
            (cos_yaw * forward - sin_yaw * right, sin_yaw * forward + cos_yaw * right, NAN),
            self.yaw,
        )

    def _attitude_by_sticks(self, dt_s: float) -> None:
        p = self.state.parameters
        if self.state.ground.landed and self.sticks.throttle < 0.1:
            self._stay_on_ground()
            return
        rate = self._turn(dt_s)
        s = self.sticks.throttle
        hover = p["MPC_THR_HOVER"]
        # stick in the middle is hover thrust (MPC_THR_CURVE 0)
        least, most = p["MPC_MANTHR_MIN"], p["MPC_THR_MAX"]
        thrust = least + (hover - least) * 2.0 * s if s < 0.5 else hover + (most - hover) * (2.0 * s - 1.0)
        self.state.core.follow_attitude(self._stick_tilt(), thrust, rate)

    def _rates_by_sticks(self) -> None:
        p, s = self.state.parameters, self.sticks
        rates = np.radians(
            np.array([p["MC_ACRO_R_MAX"] * s.roll, -p["MC_ACRO_P_MAX"] * s.pitch, p["MC_ACRO_Y_MAX"] * s.yaw])
        )
        self.state.core.follow_rates(rates, s.throttle)
