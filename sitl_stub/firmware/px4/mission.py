"""AUTO.MISSION: which item is next, where it leads, and when it is done (PX4's `mission.cpp`, `mission_block.cpp`).

From the ground it climbs first. Items that are no places are done at once; DO_CHANGE_SPEED holds for the mission. At
the end it stays in its mode and holds; started again it begins anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl_stub.firmware.common.plans import ABOVE_HOME_FRAMES, PlanItem, PlanResult, PlanRules
from sitl_stub.firmware.px4.state import Px4State

WAYPOINT, LOITER_UNLIMITED, LOITER_TIME, RETURN, LAND, TAKEOFF = 16, 17, 19, 20, 21, 22
DELAY, CHANGE_SPEED = 93, 178
PLACES = (WAYPOINT, LOITER_UNLIMITED, LOITER_TIME, LAND, TAKEOFF)
ALTITUDE_RADIUS_M = 0.8
"""NAV_MC_ALT_RAD."""
TURNS_BEYOND_M = 1.0
"""Farther from its goal the nose points there (MPC_YAW_MODE 0)."""
RULES = PlanRules(
    most={0: 2000, 1: 64, 2: 32},
    commands=frozenset(
        (
            *PLACES, RETURN, DELAY, CHANGE_SPEED,
            112, 177, 183, 187, 189, 195, 196, 197, 201, 203, 205, 206, 211, 530, 531, 532,
            1000, 2000, 2001, 2003, 2500, 2501,
        )
    ),
    busy=PlanResult.ERROR,
    wrong_item=None,
    writes_parts=False,
)  # fmt: skip
"""What of `parse_mavlink_mission_item` a multirotor has a use for."""


@dataclass(frozen=True, slots=True)
class Goal:
    """Where the mission leads now."""

    target_ned: NDArray[np.float64]
    yaw_rad: float
    speed_m_s: float
    lands: bool = False


class Mission:
    """See the module. `on_reached` is called with the number of an item that is done."""

    def __init__(self, state: Px4State) -> None:
        self.state = state
        self.on_reached: Callable[[int], None] = lambda number: None
        self.finished = False
        self.wants_return = False
        """The present item is a return, which is a mode of its own."""
        self._speed_m_s: float | None = None
        self._arrived_us: int | None = None
        self._goal: Goal | None = None

    @property
    def valid(self) -> bool:
        """Whether there is something to fly."""
        return any(item.command in PLACES for item in self.state.plans.mission)

    def changed(self) -> None:
        """Somebody has replaced the mission, or chosen its current item."""
        self.finished = self.wants_return = False
        self._arrived_us = self._goal = None

    def enter(self) -> None:
        """The mode begins: where it was left, or anew where it was at its end."""
        if self.finished:
            self.state.plans.current = 0
        self.changed()
        self._speed_m_s = None

    @property
    def first_height_m(self) -> float:
        """Above home, m: of the first place from the current item on; NaN where there is none."""
        plans = self.state.plans
        for item in plans.mission[plans.current :]:
            if item.command in PLACES and item.command != LAND:
                return float(self.state.home_ned[2]) - self._down_of(item)
        return math.nan

    def step(self) -> Goal | None:
        """Called every 10 ms in the air: what to fly to; None at the end, and while it returns."""
        plans, mission = self.state.plans, self.state.plans.mission
        while not self.finished and not self.wants_return and plans.current < len(mission):
            item = mission[plans.current]
            if item.command == RETURN:
                self.wants_return = True
                return None
            if item.command == CHANGE_SPEED and item.params[1] > 0.0:
                self._speed_m_s = item.params[1]
            if item.command in PLACES:
                self._goal = goal = self._goal_of(item)
                if not self._is_done(item, goal):
                    return goal
            elif item.command == DELAY and not self._waited(item.params[0]):
                return self._goal
            self._next()
        return None

    def _next(self) -> None:
        plans = self.state.plans
        self._arrived_us = None
        done = plans.current
        if done + 1 < len(plans.mission):
            plans.current = done + 1
        else:
            self.finished = True
        self.on_reached(done)

    def _down_of(self, item: PlanItem) -> float:
        state = self.state
        if not math.isfinite(item.z):
            return float(state.core.position_ned[2])
        if item.frame in ABOVE_HOME_FRAMES:
            return float(state.home_ned[2]) - item.z
        return state.origin.altitude_of(item.z)

    def _goal_of(self, item: PlanItem) -> Goal:
        state = self.state
        here = state.core.position_ned
        target = np.array([here[0], here[1], self._down_of(item)])
        if self._goal is not None and not item.is_place:
            target[:2] = self._goal.target_ned[:2]
        if item.is_place:
            target[:2] = state.origin.local(*item.place_deg)
        if item.command == LAND:
            target[2] = float(state.home_ned[2])
        away = target[:2] - here[:2]
        yaw = state.core.yaw if self._goal is None else self._goal.yaw_rad
        if math.isfinite(item.params[3]) and item.command != LOITER_TIME:
            yaw = math.radians(item.params[3])
        elif float(np.linalg.norm(away)) > TURNS_BEYOND_M:
            yaw = math.atan2(float(away[1]), float(away[0]))
        speed = self.state.parameters["MPC_XY_CRUISE"] if self._speed_m_s is None else self._speed_m_s
        near = float(np.linalg.norm(away)) < TURNS_BEYOND_M
        return Goal(target, yaw, speed, lands=item.command == LAND and near)

    def _is_done(self, item: PlanItem, goal: Goal) -> bool:
        if item.command == LAND:
            return goal.lands and self.state.ground.landed
        off = goal.target_ned - self.state.core.position_ned
        radius = item.params[1] if item.command == WAYPOINT and item.params[1] > 0.0 else 0.0
        radius = radius or self.state.parameters["NAV_ACC_RAD"]
        if self._arrived_us is None and (
            float(np.linalg.norm(off[:2])) > radius or abs(float(off[2])) > ALTITUDE_RADIUS_M
        ):
            return False
        if item.command == LOITER_UNLIMITED:
            self._waited(math.inf)
            return False
        return self._waited(item.params[0] if item.command in (WAYPOINT, LOITER_TIME) else 0.0)

    def _waited(self, wait_s: float) -> bool:
        now_us = self.state.clock.time_us
        if self._arrived_us is None:
            self._arrived_us = now_us
        return bool(now_us - self._arrived_us >= 1e6 * max(wait_s, 0.0))
