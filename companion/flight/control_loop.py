"""The control loop: one state in, one setpoint out, everything logged. Driven by the arrival of states.

What it does with a state depends on its `activity`: send idle setpoints, raise the thrust until the vehicle lifts off,
or let the control law follow the plan.
"""

from __future__ import annotations

import enum
import math
import time
from collections import Counter

import numpy as np

from companion.autopilot.adapter import TYPE_MASK_ATTITUDE, attitude_target
from companion.autopilot.thrust import ThrustScale
from companion.config.settings import FlightSettings
from companion.control.law import ControlLaw, StepRefused, pack_input
from companion.control.packing import Memory
from companion.control.prediction import Predictor
from companion.control.structs import AdaptationGate, ControlLevel, Reference, Setpoint, Vector, VehicleState
from companion.flight.outcome import Aborted
from companion.flight.plan import FlightPlan, tracking_time
from companion.flight.recorder import Recorder
from companion.flight.supervisor import Reaction, Supervisor
from companion.flight.vehicle import Vehicle

LONGEST_STEP = 5.0  # control periods; after a longer gap the law steps this far only


class Activity(enum.Enum):
    """What is done with a state."""

    NOTHING = "nothing"
    """No setpoints go out."""
    IDLE = "idle"
    """Level attitude, no thrust: proves to the autopilot that we are there."""
    LIFT_OFF = "lift-off"
    """Level attitude, thrust rising."""
    FOLLOW = "follow"
    """The control law follows the plan."""


