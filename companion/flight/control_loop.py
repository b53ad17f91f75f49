"""The control loop: one state in, one setpoint out, everything logged. Driven by the arrival of states.

What it does with a state depends on its `activity`: send idle setpoints, raise the thrust until the vehicle lifts off,
let the control law follow the plan, or keep the vehicle level until somebody else has it. The supervisor sees every state
before the law does, and nothing goes out but through the gate.
"""

from __future__ import annotations

import enum
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from companion.autopilot.attitude_response import AttitudeResponseMeter, MeasuredResponse
from companion.autopilot.drag import DragMeter
from companion.autopilot.hover_thrust import HoverThrustEstimator
from companion.autopilot.thrust import ThrustScale
from companion.config.profile import VehicleProfile
from companion.config.safety import Reaction
from companion.config.settings import FlightSettings
from companion.control.bounds import POSITION_SATURATES
from companion.control.law import ControlLaw, StepRefused, pack_input
from companion.control.laws import AUTOPILOT
from companion.control.packing import Memory, Terms
from companion.control.prediction import Predictor
from companion.control.structs import AdaptationGate, ControlLevel, Reference, Vector, VehicleState
from companion.flight.fallback import without_networks
from companion.flight.level_flight import level_setpoint
from companion.flight.outcome import Aborted, TippedOver, ending
from companion.flight.plan import FlightPlan, stopping_plan, tracking_time
from companion.flight.realtime import LoopWatchdog
from companion.flight.recorder import Recorder
from companion.flight.setpoint_gate import SetpointGate
from companion.flight.setpoint_sender import SetpointSender
from companion.flight.supervisor import Judgement, Sight, Supervisor, law_bounds, tilt_of
from companion.flight.vehicle import Vehicle
from companion.mavlink.link import mav
from companion.mavlink.stream_timing import StreamFigures
from companion.mavlink.timesync import TimeSync
from companion.reference.transit import TransitLimits

LONGEST_STEP = 5.0  # control periods; after a longer gap the law steps this far only
ABSENT_AFTER = 5.0  # control periods without a state from which on the supervisor is asked without one
SUNK_M = 1.0  # at lift-off; the rotors' wind takes a barometer down by less
RESTART_S = 1.0  # a clock that steps back further was started anew
OVERRUN_WINDOW_S = 1.0
CLIMB_BRAKE = 0.2  # hover thrusts less for each m/s upwards, while the vehicle is kept level
LEAST_LEVEL = 0.7  # hover thrusts, however fast it climbs
_NO_JUMP: Vector = np.zeros(3)
LINK_INCLUDED_S = 0.01
"""Of the way from an attitude's stamp to its setpoint's arrival: in the profile's dead times."""
LONGEST_LINK_S = 0.1
"""Beyond that nothing is predicted: the setpoints remembered end, and `round_trip_s` ends the flight."""
LINK_SHARE = 0.3  # of what is newly measured, each second: a jitter of the clocks is not flown after
ATTITUDE_STREAM: int = mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION


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
    LEVEL = "level"
    """Level attitude, no more thrust than carries the weight: until somebody else has the vehicle."""


@dataclass(frozen=True, slots=True)
class Watching:
    """Who watches a flight from lift-off on, and what is allowed for coming to rest."""

    supervisor: Supervisor
    watchdog: LoopWatchdog
    transit_limits: TransitLimits
    real_time: bool  # the autopilot's clock runs like ours, so ours may be used for decisions
    announce: Callable[[str], None]  # a line for the pilot


