"""Synthetic states that drive one watched quantity at a time: for reaction times, the documentation, and tests.

`Scene` is a vehicle in a quiet hover that does exactly as told. `PROVOCATIONS` bring a quantity to a value through the
inputs the supervisor really has, not past them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from companion.autopilot.adapter import VehicleStatus
from companion.config.safety import SafetyLimits
from companion.control.packing import TERMS, Terms
from companion.control.structs import Reference, Vector, VehicleState
from companion.flight.ground_contact import SETTLED_S, GroundContact
from companion.flight.one_world import PoseFigures
from companion.flight.supervisor import Judgement, LawBounds, Sight, Supervisor
from companion.flightlog.health import LogHealth
from companion.mavlink.link import Link, mav

PERIOD_S = 0.01
HEALTHY_FLAGS = 895  # ESTIMATOR_STATUS of PX4 in flight
BOUNDS = LawBounds(
    position_weight_bound=8.0,
    attitude_weight_bound=0.6,
    mass_kg=1.0,
    beta=1.0,
)
THRUST_BOUNDS_NEWTON = (2.0, 42.0)
HEIGHT_M = 2.5  # above what `ground_support` looks at
FRAMES_A_STATE = 10


@dataclass
class _TimeSync:
    round_trip_s: float = 0.002
    autopilot_trip_s: float = 0.01


@dataclass
class _Link:
    counters: Counter[str] = field(default_factory=Counter)
    timesync: _TimeSync = field(default_factory=_TimeSync)


class Scene:
    """See the module. Attributes may be changed between steps."""

    def __init__(self, limits: SafetyLimits, start_s: float = 100.0, real_time: bool = True) -> None:
        self.time_s = start_s
        self.status = VehicleStatus(
            estimator_flags=HEALTHY_FLAGS,
            innovation_ratio=0.1,
            sensors_unhealthy=0.0,
            battery_remaining=0.9,
            battery_voltage_v=12.0,
        )
        self.link = _Link()
        self.supervisor = Supervisor(
            limits, BOUNDS, np.zeros(3), self.status, cast(Link, self.link), real_time
        )
        self.supervisor.log_health = LogHealth(0, 0, 0, 0, 0, 10**12, "")
        self.supervisor.ground_contact = GroundContact(start_s - SETTLED_S)
        self.fence = limits.fence
        self.position: Vector = np.array([0.0, 0.0, HEIGHT_M])
        self.velocity: Vector = np.zeros(3)
        self.offset: Vector = np.zeros(3)  # of the reference's position
        self.velocity_offset: Vector = np.zeros(3)
        self.yaw = self.reference_yaw = 0.0
        self.tilt = self.asked_tilt = 0.0
        self.rate: Vector = np.zeros(3)
        self.thrust_newton = 20.0
        self.thrust_hovers = 1.0
        self.attitude_age_s, self.position_age_s = PERIOD_S, 0.0
        self.jump: Vector = np.zeros(3)
        self.stuck_at_s: float | None = None
        self.drift: Vector = np.zeros(3)  # of the position, which the velocity does not say
        self.poses = PoseFigures(0.0, 0.0, 0.0, (1.0, 1.0), "")
        self.lost_share = 0.0
        self.overrun_share = self.setpoint_gap_s = 0.0
        self.refused = 0
        self.weights = self.network = 0.0
        self.U_error, self.growth_per_s = 0.02, 0.0
        self._lost_carry = 0.0

    def step(self, seconds: float = PERIOD_S) -> Judgement:
        """Go on and let the supervisor look."""
        self.time_s += seconds
        self.U_error *= math.exp(0.5 * self.growth_per_s * seconds)
        self._lost_carry += FRAMES_A_STATE * self.lost_share
        lost = int(self._lost_carry)
        self._lost_carry -= lost
        self.link.counters["received"] += FRAMES_A_STATE - lost
        self.link.counters["lost"] += lost
        stuck = self.stuck_at_s is not None
        if not stuck:
            self.position = self.position + seconds * (self.velocity + self.drift)
        position = self.position
        state = VehicleState(self.time_s, position, self.velocity, _attitude(self.tilt, self.yaw), self.rate)
        still = np.zeros(3)
        reference = Reference(
            self.position + self.offset,
            self.velocity + self.velocity_offset,
            still,
            still,
            still,
            self.reference_yaw,
            0.0,
            0.0,
        )
        sight = Sight(
            reference=reference,
            attitude_age_s=self.attitude_age_s,
            position_age_s=self.position_age_s,
            position_time_s=self.time_s,
            jump_enu=self.jump,
            asked_quaternion=_attitude(self.asked_tilt, self.yaw),
            asked_thrust_newton=self.thrust_newton,
            thrust_bounds_newton=THRUST_BOUNDS_NEWTON,
            terms=self._terms(),
            refused_setpoints=self.refused,
            setpoint_gap_s=self.setpoint_gap_s,
            overrun_share=self.overrun_share,
            thrust_hovers=self.thrust_hovers,
            poses=self.poses,
        )
        self.jump = np.zeros(3)
        return self.supervisor.judge(state, sight)

    def _terms(self) -> Terms:
        packed = np.zeros(1, TERMS)
        terms = packed[0]
        terms["force"][2] = 10.0
        terms["position"]["network_term"][0] = 10.0 * self.network
        terms["position"]["weight_norm"] = BOUNDS.position_weight_bound * self.weights
        terms["position"]["U_error"][0] = self.U_error
        return Terms(packed)


def _attitude(tilt_rad: float, yaw_rad: float) -> Vector:
    """(4,) quaternion: pitched by `tilt_rad` after turning by `yaw_rad`."""
    cy, sy = math.cos(yaw_rad / 2.0), math.sin(yaw_rad / 2.0)
    cp, sp = math.cos(tilt_rad / 2.0), math.sin(tilt_rad / 2.0)
    return np.array([cy * cp, -sy * sp, cy * sp, sy * cp])


Provocation = Callable[[Scene, float], None]


def _set(name: str) -> Provocation:
    def provoke(scene: Scene, value: float) -> None:
        setattr(scene, name, value)

    return provoke


def _status(name: str) -> Provocation:
    def provoke(scene: Scene, value: float) -> None:
        setattr(scene.status, name, value)

    return provoke


def _silence(message_id: int) -> Provocation:
    def provoke(scene: Scene, value: float) -> None:
        scene.status.heard_s[message_id] = scene.time_s - value

    return provoke


def _support(scene: Scene, value: float) -> None:
    scene.thrust_hovers = 1.0 - value
    _height(scene, 1.0)


def _lose_estimator(scene: Scene, value: float) -> None:
    scene.status.estimator_flags = HEALTHY_FLAGS & ~(8 | 16) if value > 0.0 else HEALTHY_FLAGS


def _stick(scene: Scene, value: float) -> None:
    scene.velocity = np.array([1.0, 0.0, 0.0])
    scene.stuck_at_s = scene.time_s


def _jump(scene: Scene, value: float) -> None:
    scene.jump = np.array([value, 0.0, 0.0])


def _turn(scene: Scene, value: float) -> None:
    scene.yaw += math.radians(max(value, 9.0))  # less is not told from a turn


def _disagree(scene: Scene, value: float) -> None:
    """2 m/s east, and positions as quick in another direction: 2 sin(angle / 2) is the difference of both."""
    angle = 2.0 * math.asin(min(value, 2.0) / 2.0)
    scene.velocity = np.array([2.0, 0.0, 0.0])
    scene.drift = 2.0 * np.array([math.cos(angle), math.sin(angle), 0.0]) - scene.velocity


def _poses(name: str) -> Provocation:
    def provoke(scene: Scene, value: float) -> None:
        changed: dict[str, Any] = {name: value}
        scene.poses = replace(scene.poses, **changed)

    return provoke


def _tilt(scene: Scene, value: float) -> None:
    scene.tilt = scene.asked_tilt = math.radians(value)


def _margin(scene: Scene, value: float) -> None:
    low, high = THRUST_BOUNDS_NEWTON
    scene.thrust_newton = high - value * (high - low)


def _east(scene: Scene, value: float) -> None:
    scene.position = np.array([scene.fence.radius_m - value, 0.0, HEIGHT_M])


def _height(scene: Scene, height_m: float) -> None:
    scene.position = np.array([0.0, 0.0, height_m])


def _round_trip(scene: Scene, value: float) -> None:
    scene.link.timesync.round_trip_s = value


def _log(lost: bool) -> Provocation:
    def provoke(scene: Scene, value: float) -> None:
        free = 10**12 if lost else round(value * 1e6)
        scene.supervisor.log_health = LogHealth(0, 0, round(value) if lost else 0, 0, 0, free, "")

    return provoke


def _rise(scene: Scene, value: float) -> None:
    scene.U_error, scene.growth_per_s = (
        0.5,
        (value - 1.0) / (5.0 - 0.5 * value),
    )  # where the ratio settles at `value`


PROVOCATIONS: dict[str, Provocation] = {
    "attitude_age_s": _set("attitude_age_s"),
    "position_age_s": _set("position_age_s"),
    "position_stuck_s": _stick,
    "mode_age_s": _silence(mav.MAVLINK_MSG_ID_HEARTBEAT),
    "estimator_age_s": lambda scene, value: setattr(scene.status, "estimator_told_s", scene.time_s - value),
    "sys_status_age_s": _silence(mav.MAVLINK_MSG_ID_SYS_STATUS),
    "estimator_lost": _lose_estimator,
    "innovation_ratio": _status("innovation_ratio"),
    "sensors_unhealthy": _status("sensors_unhealthy"),
    "position_jump_m": _jump,
    "yaw_jump_deg": _turn,
    "velocity_mismatch": _disagree,
    "pose_tilt_deg": _poses("tilt_deg"),
    "pose_heading_deg": _poses("heading_deg"),
    "pose_motion": _poses("motion"),
    "position_error_m": lambda scene, value: setattr(scene, "offset", np.array([0.0, value, 0.0])),
    "velocity_error_m_s": lambda scene, value: setattr(scene, "velocity_offset", np.array([0.0, 0.0, value])),
    "attitude_error_deg": lambda scene, value: setattr(scene, "asked_tilt", math.radians(value)),
    "yaw_error_deg": lambda scene, value: setattr(scene, "reference_yaw", math.radians(value)),
    "tilt_deg": _tilt,
    "body_rate_deg_s": lambda scene, value: setattr(scene, "rate", np.array([math.radians(value), 0.0, 0.0])),
    "thrust_margin": _margin,
    "fence_margin_m": _east,
    "ceiling_margin_m": lambda scene, value: _height(scene, scene.fence.height_max_m - value),
    "floor_margin_m": lambda scene, value: _height(scene, scene.fence.height_min_m + value),
    "ground_support": _support,
    "battery_remaining": _status("battery_remaining"),
    "battery_voltage_v": _status("battery_voltage_v"),
    "round_trip_s": _round_trip,
    "link_loss": _set("lost_share"),
    "overrun_share": _set("overrun_share"),
    "setpoint_gap_s": _set("setpoint_gap_s"),
    "refused_setpoints": _set("refused"),
    "weight_norm": _set("weights"),
    "network_share": _set("network"),
    "lyapunov_rise": _rise,
    "log_lost": _log(True),
    "disk_free_mb": _log(False),
}
"""How to bring each quantity of `QUANTITIES` to a value; stuck positions and a rising V get there in their time."""

LEAST_STEP = {"estimator_lost": 1.0, "sensors_unhealthy": 1.0, "log_lost": 1.0, "refused_setpoints": 1.0}
"""Quantities that are counts."""


def just_beyond(name: str, at: float, below: bool) -> float:
    """A value a little on the bad side of a threshold."""
    step = LEAST_STEP.get(name, max(0.01, 0.02 * abs(at)))
    return at - step if below else at + step