class ControlLoop:
    """See the module. `plan_time_s` is the time since the plan began, by the newest state."""

    def __init__(
        self,
        vehicle: Vehicle,
        law: ControlLaw,
        predictor: Predictor,
        thrust: ThrustScale,
        settings: FlightSettings,
        recorder: Recorder,
    ) -> None:
        self._vehicle = vehicle
        self._law = law
        self._predictor = predictor
        self._thrust = thrust
        self._settings = settings
        self._recorder = recorder
        self._memory: Memory = law.initial_memory()
        self._plan: FlightPlan | None = None
        self._supervisor: Supervisor | None = None
        self._plan_started_s = 0.0
        self._last_step_s = -math.inf
        self._last_wall_ns = 0
        self._level_quaternion: Vector = np.array([1.0, 0.0, 0.0, 0.0])
        self._lift_off_started_s = 0.0
        self._flags = 0
        self.period_s = 1.0 / settings.rate_hz
        self.activity = Activity.NOTHING
        self.lift_off_thrust = 0.0  # normalised, as last sent while lifting off
        self.position_error_enu: Vector = np.zeros(3)
        self.counters: Counter[str] = Counter()

    @property
    def hover_thrust(self) -> float:
        """Normalised thrust that is taken to carry the weight."""
        return self._thrust.hover_thrust

    @property
    def state_delay_s(self) -> float:
        """By how much states are predicted ahead."""
        return self._predictor.delay_s

    @property
    def plan_time_s(self) -> float:
        """Seconds since the plan began, by the newest state."""
        state = self._vehicle.state
        return state.time_s - self._plan_started_s if state is not None else 0.0

    # Changing over --------------------------------------------------------------------------------------

    def idle(self, quaternion_wxyz: Vector) -> None:
        """Send idle setpoints that keep the heading of `quaternion_wxyz` (4,) level."""
        self._level_quaternion = quaternion_wxyz
        self.activity = Activity.IDLE

    def lift_off(self, now_s: float, spool_time_s: float) -> None:
        """Begin to raise the thrust; it starts to rise once the motors can turn (`spool_time_s` after arming)."""
        self._lift_off_started_s = now_s + spool_time_s
        self.activity = Activity.LIFT_OFF

    def follow(self, plan: FlightPlan, supervisor: Supervisor, state: VehicleState) -> None:
        """Hand over to the control law, without a bump, at `state`."""
        self._plan, self._supervisor, self._plan_started_s = plan, supervisor, state.time_s
        self._memory = self._law.take_over(
            self._memory,
            state,
            plan.sample(0.0),
            self._thrust.newton(self.lift_off_thrust),
            self._level_quaternion,
        )
        self._last_step_s = state.time_s - self.period_s
        self.activity = Activity.FOLLOW

    def stop(self) -> None:
        """Send nothing any more."""
        self.activity = Activity.NOTHING

    # One state ------------------------------------------------------------------------------------------

    def on_state(self, state: VehicleState) -> None:
        """Answer one state.

        Raises:
            Aborted: when the supervisor ends the flight, or the law cannot answer.
        """
        started_ns = time.perf_counter_ns()
        age_s = max(0.0, state.time_s - self._vehicle.assembler.position_time_s)
        self._recorder.state(state, age_s)
        if self.activity is Activity.NOTHING or state.time_s - self._last_step_s < 0.5 * self.period_s:
            return
        law_s = 0.0
        if self.activity is Activity.FOLLOW:
            law_s = self._follow(state, age_s)
        elif self.activity is Activity.LIFT_OFF:
            self._send_level(state, self._lift_off_thrust(state.time_s))
        else:
            self._send_level(state, 0.0)
        self._last_step_s = state.time_s
        ended_ns = time.perf_counter_ns()
        period_s = (started_ns - self._last_wall_ns) * 1e-9 if self._last_wall_ns else math.nan
        self._last_wall_ns = started_ns
        compute_s = (ended_ns - started_ns) * 1e-9
        if compute_s > self.period_s:
            self.counters["overruns"] += 1
        self._recorder.timing(state.time_s, period_s, compute_s, law_s)

    def _follow(self, state: VehicleState, age_s: float) -> float:
        assert self._plan is not None and self._supervisor is not None
        now_s = state.time_s - self._plan_started_s
        reference = self._plan.sample(now_s)
        self.position_error_enu = reference.position_enu - state.position_enu
        judgement = self._supervisor.judge(state, reference, age_s)
        if judgement.reaction is Reaction.LAND:
            raise Aborted(judgement.reason)
        gate = AdaptationGate.FREEZE if judgement.reaction is Reaction.FREEZE else AdaptationGate.RUN
        dt_s = min(state.time_s - self._last_step_s, LONGEST_STEP * self.period_s)
        law_ns = time.perf_counter_ns()
        ahead = self._predictor.predict(state)
        inputs = pack_input(ahead, self._plan.sample(now_s + ahead.time_s - state.time_s), dt_s, gate)
        try:
            result = self._law.step_packed(self._memory, inputs)
        except StepRefused as error:
            raise Aborted(f"the control law has no answer: {error}") from error
        law_s = (time.perf_counter_ns() - law_ns) * 1e-9
        memory, self._memory = self._memory, result.memory
        self._send(state.time_s, result.setpoint, result.terms.values["rotor_thrust"])
        self._recorder.reference(state.time_s, reference, tracking_time(self._plan, now_s))
        self._recorder.step(state.time_s, memory, inputs, result)
        self._note_bounds(result.terms.flags)
        return law_s

    def _send(self, time_s: float, setpoint: Setpoint, rotor_thrust: Vector) -> None:
        adapter, link = self._vehicle.adapter, self._vehicle.link
        thrust = self._thrust.normalised(setpoint.thrust_newton)
        target = link.target_system or 1
        if setpoint.level is ControlLevel.ACTUATOR:
            message = adapter.encode_actuators(time_s, self._thrust.controls(rotor_thrust), target)
        else:
            message = adapter.encode(setpoint, time_s, thrust, target)
        if not link.send(message):
            self.counters["setpoints not sent"] += 1
        self._predictor.sent(time_s, setpoint)
        self._recorder.setpoint(time_s, setpoint, thrust)

    def _send_level(self, state: VehicleState, thrust: float) -> None:
        setpoint = Setpoint(
            ControlLevel.ATTITUDE,
            self._thrust.newton(thrust),
            self._level_quaternion,
            np.zeros(3),
            np.zeros(3),
        )
        link = self._vehicle.link
        link.send(
            attitude_target(
                link.target_system or 1,
                state.time_s,
                TYPE_MASK_ATTITUDE,
                self._level_quaternion,
                setpoint.body_rate_flu,
                thrust,
            )
        )
        self._predictor.sent(state.time_s, setpoint)
        self._recorder.setpoint(state.time_s, setpoint, thrust)

    def _lift_off_thrust(self, time_s: float) -> float:
        settings = self._settings.procedure
        rising_s = max(0.0, time_s - self._lift_off_started_s)
        hovers = settings.lift_off_start + settings.lift_off_rate * rising_s
        self.lift_off_thrust = hovers * self._thrust.hover_thrust
        if self.lift_off_thrust > settings.lift_off_limit:
            raise Aborted(
                f"no lift-off at thrust {settings.lift_off_limit:.2f} "
                f"({hovers:.1f} times hover thrust): is the hover thrust right, do all rotors turn?"
            )
        return self.lift_off_thrust

    def _note_bounds(self, flags: int) -> None:
        if flags != self._flags:
            self._recorder.log.event("bounds", self._vehicle.link.autopilot_time_s, flags=flags)
            self._flags = flags


def level_with_heading(yaw_rad: float) -> Vector:
    """(4,) quaternion of level flight at `yaw_rad`."""
    return np.array([math.cos(yaw_rad / 2.0), 0.0, 0.0, math.sin(yaw_rad / 2.0)])


def at_rest(position_enu: Vector, yaw_rad: float) -> Reference:
    """The reference that stands still."""
    zero = np.zeros(3)
    return Reference(position_enu, zero, zero, zero, zero, yaw_rad, 0.0, 0.0)


def yaw_of(quaternion_wxyz: Vector) -> float:
    """ZYX yaw of an attitude, rad."""
    w, x, y, z = (float(q) for q in quaternion_wxyz)
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
