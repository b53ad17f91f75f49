"""The supervisor: measures everything the limits of `companion.config.safety` watch, and says what may be done.

Apart from the control law: it sees the state before the law does, judges the law's last answer like anything else, and
owns what is sent. It decides by the autopilot's clock only, so that the same flight gets the same decisions; our clock
counts where `real_time` says that both run alike.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.autopilot.adapter import VehicleStatus
from companion.config.safety import QUANTITIES, Reaction, SafetyLimits
from companion.control.law import ControlLaw
from companion.control.packing import LOOP_TERMS, TERMS, Terms
from companion.control.structs import AdaptationGate, Reference, Vector, VehicleState
from companion.flight.fence import horizontal_margin
from companion.flight.ground_contact import GroundContact
from companion.flight.ladder import START, Change, LadderState, hardest_by_quantity, rung_table, step
from companion.flight.one_world import SELF_MOVED_M, PoseFigures, TwoPaths
from companion.flight.sources import SILENT_S
from companion.flightlog.health import LogHealth
from companion.mavlink.link import Link, mav
from companion.mavlink.state import JUMP_M

SLOW_PERIOD_S = 0.1  # what changes slowly is measured this often
LOG_PERIOD_S = 1.0
LOSS_WINDOW_S = 2.0
YAW_JUMP_RAD = math.radians(8.0)  # more than the body rate explains, between two states
LONGEST_JUMP_GAP_S = 0.1  # over a longer gap the body rate explains nothing
LYAPUNOV_SHORT_S, LYAPUNOV_LONG_S, LYAPUNOV_FLOOR_J = 0.5, 5.0, 0.1
LONGEST_POSITION_GAP_S = 0.3  # over a longer one the velocity says nothing of the position
FLOOR_COUNTS_FROM_M = 0.2  # above the fence's least height
MOVING_M_S = 0.2  # a position that moves this fast has to change
_TELL_THE_MODE = (mav.MAVLINK_MSG_ID_HEARTBEAT, mav.MAVLINK_MSG_ID_CURRENT_MODE)
_TELL_THE_FLAGS = (mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS, mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT)
LIFT_OFF_SKIPS = (
    "ground_support",
    "position_error_m",
    "velocity_error_m_s",
    "yaw_error_deg",
    "thrust_margin",
)

INDEX = {name: number for number, name in enumerate(QUANTITIES)}
_POSITION = TERMS.fields["position"][1] // 8  # type: ignore[index]
_ATTITUDE = TERMS.fields["attitude"][1] // 8  # type: ignore[index]
_FORCE = TERMS.fields["force"][1] // 8  # type: ignore[index]


def _loop_field(name: str) -> int:
    return LOOP_TERMS.fields[name][1] // 8  # type: ignore[index]


_LOOKED_AT = np.array(
    [
        _POSITION + _loop_field("weight_norm"),
        _ATTITUDE + _loop_field("weight_norm"),
        *(
            _POSITION + _loop_field(name) + axis
            for name in ("network_term", "error", "U_error")
            for axis in range(3)
        ),
        *(_FORCE + axis for axis in range(3)),
    ]
)
"""Of the law's terms: both norms, then the position loop's network, error and Ũ, and the force."""


@dataclass(frozen=True, slots=True)
class LawBounds:
    """What of the law's bounds the supervisor measures against."""

    position_weight_bound: float  # N
    attitude_weight_bound: float  # N·m
    mass_kg: float  # m̂
    beta: float  # of Eq. (20)


def law_bounds(law: ControlLaw) -> LawBounds:
    """The bounds of a law that has been built."""
    p = law.parameters
    return LawBounds(
        position_weight_bound=float(p.position.weight_bound),
        attitude_weight_bound=float(p.attitude.weight_bound),
        mass_kg=float(p.mass_estimate),
        beta=float(p.beta[0]),
    )