class ControlLoop:
    """See the module. `plan_time_s` is the time since the plan began, by the newest state."""

    def __init__(
        self,
        vehicle: Vehicle,
        law: ControlLaw,
        predictor: Predictor,
        thrust: ThrustScale,
        hover: HoverThrustEstimator,
        settings: FlightSettings,
        recorder: Recorder,
        gate: SetpointGate,
        laws: Mapping[str, ControlLaw] | None = None,
    ) -> None:
        """`law` flies first; `laws` are those that `fly_by` knows, by name (None: it alone)."""
        self._vehicle = vehicle
        self._law = law
        self.laws: Mapping[str, ControlLaw] = laws or {law.name: law}
        self._predictor = predictor
        self._hover = hover
        self._sender = SetpointSender(vehicle, thrust, gate, hover, predictor, recorder)
        self._settings = settings
        self._recorder = recorder
        self._drag: DragMeter | None = None
        self._memory: Memory = law.initial_memory()
        self._plan: FlightPlan | None = None
        self._watching: Watching | None = None
        self._reaction = Reaction.NONE
        self._terms: Terms | None = None
        self._shift_enu: Vector | None = None  # of the plan, by estimator resets; None until there is one
        self._shift_yaw_rad = 0.0
        self._jump_enu: Vector | None = None  # not yet shown to the supervisor
        self._overrun_share = 0.0
        self._last_state_s = -math.inf
        self._plan_started_s = 0.0
        self._last_step_s = -math.inf
        self._last_wall_ns = 0
        self._level_quaternion: Vector = np.array([1.0, 0.0, 0.0, 0.0])
        self._lift_off_started_s = 0.0
        self._lift_off_from_m = math.nan
        self._flags = 0
        self._velocity_time_s = -math.inf
        self.period_s = 1.0 / settings.rate_hz
        self.activity = Activity.NOTHING
        self.lift_off_thrust = 0.0  # normalised, as last sent while lifting off
        self.position_error_enu: Vector = np.zeros(3)
        self.counters: Counter[str] = self._sender.counters
        self.reactions: list[tuple[float, Reaction]] = []
        """When the supervisor came to which reaction."""
        self._leaving = False  # the flight is over, and nobody else has the vehicle yet
        self._level_limit = 1.0  # hover thrusts
        self.held = ""  # why the plan was left for a hold; empty while it is followed

    @property
    def hover_thrust(self) -> float:
        """Normalised thrust that is taken to carry the weight."""
        return self._sender.thrust.hover_thrust

    @property
    def world_moved(self) -> bool:
        """Whether the estimator has been reset since the law took over: the plan went along."""
        return self._shift_enu is not None or self._shift_yaw_rad != 0.0

    @property
    def state_delay_s(self) -> float:
        """By how much states are predicted ahead."""
        return self._predictor.delay_s

    @property
    def law(self) -> ControlLaw:
        """The law that flies."""
        return self._law

    def fly_by(self, name: str) -> None:
        """Let another of `laws` fly, in the air without a bump: it goes on from the setpoint that was sent last.

        Raises KeyError for a name that is not among them.
        """
        before, self._law = self._law, self.laws[name]
        self._memory = self._law.initial_memory()
        state, sender = self._vehicle.state, self._sender
        if self.activity is not Activity.FOLLOW or state is None:
            return
        if before.name == AUTOPILOT:
            self._predictor.hovering(state.time_s, sender.asked_quaternion, sender.asked_thrust_newton)
        ahead = self._predictor.predict(state)
        reference = self._sample(ahead.time_s)
        self._take_over(state.time_s, ahead, reference, sender.asked_thrust_newton, sender.asked_quaternion)
        if self._watching is not None:
            self._watching.supervisor.law_changed(law_bounds(self._law))

    def _take_over(
        self,
        time_s: float,
        state: VehicleState,
        reference: Reference,
        thrust_newton: float,
        quaternion: Vector,
    ) -> None:
        """The law flies from the state after the one at `time_s` on."""
        self._memory = self._law.take_over(self._memory, state, reference, thrust_newton, quaternion)
        self._terms = None
        self._recorder.log.event("law", time_s, controller=self._law.name)

    @property
    def controlled_until_s(self) -> float:
        """Time of the newest state that was answered, autopilot's clock."""
        return self._last_step_s

    @property
    def plan_time_s(self) -> float:
        """Seconds since the plan began, by the newest state."""
        state = self._vehicle.state
        return state.time_s - self._plan_started_s if state is not None else 0.0

    @property
    def moved(self) -> tuple[Vector, float]:
        """By how much the plan was moved, (3,) m, and turned, rad, with the estimator's frame since it began."""
        return _NO_JUMP if self._shift_enu is None else self._shift_enu, self._shift_yaw_rad

    # Changing over --------------------------------------------------------------------------------------

    def note_link(self, streams: list[StreamFigures], timesync: TimeSync) -> None:
        """Let the prediction reach as much further as this link is slower than the one the dead times were found on.

        A setpoint leaves when an attitude arrives, so the way from the attitude's stamp to the autopilot is the
        stream's own age and half a round trip. The profile's dead times have a quick link in them already. Of a
        simulation that does not run in real time, the round trip by its own clock says the same.
        """
        age_s = next((f.age_s for f in streams if f.message_id == ATTITUDE_STREAM), math.nan)
        real_time = self._watching is not None and self._watching.real_time
        way_s = age_s + 0.5 * timesync.round_trip_s if real_time else timesync.autopilot_trip_s
        if math.isfinite(way_s):
            beyond_s = min(max(0.0, way_s - LINK_INCLUDED_S), LONGEST_LINK_S)
            self._predictor.link_delay_s += LINK_SHARE * (beyond_s - self._predictor.link_delay_s)

    def idle(self, quaternion_wxyz: Vector) -> None:
        """Send idle setpoints that keep the heading of `quaternion_wxyz` (4,) level."""
        self._level_quaternion = quaternion_wxyz
        self.activity = Activity.IDLE

    def lift_off(self, now_s: float, spool_time_s: float, watching: Watching) -> None:
        """Begin to raise the thrust; it starts to rise once the motors can turn (`spool_time_s` after arming)."""
        self._lift_off_started_s = now_s + spool_time_s
        self._watching = watching
        self._sender.watchdog, self._sender.last_sent_s = watching.watchdog, now_s
        self._jump_enu = None
        self.activity = Activity.LIFT_OFF

    def follow(self, plan: FlightPlan, state: VehicleState) -> None:
        """Hand over to the control law at `state`: it goes on from level flight with the thrust that carries the weight.

        What lifted the vehicle off is more than that: kept, it would go on accelerating it.
        """
        rise_1_s = self._settings.procedure.lift_off_rate * self._sender.thrust.hover_thrust
        self._hover.lifted_off(self.lift_off_thrust, rise_1_s, float(state.velocity_enu[2]))
        self._begin(plan, state, state)

    def hover(self, quaternion_wxyz: Vector, thrust: float) -> None:
        """Send what keeps a hovering vehicle as it is: attitude (4,), and the thrust it hovers with (0..1)."""
        self._level_quaternion = quaternion_wxyz
        if math.isfinite(thrust):
            self._sender.thrust = replace(self._sender.thrust, hover_thrust=thrust)
        self.activity = Activity.LEVEL

    def take_on(self, plan: FlightPlan, state: VehicleState, watching: Watching) -> None:
        """Hand over to the control law in the air: it goes on from what `hover` was told last."""
        self._watching = watching
        self._sender.watchdog, self._sender.last_sent_s = watching.watchdog, state.time_s
        self._hover.hovered(self._sender.thrust.hover_thrust)
        scale = self._sender.thrust
        self._predictor.hovering(state.time_s, self._level_quaternion, scale.newton(scale.hover_thrust))
        self._begin(plan, state, self._predictor.predict(state))

    def _begin(self, plan: FlightPlan, state: VehicleState, seen: VehicleState) -> None:
        """Follow `plan` from `state` on; the law takes over at the state `seen`, which it would be shown next."""
        self._plan, self._plan_started_s = plan, state.time_s
        self._reaction, self._terms, self.held = Reaction.NONE, None, ""
        self._shift_enu, self._shift_yaw_rad = None, 0.0
        self._jump_enu = None
        self._sender.thrust = replace(self._sender.thrust, hover_thrust=self._hover.hover_thrust)
        scale = self._sender.thrust
        reference = plan.sample(seen.time_s - state.time_s)
        newton = scale.newton(scale.hover_thrust)
        self._take_over(state.time_s, seen, reference, newton, self._level_quaternion)
        self._last_step_s = state.time_s - self.period_s
        self.activity = Activity.FOLLOW

    def measure(self, response: AttitudeResponseMeter | None, drag: DragMeter | None) -> None:
        """Let them see what is sent and what becomes of it, from now on; drag is flown with as it is found."""
        self._sender.meter, self._drag = response, drag

    def measured(self) -> MeasuredResponse | None:
        """How the attitude loop has answered so far; None where that is not measured."""
        return None if self._sender.meter is None else self._sender.meter.measured()

    def measured_drag(self) -> tuple[float, float] | None:
        """Horizontal drag per mass as found so far, 1/s, and its standard deviation; None where it is not measured."""
        return None if self._drag is None else self._drag.measured()

    def change_law(self, law: ControlLaw, profile: VehicleProfile, autopilot: str) -> None:
        """Go on in flight with gains and prediction for another response of the autopilot, without a step in what is sent.

        Everything learnt so far stays: weights, and the force of the integral.
        """
        state = self._vehicle.state
        assert state is not None and self.activity is Activity.FOLLOW
        packed = self._memory.packed.copy()
        before, now = self._law.parameters.position.K_i, law.parameters.position.K_i
        for i in range(3):
            if now[i] > 0.0:
                packed[0]["position_integral"][i] *= before[i] / now[i]
        self._law = law
        self._predictor.respond(profile, law.level, autopilot)
        ahead = self._predictor.predict(state)
        self._memory = law.take_over(
            Memory(packed),
            ahead,
            self._asked(ahead.time_s),
            self._sender.asked_thrust_newton,
            self._sender.asked_quaternion,
        )

    @property
    def cannot_have_left(self) -> bool:
        """Whether the vehicle is on the ground, by what was sent before lift-off is believed: it may be dropped from there.

        A land detector says nothing of that once thrust rises (ArduCopter's says in the air as soon as its motors turn).
        """
        settings, state = self._settings.procedure, self._vehicle.state
        hovers = self.lift_off_thrust / self._sender.thrust.hover_thrust
        if hovers == 0.0:
            return self._vehicle.on_ground is not False
        if hovers < settings.lift_off_least or state is None:
            return hovers < settings.lift_off_least
        gained_m = float(state.position_enu[2]) - self._lift_off_from_m
        return hovers < 1.0 and gained_m < settings.lift_off_height_m

    def stand_down(self) -> None:
        """The flight is over, and the vehicle on the ground: idle setpoints until somebody else has it."""
        self._leaving, self._sender.watchdog = True, None
        self.activity = Activity.IDLE

    def level(self) -> None:
        """The flight is over: keep the vehicle level where it heads, whatever is known of it, until somebody else has it.

        Thrust carries the weight, less where it climbs, and never more than lifted it off if it may not have left the
        ground yet: what is believed of height and speed may be why the flight is over.
        """
        if self.activity is Activity.FOLLOW and self._vehicle.state is not None:
            self._level_quaternion = level_with_heading(yaw_of(self._vehicle.state.quaternion_wxyz))
        elif self.lift_off_thrust > 0.0:
            self._level_limit = min(1.0, self.lift_off_thrust / self._sender.thrust.hover_thrust)
        self._leaving, self._sender.watchdog = True, None
        self.activity = Activity.LEVEL

    def leave_level(self, state: VehicleState) -> None:
        """Leave a level setpoint standing, with hover thrust: whoever comes next may need a moment."""
        self._level_quaternion = level_with_heading(yaw_of(state.quaternion_wxyz))
        self._send_level(state, self._sender.thrust.hover_thrust)

    def stop(self) -> None:
        """Send nothing any more."""
        self.activity = Activity.NOTHING

    # One state ------------------------------------------------------------------------------------------

    def on_state(self, state: VehicleState) -> None:
        """Answer one state.

        Raises:
            FlightEnd: when the supervisor ends the flight, or the law cannot answer.
        """
        started_ns = time.perf_counter_ns()
        age_s = max(0.0, state.time_s - self._vehicle.assembler.position_time_s)
        self._recorder.state(state, age_s)
        gap_s, self._last_state_s = state.time_s - self._last_state_s, state.time_s
        if gap_s < -RESTART_S and not self._leaving:
            raise Aborted("the autopilot's clock started again: it has restarted")
        jump = self._vehicle.assembler.take_jump()
        if jump is not None:
            self._jump_enu = jump if self._jump_enu is None else self._jump_enu + jump
        if self.activity is Activity.NOTHING or 0.0 <= state.time_s - self._last_step_s < 0.5 * self.period_s:
            return
        law_s = 0.0
        if self.activity is Activity.FOLLOW:
            law_s = self._follow(state, gap_s, age_s)
        elif self.activity is Activity.LIFT_OFF:
            self._lift(state, gap_s, age_s)
        else:
            self._send_level(state, self._level_thrust(float(state.velocity_enu[2])))
        self._last_step_s = state.time_s
        ended_ns = time.perf_counter_ns()
        period_s = (started_ns - self._last_wall_ns) * 1e-9 if self._last_wall_ns else math.nan
        self._last_wall_ns = started_ns
        compute_s = (ended_ns - started_ns) * 1e-9
        overrun = compute_s > self.period_s
        if overrun:
            self.counters["overruns"] += 1
        self._overrun_share += min(1.0, self.period_s / OVERRUN_WINDOW_S) * (overrun - self._overrun_share)
        self._recorder.timing(state.time_s, period_s, compute_s, law_s)

    def on_lone_attitude(self, state: VehicleState) -> None:
        """Answer an attitude without a position, where that is enough: to keep the vehicle level, or idle."""
        if self._leaving and state.time_s - self._last_step_s >= 0.5 * self.period_s:
            self._last_step_s = state.time_s
            self._keep_level(state)

    def _keep_level(self, state: VehicleState) -> None:
        if self.activity in (Activity.IDLE, Activity.LEVEL):
            self._send_level(state, self._level_thrust(0.0))

    def _level_thrust(self, climb_m_s: float) -> float:
        """Normalised: none while idle, else what carries the weight, within bounds."""
        if self.activity is Activity.IDLE:
            return 0.0
        hovers = max(LEAST_LEVEL, 1.0 - CLIMB_BRAKE * max(0.0, climb_m_s))
        return min(hovers, self._level_limit) * self._sender.thrust.hover_thrust

    def check_absence(self) -> None:
        """Look at the autopilot's time going on without states; called for every message, and while there is none.

        On the way out the vehicle is then kept level, or idle, without any: the attitude that is wanted is known, and
        no turning is what may be asked for blindly at the other levels.

        Raises:
            FlightEnd: when the supervisor ends the flight.
        """
        now_s = self._vehicle.link.autopilot_time_s
        if self._leaving:
            if now_s - self._last_step_s >= ABSENT_AFTER * self.period_s:
                self._last_step_s = now_s
                self._keep_level(VehicleState(now_s, _NO_JUMP, _NO_JUMP, self._level_quaternion, np.zeros(3)))
            return
        if self.activity not in (Activity.FOLLOW, Activity.LIFT_OFF):
            return
        gap_s = now_s - self._last_state_s
        if gap_s < ABSENT_AFTER * self.period_s:
            return
        assert self._watching is not None
        age_s = now_s - self._vehicle.assembler.position_time_s
        self._react(self._watching.supervisor.judge_absence(now_s, gap_s, age_s), now_s)

    def _follow(self, state: VehicleState, gap_s: float, age_s: float) -> float:
        assert self._plan is not None
        jump, plan = self._jump_enu, self._plan
        if jump is not None:  # the world was moved, not the vehicle: the plan goes with it
            self._shift_enu = jump if self._shift_enu is None else self._shift_enu + jump
        reference = self._sample(state.time_s)
        judgement = self._judge(state, reference, gap_s, age_s)
        if judgement.yaw_jump_rad:
            self._shift_yaw_rad += judgement.yaw_jump_rad
        if jump is not None or judgement.yaw_jump_rad:
            moved = _NO_JUMP if jump is None else jump
            turned = judgement.yaw_jump_rad
            self._recorder.log.event("estimator_reset", state.time_s, jump_enu=moved, yaw_jump_rad=turned)
        self._react(judgement, state.time_s)
        ours = self._law.name != AUTOPILOT
        self._estimate_hover(state, trusted=ours and judgement.gate is AdaptationGate.RUN)
        if self._sender.meter is not None and ours:
            self._sender.meter.update(state.time_s, state.quaternion_wxyz)
        if self._drag is not None:
            free = judgement.gate is AdaptationGate.RUN and jump is None
            self._drag.update(state.time_s, state.velocity_enu, state.quaternion_wxyz, free)
        if judgement.yaw_jump_rad or self._plan is not plan:
            reference = self._sample(state.time_s)
        self.position_error_enu = reference.position_enu - state.position_enu
        tracking_s = tracking_time(self._plan, state.time_s - self._plan_started_s)
        if not ours:
            self._sender.send_reference(state, reference)
            self._recorder.reference(state.time_s, reference, tracking_s)
            return 0.0
        dt_s = min(state.time_s - self._last_step_s, LONGEST_STEP * self.period_s)
        law_ns = time.perf_counter_ns()
        ahead = self._predictor.predict(state)
        inputs = pack_input(
            ahead, self._asked(ahead.time_s), dt_s, judgement.gate, self._thrust_bounds_newton
        )
        try:
            result = self._law.step_packed(self._memory, inputs)
        except StepRefused as error:
            raise Aborted(f"the control law has no answer: {error}") from error
        law_s = (time.perf_counter_ns() - law_ns) * 1e-9
        memory = self._memory
        actuators = result.setpoint.level is ControlLevel.ACTUATOR
        rotor_thrust = result.terms.packed["rotor_thrust"][0] if actuators else None
        if self._sender.send(state.time_s, result.setpoint, rotor_thrust):
            self._memory, self._terms = result.memory, result.terms
        self._recorder.reference(state.time_s, reference, tracking_s)
        self._recorder.step(state.time_s, memory, inputs, result)
        self._note_bounds(result.terms.flags)
        return law_s

    @property
    def _thrust_bounds_newton(self) -> tuple[float, float]:
        """Rotor thrusts go by the profile's numbers; a collective thrust goes by the scale in force."""
        if self._law.level is ControlLevel.ACTUATOR:
            return self._law.thrust_bounds_newton
        return self._sender.thrust.bounds_newton

    def _estimate_hover(self, state: VehicleState, trusted: bool) -> None:
        """Let the thrust scale follow what the thrust really does: slowly, so that the law's integrals go along."""
        time_s = self._vehicle.assembler.position_time_s  # the velocity's own time
        if time_s <= self._velocity_time_s:
            return
        self._velocity_time_s = time_s
        free = trusted and not self._flags & POSITION_SATURATES
        self._hover.update(
            time_s, float(state.velocity_enu[2]), math.cos(tilt_of(state.quaternion_wxyz)), free
        )
        hover_thrust = self._hover.hover_thrust
        if hover_thrust != self._sender.thrust.hover_thrust:
            self._sender.thrust = replace(self._sender.thrust, hover_thrust=hover_thrust)

    def _lift(self, state: VehicleState, gap_s: float, age_s: float) -> None:
        limit_deg = self._settings.safety.lift_off_tilt_deg
        tilt_deg = math.degrees(tilt_of(state.quaternion_wxyz))
        if not tilt_deg <= limit_deg:
            raise TippedOver(f"tipping over at lift-off: tilt {tilt_deg:.0f}°, limit {limit_deg:g}°")
        height_m = float(state.position_enu[2])
        if math.isnan(self._lift_off_from_m):
            self._lift_off_from_m = height_m
        if height_m < self._lift_off_from_m - SUNK_M:
            raise Aborted(
                f"the estimate sinks into the ground at lift-off, by {self._lift_off_from_m - height_m:.1f} m: "
                "is its height upside down (poses from outside), or its barometer in the rotors' wind?"
            )
        reference = at_rest(state.position_enu, yaw_of(self._level_quaternion))
        judgement = self._judge(state, reference, gap_s, age_s, lifting_off=True)
        if judgement.reaction >= Reaction.HOLD:
            raise Aborted(judgement.reason)
        self._react(judgement, state.time_s)
        self._send_level(state, self._lift_off_thrust(state.time_s))

    def _sample(self, time_s: float) -> Reference:
        """The plan at the autopilot's time, moved along with the estimator's frame."""
        assert self._plan is not None
        reference = self._plan.sample(time_s - self._plan_started_s)
        if self._shift_yaw_rad:
            reference = replace(reference, yaw_rad=reference.yaw_rad + self._shift_yaw_rad)
        if self._shift_enu is not None:
            reference = replace(reference, position_enu=reference.position_enu + self._shift_enu)
        return reference

    def _asked(self, time_s: float) -> Reference:
        """The plan as the law gets it: with the accelerations that thrust has to make."""
        reference = self._sample(time_s)
        return reference if self._drag is None else self._drag.with_drag(reference)

    # The supervisor's word ------------------------------------------------------------------------------

    def _judge(
        self, state: VehicleState, reference: Reference, gap_s: float, age_s: float, lifting_off: bool = False
    ) -> Judgement:
        watching = self._watching
        assert watching is not None
        jump, self._jump_enu = self._jump_enu, None
        if jump is not None:
            watching.supervisor.move_home(jump)
            self._vehicle.poses.estimate_jumped()
        if watching.real_time:
            late_s = self._vehicle.link.timesync.lateness_s(state.time_s, time.monotonic())
            gap_s = max(gap_s, late_s) if math.isfinite(late_s) else gap_s
        sight = Sight(
            reference=reference,
            attitude_age_s=gap_s,
            position_age_s=age_s,
            position_time_s=self._vehicle.assembler.position_time_s,
            jump_enu=jump if jump is not None else _NO_JUMP,
            asked_quaternion=self._sender.asked_quaternion,
            asked_thrust_newton=self._sender.asked_thrust_newton,
            thrust_bounds_newton=self._thrust_bounds_newton,
            terms=self._terms,
            refused_setpoints=self._sender.refused,
            setpoint_gap_s=state.time_s - self._sender.last_sent_s,
            overrun_share=self._overrun_share,
            thrust_hovers=self._sender.asked_thrust_newton
            / self._sender.thrust.newton(self._sender.thrust.hover_thrust),
            poses=self._vehicle.pose_figures(state.time_s),
        )
        return watching.supervisor.judge(state, sight, lifting_off)

    def _react(self, judgement: Judgement, time_s: float) -> None:
        """Log what began or ended, and do what the reaction asks for when it changes."""
        watching = self._watching
        assert watching is not None
        for change in judgement.changes:
            rung = change.rung
            self._recorder.log.event(
                "safety",
                time_s,
                reaction=rung.reaction.setting,
                active=change.began,
                quantity=rung.name,
                value=change.value,
                limit=rung.at,
                unit=rung.unit,
                lasted_s=change.lasted_s,
            )
            if change.began:
                watching.announce(f"{rung.reaction.setting}: {rung.sentence(change.value)}")
        reaction = judgement.reaction
        if reaction is self._reaction:
            return
        before, self._reaction = self._reaction, reaction
        self.reactions.append((time_s, reaction))
        self._recorder.log.event(
            "safety", time_s, reaction=reaction.setting, before=before.setting, reason=judgement.reason
        )
        if reaction >= Reaction.LAND:
            raise ending(reaction, judgement.reason)
        if reaction is Reaction.NON_ADAPTIVE and self._terms is not None:
            self._memory = without_networks(self._law, self._memory, self._terms)
        if reaction is Reaction.HOLD and self._plan is not None:
            stopping = self._plan.sample(time_s - self._plan_started_s)
            self._plan = stopping_plan(stopping, watching.transit_limits, self._settings.safety.hold_s)
            self._plan_started_s = time_s
            self.held = judgement.reason

    # Out ------------------------------------------------------------------------------------------------

    def _send_level(self, state: VehicleState, thrust: float) -> None:
        p = self._law.parameters
        newton = self._sender.thrust.newton(thrust)
        limit = self._sender.gate.body_rate_max_rad_s
        setpoint = level_setpoint(self._law.level, state, self._level_quaternion, newton, p.inertia, limit)
        rotor_thrust = None
        if setpoint.level is ControlLevel.ACTUATOR:
            rotor_thrust = p.mixer[: p.rotor_count] @ np.array([newton, *setpoint.torque_flu])
        self._sender.send(state.time_s, setpoint, rotor_thrust, thrust)

    def _lift_off_thrust(self, time_s: float) -> float:
        settings = self._settings.procedure
        rising_s = max(0.0, time_s - self._lift_off_started_s)
        hovers = settings.lift_off_start + settings.lift_off_rate * rising_s
        self.lift_off_thrust = hovers * self._sender.thrust.hover_thrust
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