class Sight(NamedTuple):
    """What is seen at one state, beside the state."""

    reference: Reference
    attitude_age_s: float
    position_age_s: float
    position_time_s: float
    jump_enu: Vector  # (3,) m
    asked_quaternion: Vector  # (4,) of the newest setpoint
    asked_thrust_newton: float
    thrust_bounds_newton: tuple[float, float]  # least and greatest that can be sent
    terms: Terms | None  # of the law's last step, None before the first
    refused_setpoints: int  # in a row
    setpoint_gap_s: float
    overrun_share: float
    thrust_hovers: float  # of the newest setpoint, in hover thrusts
    poses: PoseFigures | None = None  # from outside, where the estimator uses them


class Judgement(NamedTuple):
    """What is to be done with this state."""

    reaction: Reaction
    gate: AdaptationGate
    reason: str  # of the reaction, in numbers
    changes: tuple[Change, ...]  # what began or ended with this state
    yaw_jump_rad: float  # heading reset seen at this state


class Supervisor:
    """Watches one flight. `home_enu` is the place of take-off."""

    def __init__(
        self,
        limits: SafetyLimits,
        bounds: LawBounds,
        home_enu: Vector,
        status: VehicleStatus,
        link: Link,
        real_time: bool,
    ) -> None:
        self._limits = limits
        self._bounds = bounds
        self._home = home_enu.tolist()
        self._status = status
        self._link = link
        self._real_time = real_time
        self._table = rung_table(limits)
        self._state: LadderState = START
        self._reason = ""
        self._values: list[float | None] = [None] * len(INDEX)
        self._slow_due_s = self._log_due_s = -math.inf
        self._received: deque[tuple[float, int, int]] = deque()
        self._before: tuple[float, float] | None = None  # time, yaw
        self._stuck: tuple[tuple[float, float, float], float] = ((0.0, 0.0, 0.0), -math.inf)
        self._stuck_since_s: float | None = None
        self._paths = TwoPaths(SELF_MOVED_M)  # of the positions, and of the velocities' integral
        self._integral: tuple[float, list[float], list[float], list[float]] | None = (
            None  # time, position, velocity, its integral
        )
        self._floor_counts = False
        self.ground_contact = GroundContact()
        self._lyapunov: tuple[float, float, float] | None = None  # time, short, long
        self.log_health: LogHealth | None = None

    @property
    def reaction(self) -> Reaction:
        """Where the machine stands."""
        return self._state.reaction

    @property
    def reason(self) -> str:
        """Why it stands there."""
        return self._reason

    def law_changed(self, bounds: LawBounds) -> None:
        """Another law flies from here on, within its own bounds."""
        self._bounds, self._lyapunov = bounds, None

    def judge(self, state: VehicleState, sight: Sight, lifting_off: bool = False) -> Judgement:
        """Look at one state before it reaches the law.

        Args:
            state: as assembled from the autopilot's messages.
            sight: all that goes with it.
            lifting_off: the law does not fly yet, so there is no reference to compare with.
        """
        values, time_s = self._values, state.time_s
        self._measure_ages(state, sight)
        yaw_jump_rad = self._measure_jumps(state, sight)
        self._measure_frames(state, sight)
        self._measure_motion(state, sight)
        self._measure_law(time_s, sight)
        if time_s >= self._slow_due_s:
            self._slow_due_s = time_s + SLOW_PERIOD_S
            self._measure_slow(time_s)
        if lifting_off:
            for name in LIFT_OFF_SKIPS:
                values[INDEX[name]] = None
        return self._decide(time_s, yaw_jump_rad)

    def judge_absence(self, time_s: float, attitude_age_s: float, position_age_s: float) -> Judgement:
        """Look at the autopilot's time going on without a state."""
        values: list[float | None] = [None] * len(INDEX)
        values[INDEX["attitude_age_s"]] = attitude_age_s
        values[INDEX["position_age_s"]] = position_age_s
        before, self._values = self._values, values
        judgement = self._decide(time_s, 0.0)
        self._values = before
        return judgement

    def move_home(self, jump_enu: Vector) -> None:
        """The estimator's frame was moved by `jump_enu` (3,): the fence stays where it is on the ground."""
        self._home = [a + b for a, b in zip(self._home, jump_enu.tolist(), strict=True)]

    # Deciding ------------------------------------------------------------------------------------------

    def _decide(self, time_s: float, yaw_jump_rad: float) -> Judgement:
        before = self._state
        self._state, changes = step(self._table, before, self._values, time_s)
        reaction = self._state.reaction
        if reaction is not before.reaction:
            self._reason = self._why(before.reaction, reaction, time_s - before.entered_s)
        return Judgement(reaction, self._gate(reaction), self._reason, changes, yaw_jump_rad)

    def _why(self, before: Reaction, reaction: Reaction, lasted_s: float) -> str:
        for item in self._state.exceeded:
            rung = self._table.rungs[item.rung]
            value = self._values[rung.quantity]
            if item.acting and rung.reaction is reaction and value is not None:
                return rung.sentence(value)
        if before is Reaction.HOLD:
            return f"{self._reason}; held for {lasted_s:.1f} s"
        return ""

    def _gate(self, reaction: Reaction) -> AdaptationGate:
        if reaction < Reaction.FREEZE:
            return AdaptationGate.RUN
        if Reaction.FREEZE in hardest_by_quantity(self._table, self._state).values():
            return AdaptationGate.FREEZE
        return AdaptationGate.FREEZE_WEIGHTS

    # Measuring -----------------------------------------------------------------------------------------

    def _measure_ages(self, state: VehicleState, sight: Sight) -> None:
        values = self._values
        values[INDEX["attitude_age_s"]] = sight.attitude_age_s
        values[INDEX["position_age_s"]] = sight.position_age_s
        time_s = sight.position_time_s
        if (
            time_s != self._stuck[1]
        ):  # a new position message: the state is it, carried forward by the velocity
            ahead_s = state.time_s - time_s
            velocity = state.velocity_enu.tolist()
            place = tuple(
                round(p - ahead_s * v, 9) for p, v in zip(state.position_enu.tolist(), velocity, strict=True)
            )
            moving = math.hypot(*velocity) > MOVING_M_S
            if place != self._stuck[0] or not moving:
                self._stuck_since_s = None
            elif self._stuck_since_s is None:
                self._stuck_since_s = self._stuck[1]
            self._stuck = (place, time_s)
        since_s = self._stuck_since_s
        values[INDEX["position_stuck_s"]] = 0.0 if since_s is None else time_s - since_s

    def _measure_jumps(self, state: VehicleState, sight: Sight) -> float:
        w, x, y, z = state.quaternion_wxyz.tolist()
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        jump_rad = 0.0
        if self._before is not None:
            dt_s = state.time_s - self._before[0]
            if 0.0 < dt_s < LONGEST_JUMP_GAP_S:
                turned = math.remainder(yaw - self._before[1], math.tau)
                unexplained = abs(turned) - dt_s * math.hypot(*state.body_rate_flu.tolist())
                if unexplained > YAW_JUMP_RAD:
                    jump_rad = turned
        self._before = (state.time_s, yaw)
        values = self._values
        values[INDEX["yaw_jump_deg"]] = abs(math.degrees(jump_rad))
        values[INDEX["position_jump_m"]] = math.hypot(*sight.jump_enu.tolist())
        values[INDEX["yaw_error_deg"]] = abs(
            math.degrees(math.remainder(sight.reference.yaw_rad - yaw + jump_rad, math.tau))
        )
        return jump_rad

    def _measure_frames(self, state: VehicleState, sight: Sight) -> None:
        """Whether positions and velocities, and poses from outside and the estimate, are of one world."""
        values, poses = self._values, sight.poses
        values[INDEX["pose_tilt_deg"]] = None if poses is None else poses.tilt_deg
        values[INDEX["pose_heading_deg"]] = None if poses is None else abs(poses.heading_deg)
        values[INDEX["pose_motion"]] = None if poses is None else poses.motion
        time_s, before = sight.position_time_s, self._integral
        if before is not None and 0.0 <= before[0] - time_s < LONGEST_POSITION_GAP_S:
            return  # this one has been looked at
        ahead_s, velocity = state.time_s - time_s, state.velocity_enu.tolist()
        position = [p - ahead_s * v for p, v in zip(state.position_enu.tolist(), velocity, strict=True)]
        integral = position
        if before is not None:
            half_s = 0.5 * (time_s - before[0])
            step = [half_s * (v + w) for v, w in zip(velocity, before[2], strict=True)]
            integral = [i + s for i, s in zip(before[3], step, strict=True)]
            expected = [p + s for p, s in zip(before[1], step, strict=True)]
            if not 0.0 < half_s < LONGEST_POSITION_GAP_S or math.dist(position, expected) > JUMP_M:
                self._paths.clear()  # a reset of the estimate is no movement
        self._integral = time_s, position, velocity, integral
        self._paths.add(time_s, position, integral)
        values[INDEX["velocity_mismatch"]] = self._paths.difference

    def _measure_motion(self, state: VehicleState, sight: Sight) -> None:
        values, reference = self._values, sight.reference
        x_m, y_m, z_m = state.position_enu.tolist()
        rx, ry, rz = reference.position_enu.tolist()
        vx, vy, vz = state.velocity_enu.tolist()
        rvx, rvy, rvz = reference.velocity_enu.tolist()
        values[INDEX["position_error_m"]] = math.hypot(rx - x_m, ry - y_m, rz - z_m)
        values[INDEX["velocity_error_m_s"]] = math.hypot(rvx - vx, rvy - vy, rvz - vz)
        axis = _thrust_axis(state.quaternion_wxyz)
        asked = _thrust_axis(sight.asked_quaternion)
        cosine = axis[0] * asked[0] + axis[1] * asked[1] + axis[2] * asked[2]
        values[INDEX["attitude_error_deg"]] = _angle_deg(cosine)
        values[INDEX["tilt_deg"]] = _angle_deg(axis[2])
        values[INDEX["body_rate_deg_s"]] = math.degrees(math.hypot(*state.body_rate_flu.tolist()))
        home, fence = self._home, self._limits.fence
        height_m = z_m - home[2]
        values[INDEX["fence_margin_m"]] = horizontal_margin(fence, x_m - home[0], y_m - home[1])
        values[INDEX["ceiling_margin_m"]] = fence.height_max_m - height_m
        values[INDEX["ground_support"]] = self.ground_contact.support(
            state.time_s,
            height_m,
            vz,
            sight.thrust_hovers,
            axis,
            _angle_deg(cosine),
            self._status,
        )
        if not self._floor_counts and height_m > fence.height_min_m + FLOOR_COUNTS_FROM_M:
            self._floor_counts = True
        values[INDEX["floor_margin_m"]] = height_m - fence.height_min_m if self._floor_counts else None

    def _measure_law(self, time_s: float, sight: Sight) -> None:
        values, bounds = self._values, self._bounds
        values[INDEX["refused_setpoints"]] = float(sight.refused_setpoints)
        values[INDEX["setpoint_gap_s"]] = sight.setpoint_gap_s
        values[INDEX["overrun_share"]] = sight.overrun_share if self._real_time else None
        (low, high), thrust = sight.thrust_bounds_newton, sight.asked_thrust_newton
        values[INDEX["thrust_margin"]] = min(thrust - low, high - thrust) / (high - low)
        if sight.terms is None:
            return
        t = np.frombuffer(sight.terms.packed)[_LOOKED_AT].tolist()
        values[INDEX["weight_norm"]] = max(
            t[0] / bounds.position_weight_bound, t[1] / bounds.attitude_weight_bound
        )
        network, error, gap, force = (math.hypot(*t[first : first + 3]) for first in (2, 5, 8, 11))
        values[INDEX["network_share"]] = network / force if force > 0.0 else math.nan
        V = 0.5 * (bounds.beta * error * error + bounds.mass_kg * gap * gap)
        before_s, short, long = self._lyapunov or (time_s, V, V)
        dt_s = max(0.0, time_s - before_s)
        short -= math.expm1(-dt_s / LYAPUNOV_SHORT_S) * (V - short)
        long -= math.expm1(-dt_s / LYAPUNOV_LONG_S) * (V - long)
        self._lyapunov = (time_s, short, long)
        values[INDEX["lyapunov_rise"]] = (short + LYAPUNOV_FLOOR_J) / (long + LYAPUNOV_FLOOR_J)

    def _measure_slow(self, time_s: float) -> None:
        values, status = self._values, self._status
        heard_s = status.heard_s
        told_s = max((heard_s[kind] for kind in _TELL_THE_MODE if kind in heard_s), default=None)
        values[INDEX["mode_age_s"]] = _age_s(time_s, told_s)
        values[INDEX["estimator_age_s"]] = _age_s(time_s, status.estimator_told_s)
        values[INDEX["sys_status_age_s"]] = _age_s(time_s, heard_s.get(mav.MAVLINK_MSG_ID_SYS_STATUS))
        flags_s = max((heard_s[kind] for kind in _TELL_THE_FLAGS if kind in heard_s), default=time_s)
        flags = status.estimator_flags if time_s - flags_s < SILENT_S else None
        values[INDEX["estimator_lost"]] = None if flags is None else float(lost_parts(flags))
        values[INDEX["innovation_ratio"]] = None if flags is None else status.innovation_ratio
        values[INDEX["sensors_unhealthy"]] = status.sensors_unhealthy
        values[INDEX["battery_remaining"]] = status.battery_remaining
        values[INDEX["battery_voltage_v"]] = status.battery_voltage_v
        timesync = self._link.timesync
        trip_s = timesync.round_trip_s if self._real_time else timesync.autopilot_trip_s
        values[INDEX["round_trip_s"]] = None if math.isnan(trip_s) else trip_s
        counters, seen = self._link.counters, self._received
        seen.append((time_s, counters["received"], counters["lost"]))
        while seen[0][0] < time_s - LOSS_WINDOW_S:
            seen.popleft()
        received, lost = seen[-1][1] - seen[0][1], seen[-1][2] - seen[0][2]
        values[INDEX["link_loss"]] = lost / (received + lost) if received + lost > 0 else None
        health = self.log_health
        if health is not None:
            values[INDEX["log_lost"]] = float(health.dropped + health.rejected + health.lost)
            values[INDEX["disk_free_mb"]] = None if health.free_bytes < 0 else health.free_bytes * 1e-6


def _age_s(time_s: float, told_s: float | None) -> float | None:
    return None if told_s is None else max(0.0, time_s - told_s)


def lost_parts(flags: int) -> int:
    """How many of attitude, velocities and position the estimator has not (ESTIMATOR_STATUS_FLAGS).

    CONST_POS_MODE says nothing: PX4 sets it whenever the vehicle stands on the ground.
    """
    needed = (mav.ESTIMATOR_ATTITUDE, mav.ESTIMATOR_VELOCITY_HORIZ, mav.ESTIMATOR_VELOCITY_VERT)
    lost = sum(not flags & bit for bit in needed)
    position = flags & (mav.ESTIMATOR_POS_HORIZ_REL | mav.ESTIMATOR_POS_HORIZ_ABS)
    return lost + (not position)


def tilt_of(quaternion_wxyz: Vector) -> float:
    """Angle between body z and world z in rad: cos tilt = 1 − 2(x² + y²)."""
    return math.radians(_angle_deg(_thrust_axis(quaternion_wxyz)[2]))


def _thrust_axis(quaternion_wxyz: Vector) -> tuple[float, float, float]:
    w, x, y, z = quaternion_wxyz.tolist()
    return 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)


def _angle_deg(cosine: float) -> float:
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
