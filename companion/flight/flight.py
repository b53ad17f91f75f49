"""One flight from the first HEARTBEAT to the last word: the phases in order, and what happens when one breaks off."""

from __future__ import annotations

import itertools
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from companion.autopilot.adapter import ARM, Finding, Intent
from companion.config.errors import UserError
from companion.config.settings import FlightSettings
from companion.control.structs import Reference, Vector
from companion.flight.control_loop import ControlLoop, Watching, at_rest, level_with_heading, yaw_of
from companion.flight.descent import Descent
from companion.flight.fence import require_inside
from companion.flight.journal import Journal
from companion.flight.lift_off import LiftOffDetector
from companion.flight.live_references import BEYOND_END_S, LiveReferences
from companion.flight.outcome import (
    Aborted,
    FlightEnd,
    HandedBack,
    Interrupted,
    Outcome,
    PilotTookOver,
    PlanFlown,
    Refused,
    WaitedTooLong,
)
from companion.flight.phases import Phase
from companion.flight.pilot import Pilot
from companion.flight.plan import FlightPlan, Leg, lay_out
from companion.flight.preflight import Preflight, require
from companion.flight.realtime import LoopWatchdog
from companion.flight.recorder import Recorder
from companion.flight.reporter import Reporter
from companion.flight.stage import FlightRequest, FlightResult, Interrupts, Stage
from companion.flight.supervisor import Supervisor, law_bounds
from companion.flight.vehicle import HANDLED, LANDED_STATE_HOLDS_S, Vehicle
from companion.flightlog.reactions import in_words, reaction_times
from companion.live.trajectory import LiveTrajectory
from companion.mavlink.link import Message, mav
from companion.reference.mission import Mission
from companion.reference.trajectory import Frame, Placed, Trajectory, place
from companion.reference.transit import TransitLimits

_RC_CHANNELS: int = mav.MAVLINK_MSG_ID_RC_CHANNELS
_STANDING = (
    Phase.PROVE,
    Phase.ENGAGE,
    Phase.ARM,
)  # idle setpoints go out, which must never meet a flying vehicle
MOST_RAISED_M = 1.0  # beyond that it is another flight than was asked for
LOWEST_SAMPLES = 400
NO_POSITIONS = "the autopilot's own controller follows no positions here: it has no position estimate (GPS)"
MISTAKE = "mistake in this program"
REAL_TIME_TOLERANCE = 0.02  # of the time passed: a lockstep simulation runs at any other speed


class Flight:
    """See the module. `make_loop` builds the control loop once the autopilot is known, `use_measured` changes its gains
    for what the flight has shown by the time it is to track."""

    begins_in_air = False
    """Whether the vehicle flies already: parameters are left alone then."""
    patience_s: float | None = None
    """How long an autopilot is waited for, and until it is ready; None: as set."""

    def __init__(
        self,
        vehicle: Vehicle,
        request: FlightRequest,
        settings: FlightSettings,
        recorder: Recorder,
        preflight: Preflight,
        reporter: Reporter,
        interrupts: Interrupts,
        make_loop: Callable[[Vehicle], ControlLoop],
        check_plan: Callable[[FlightPlan, float], None],
        use_measured: Callable[[ControlLoop, float], None] = lambda _loop, _time_s: None,
    ) -> None:
        self._vehicle = vehicle
        self._request = request
        self._settings = settings
        self._recorder = recorder
        self._preflight = preflight
        self._reporter = reporter
        self._interrupts = interrupts
        self._make_loop = make_loop
        self._check_plan = check_plan
        self._use_measured = use_measured
        self._loop: ControlLoop
        self._home: Reference  # where it took off
        self._stage = Stage(vehicle, recorder, reporter, then=request.then)
        live = request.trajectory if isinstance(request.trajectory, LiveTrajectory) else None
        self._live = LiveReferences(self._stage, settings, live, request.frame) if live is not None else None
        self._descent = Descent(self._stage, settings)
        self._journal = Journal(self._stage, settings.procedure.connect_timeout_s, settings.safety)
        self._armed_by_now = False  # we count on it
        self._pilot = Pilot(settings.safety.stick_share)
        self._transmitter_lost = False
        self._raised_m = 0.0  # of the trajectory, for the sake of the height estimate
        self._handed_over_s = 0.0
        self._watchdog = LoopWatchdog(settings.safety.stall_s, self._note_stall)
        self._real_time = False
        self._clocks_s = (0.0, 0.0)  # the autopilot's and ours, when it was ready
        self._answered_interrupts = 0
        self._standing_counts = False  # whether it stands is known, and has to stay so

    def run(self) -> FlightResult:
        """Fly. Always ends with the vehicle in the safest state that could be reached.

        Raises:
            UserError: nothing to fly was found at the endpoint, or the trajectory cannot be flown.
        """
        self._vehicle.watch = self._watch
        try:
            self._get_ready()
            self._take_off()
            self._follow_plan()
            result = self._descent.end(PlanFlown("the plan is flown"))
        except FlightEnd as end:
            result = self._descent.end(end)
        except WaitedTooLong as waited:
            result = self._descent.end(Aborted(str(waited)) if self._stage.engaged else Refused(str(waited)))
        except UserError as error:
            self._write_down(self._descent.end(Refused(str(error))))
            raise
        except Exception as error:
            # A mistake of ours, or of somebody's law, must not leave a vehicle in the air; table, JSON and log stand.
            result = self._descent.end(Aborted(f"{MISTAKE}: {error!r}"))
            where = traceback.format_exc()
            self._recorder.log.event("mistake", self._vehicle.link.autopilot_time_s, text=where)
            self._reporter.say(where)
        return self._write_down(result)

    def _write_down(self, result: FlightResult) -> FlightResult:
        """The last acts of every flight: parameters as they were, and the last word in the log."""
        self._watchdog.stop()
        self._put_parameters_back(result)
        if self._live is not None:
            self._live.tell()
        loop = self._stage.loop
        if loop is not None:
            reacted = in_words(reaction_times(loop.reactions, loop.controlled_until_s))
            result = replace(result, text=f"{result.text}; {reacted}") if reacted else result
            self._recorder.log.metadata("wall setpoints", loop.counters)
        self._recorder.log.metadata("wall link", self._vehicle.link.counters)
        self._recorder.log.event(
            "ended", self._vehicle.link.autopilot_time_s, outcome=result.outcome.value, text=result.text
        )
        return result

    # Before the flight --------------------------------------------------------------------------------

    def _get_ready(self) -> None:
        self._stage.enter(Phase.CONNECT)
        timeout_s = self._settings.procedure.connect_timeout_s if self.patience_s is None else self.patience_s
        self._vehicle.connect(timeout_s, self._journal.waiting)
        self._vehicle.on_message = self._on_message
        self._prepare()

    def _prepare(self) -> None:
        vehicle, reporter = self._vehicle, self._reporter
        reporter.say(f"{vehicle.firmware}, system {vehicle.link.target_system}")
        self._stage.enter(Phase.CHECK)
        checks = self._preflight
        checks.ask_for_streams()
        findings = checks.parameter_findings()
        self._loop = self._stage.loop = self._make_loop(vehicle)
        if any(name not in self._loop.laws for name, _ in self._request.schedule):
            raise Refused(NO_POSITIONS)
        if checks.changes.pending() and not self.begins_in_air:
            self._require_standing()
            checks.changes.put_back()
            findings = checks.parameter_findings()
        if self._request.fix:
            self._require_standing()  # parameters of a vehicle that flies are not touched
            findings = checks.fix(findings, for_good=False)
            for name, before, value in checks.changed:
                self._recorder.log.event(
                    "parameter", vehicle.link.autopilot_time_s, name=name, before=before, value=value
                )
        self._report(findings)
        self._stage.enter(Phase.READY)
        vehicle.on_state = self._loop.on_state
        vehicle.on_lone_attitude = self._loop.on_lone_attitude
        waited_s = checks.wait_until_ready(self.patience_s)
        reporter.say(f"ready after {waited_s:.1f} s")
        self._clocks_s = (vehicle.link.autopilot_time_s, time.monotonic())
        self._report([*checks.link_findings(checks.measure()), *checks.vehicle_findings()])

    def _report(self, findings: list[Finding]) -> None:
        for finding in findings:
            self._reporter.finding(finding)
        require(findings)

    # Into the air --------------------------------------------------------------------------------------

    def _take_off(self) -> None:
        vehicle, settings, loop = self._vehicle, self._settings, self._loop
        vehicle.link.wanted = HANDLED | {_RC_CHANNELS}  # half of what comes is for the log only
        ground = self._ground()
        self._stage.ground_m = float(ground.position_enu[2])
        self._stage.plan = self._lay_out(ground)
        self._check_plan(self._stage.plan, float(ground.position_enu[2]))
        require_inside(settings.safety, self._stage.plan, ground.position_enu)
        level = level_with_heading(ground.yaw_rad)
        self._require_standing()
        if self._pilot_arms:
            self._engage_armed(level)
        else:
            self._prove(level)
            self._stage.enter(Phase.ENGAGE)
            self._engage()
            self._stage.enter(Phase.ARM)
            self._arm()
        ground = self._ground()
        # milliseconds, so on the ground: at lift-off only its climb is planned anew
        plan = self._lay_out(ground)
        self._announce(plan)
        self._home = ground
        self._stage.enter(Phase.LIFT_OFF)
        vehicle.taken_off = True
        vehicle.link.look_out(False)
        assert vehicle.state is not None
        loop.idle(level_with_heading(ground.yaw_rad))
        loop.lift_off(vehicle.state.time_s, vehicle.adapter.spool_time_s, self._watch_over(ground))
        detector = LiftOffDetector(settings.procedure)
        vehicle.until(lambda: self._left(detector), vehicle.adapter.spool_time_s + 15.0, "lift-off")
        self._stage.airborne = True
        state = vehicle.state
        rising = np.array([0.0, 0.0, max(0.0, float(state.velocity_enu[2]))])
        start = replace(at_rest(state.position_enu, ground.yaw_rad), velocity_enu=rising)
        self._stage.plan = plan.climbing_from(start, self._transit_limits(float(ground.position_enu[2])))
        loop.follow(self._stage.plan, state)
        flying = (
            f"flying {self._stage.plan.duration_s:.0f} s" if self._live is None else "waiting for references"
        )
        self._reporter.say(f"off the ground at thrust {loop.lift_off_thrust:.2f}; {flying}")

    def _announce(self, plan: FlightPlan) -> None:
        """Log the trajectory's path, and how it lies: errors are judged along its own axes."""
        track = plan.leg(Phase.TRACK)
        moments = np.linspace(0.0, track.duration_s, 200)
        self._recorder.log.path_enu(
            "trajectory",
            self._vehicle.link.autopilot_time_s,
            np.array([track.trajectory.sample(float(t)).position_enu for t in moments]),
        )
        where = track.trajectory if isinstance(track.trajectory, Placed) else None
        self._recorder.log.event(
            "layout",
            self._vehicle.link.autopilot_time_s,
            heading_rad=where.heading_rad if where is not None else 0.0,
            origin_enu=where.origin_enu.tolist() if where is not None else [0.0, 0.0, 0.0],
        )

    def _watch_over(self, ground: Reference) -> Watching:
        """Supervisor and watchdog, from lift-off on."""
        vehicle, link, settings = self._vehicle, self._vehicle.link, self._settings
        autopilot_s = link.autopilot_time_s - self._clocks_s[0]
        ours_s = time.monotonic() - self._clocks_s[1]
        apart_s = abs(autopilot_s - ours_s)
        together = link.timesync.steady and apart_s < 0.05 + REAL_TIME_TOLERANCE * ours_s
        self._real_time = together or not vehicle.simulated
        self._recorder.log.metadata("wall clock", {"real_time": str(self._real_time)})
        supervisor = self._journal.supervisor = Supervisor(
            settings.safety,
            law_bounds(self._loop.law),
            ground.position_enu,
            vehicle.status,
            link,
            self._real_time,
        )
        if self._real_time:
            self._watchdog.start()
        return Watching(
            supervisor,
            self._watchdog,
            self._transit_limits(float(ground.position_enu[2])),
            self._real_time,
            self._reporter.say,
        )

    def _note_stall(self, still_s: float) -> None:
        """Called in the watchdog's thread, while the flight's own hangs."""
        self._recorder.log.event(
            "safety", self._vehicle.link.autopilot_time_s, reaction="loop stalled", value=still_s, unit="s"
        )

    def _ground(self) -> Reference:
        state = self._vehicle.state
        assert state is not None
        return at_rest(state.position_enu, yaw_of(state.quaternion_wxyz))

    def _left(self, detector: LiftOffDetector) -> bool:
        state, loop = self._vehicle.state, self._loop
        assert state is not None
        height_m, speed_m_s = float(state.position_enu[2]), float(state.velocity_enu[2])
        return detector.has_left(state.time_s, height_m, speed_m_s, loop.lift_off_thrust / loop.hover_thrust)

    def _lay_out(self, ground: Reference) -> FlightPlan:
        settings = self._settings
        if self._live is not None:
            up = np.array([0.0, 0.0, settings.takeoff_height_m])
            self._live.wait_at(
                at_rest(ground.position_enu + up, ground.yaw_rad), float(ground.position_enu[2])
            )
        trajectory = self._above_ground(ground)
        limits = self._transit_limits(float(ground.position_enu[2]))
        return lay_out(
            ground,
            trajectory,
            self._tracked_s,
            settings.procedure.hold_s,
            settings.takeoff_height_m,
            limits,
        )

    @property
    def _tracked_s(self) -> float:
        """For how long tracking is laid out: references of another program are looked ahead of at their end, too."""
        return self._request.duration_s + (BEYOND_END_S if self._live is not None else 0.0)

    def _above_ground(self, ground: Reference) -> Trajectory:
        """The trajectory laid out, and raised where it comes lower than the height estimate may be wrong.

        Raises:
            Refused: it may be wrong by more than MOST_RAISED_M, or the trajectory lies in the local frame.
        """
        request, accuracy_m = self._request, self._vehicle.status.height_accuracy_m or 0.0
        if isinstance(request.trajectory, Mission):
            laid_out = self._located(request.trajectory, ground)
            least_m = lowest_m(laid_out, laid_out.duration_s) - float(ground.position_enu[2])
            if least_m < accuracy_m:
                raise Refused(
                    f"{request.trajectory.name} comes down to {least_m:.2f} m, and the height may be wrong by "
                    f"{accuracy_m:.2f} m (ESTIMATOR_STATUS): fly higher, or wait until the estimate has settled"
                )
            return laid_out
        laid_out = place(request.trajectory, request.frame, ground.position_enu, ground.yaw_rad)
        least_m = lowest_m(laid_out, request.duration_s) - float(ground.position_enu[2])
        wanted_m = max(self._raised_m, accuracy_m - least_m)
        if wanted_m <= 0.0:
            return laid_out
        why = f"the trajectory comes down to {least_m:.2f} m, and the height estimate may be wrong by {accuracy_m:.2f} m"
        if request.frame is Frame.LOCAL or wanted_m > MOST_RAISED_M:
            raise Refused(f"{why} (ESTIMATOR_STATUS): fly higher, or wait until the estimate has settled")
        if not self._raised_m:
            self._reporter.say(f"{why}: raised by {wanted_m:.2f} m")
            self._recorder.log.event(
                "warning", self._vehicle.link.autopilot_time_s, text=f"{why}: raised by {wanted_m:.2f} m"
            )
        self._raised_m = wanted_m
        return place(
            request.trajectory,
            request.frame,
            ground.position_enu + np.array([0.0, 0.0, wanted_m]),
            ground.yaw_rad,
        )

    def _located(self, mission: Mission, home: Reference) -> Trajectory:
        """A mission where its places lie; `home` is where the vehicle took off. Raises Refused where that is not known."""
        origin = self._vehicle.status.global_origin
        if origin is None:
            raise Refused(
                f"{mission.name} has latitudes and longitudes, and the autopilot does not say where its local frame lies "
                "(GPS_GLOBAL_ORIGIN): does it have a GPS fix?"
            )
        return mission.located(origin, home.position_enu, home.yaw_rad)

    def _transit_limits(self, ground_m: float) -> TransitLimits:
        procedure = self._settings.procedure
        return TransitLimits(
            speed_m_s=procedure.transit_speed_m_s,
            acceleration_m_s2=procedure.transit_acceleration_m_s2,
            jerk_m_s3=procedure.transit_jerk_m_s3,
            height_min_m=ground_m + 0.25,
        )

    @property
    def _pilot_arms(self) -> bool:
        return not (self._request.may_arm or self._vehicle.simulated)

    def _prove(self, level: Vector) -> None:
        """Idle setpoints, for as long as the autopilot wants to have seen them, and until the arming gesture is over."""
        vehicle, lasts_s = self._vehicle, self._settings.procedure.prove_s
        self._stage.enter(Phase.PROVE)
        self._loop.idle(level)
        started_s = vehicle.link.autopilot_time_s

        def proven() -> bool:
            now_s = vehicle.link.autopilot_time_s
            return now_s - started_s >= lasts_s and (not self._pilot_arms or self._pilot.lets_go(now_s))

        vehicle.until(proven, self._settings.procedure.pilot_timeout_s, "sticks that are left alone")

    def _engage_armed(self, level: Vector) -> None:
        """The pilot arms first: neither autopilot takes the gesture of the sticks in our mode, and it moves the sticks.

        An autopilot disarms by itself what stands armed for too long (COM_DISARM_PRFLT, DISARM_DELAY): then again.
        """
        vehicle, armed = self._vehicle, False
        while not armed:
            self._stage.enter(Phase.ARM)
            self._loop.stop()
            self._reporter.say("waiting for the pilot to arm (--arm lets the companion do it)")
            timeout_s = self._settings.procedure.pilot_timeout_s
            vehicle.until(lambda: vehicle.status.armed, timeout_s, "the pilot's arming")
            self._prove(level)
            self._stage.enter(Phase.ENGAGE)
            armed = vehicle.status.armed and self._engage()
            if not armed:
                self._reporter.say("disarmed before our mode began")
        self._armed_by_now = True

    def _engage(self) -> bool:
        """Our mode; False where the pilot arms, and the vehicle is disarmed before it begins."""
        vehicle, pilot_arms = self._vehicle, self._pilot_arms and not self.begins_in_air

        def external() -> bool:
            return vehicle.is_ours

        if self._request.wait_for_offboard:
            self._reporter.say("waiting for the pilot to switch to offboard")
            vehicle.until(
                lambda: external() or (pilot_arms and not vehicle.status.armed),
                self._settings.procedure.pilot_timeout_s,
                "the pilot's mode switch",
            )
            if not external():
                return False
        else:
            for _ in range(3):
                result = vehicle.command(vehicle.adapter.mode(Intent.EXTERNAL), enough=external)
                try:
                    vehicle.until(external, 2.5)
                    break
                except WaitedTooLong:
                    continue
            else:
                raise Refused(
                    f"the autopilot did not change to our mode ({vehicle.result_word(result)}; it is in "
                    f"{vehicle.adapter.mode_name(vehicle.status.custom_mode)})" + self._vehicle.last_texts()
                )
        self._stage.engaged = True
        self._pilot.sticks_are_at_rest()
        return True

    def _arm(self) -> None:
        """We arm, in our mode."""
        vehicle = self._vehicle
        result: int | None = None
        for _ in range(10):
            if not vehicle.status.armed:
                result = vehicle.command(ARM, enough=lambda: vehicle.status.armed)
            try:
                vehicle.until(lambda: vehicle.status.armed, 1.5)
                self._armed_by_now = True
                return
            except WaitedTooLong:
                continue
        raise Refused(
            f"the autopilot did not arm ({vehicle.result_word(result)})" + self._vehicle.last_texts()
        )

    # In the air ----------------------------------------------------------------------------------------

    def _follow_plan(self) -> None:
        assert self._stage.plan is not None
        loop, plan = self._loop, self._stage.plan
        for number in range(len(plan.legs)):
            leg = plan.legs[
                number
            ]  # as it is by then: where references end early, those behind it are planned anew
            self._stage.enter(leg.phase)
            if leg.phase in (Phase.RUN_IN, Phase.TRACK):
                self._use_measured(loop, self._vehicle.link.autopilot_time_s)
            tracking = leg.phase is Phase.TRACK
            if tracking:
                self._recorder.log.event("tracking", self._vehicle.link.autopilot_time_s, active=True)
                self._take_turns(leg.start_s)
            end_s = leg.start_s + leg.duration_s
            if tracking and self._live is not None:
                self._follow_references(self._live, plan, leg)
            else:
                self._vehicle.until(lambda end_s=end_s: bool(loop.held) or loop.plan_time_s >= end_s)  # type: ignore[misc]
            if tracking:
                self._recorder.log.event("tracking", self._vehicle.link.autopilot_time_s, active=False)
            if loop.held:
                self._stage.enter(Phase.HOLD)
                self._reporter.say(f"holding: {loop.held}")
                self._vehicle.until(lambda: False)  # until the supervisor, the pilot or the user ends it

    def _take_turns(self, start_s: float) -> None:
        """Let the laws of the schedule follow each other; returns when the last of them flies, or the plan is held."""
        loop, at_s = self._loop, start_s
        for (_, lasts_s), (name, _) in itertools.pairwise(self._request.schedule):
            at_s += lasts_s
            self._vehicle.until(lambda at_s=at_s: bool(loop.held) or loop.plan_time_s >= at_s)  # type: ignore[misc]
            if loop.held:
                return
            loop.fly_by(name)
            self._reporter.say(f"flying on with {name}")

    def _follow_references(self, live: LiveReferences, plan: FlightPlan, leg: Leg) -> None:
        """Track what another program asks for, until it ends or the time is over."""
        loop, home = self._loop, self._home
        limits = self._transit_limits(float(home.position_enu[2]))
        live.begin(leg, loop, home, limits)
        duration_s = self._request.duration_s
        self._vehicle.until(lambda: bool(loop.held) or live.is_over(leg, loop, duration_s))
        if not loop.held:
            live.leave(plan, leg, limits)

    # Watching ------------------------------------------------------------------------------------------

    def _watch(self) -> None:
        """Called before every message, and while there is none: the user's wish to stop, and the pilot's."""
        self._watchdog.beat()
        if self._live is not None and not self._stage.ending:
            self._live.hear()
        if self._interrupts.count > self._answered_interrupts:
            self._answered_interrupts = self._interrupts.count
            if self._interrupts.count > 1:
                raise HandedBack("interrupted again: handed back to the autopilot at once")
            raise Interrupted("by Ctrl-C or SIGTERM")
        vehicle = self._vehicle
        if self._stage.ending:
            if self._stage.loop is not None:
                self._stage.loop.check_absence()
            return
        if self._stage.phase in _STANDING and self._standing_counts:
            self._judge_standing()
        if not self._stage.engaged:
            return
        if not vehicle.is_ours:
            raise PilotTookOver(
                f"mode is now {vehicle.adapter.mode_name(vehicle.status.custom_mode)}, which we did not ask for: "
                "the pilot's wish, or the autopilot's own failsafe"
            )
        if self._armed_by_now and not vehicle.status.armed:
            raise PilotTookOver("disarmed in flight" if self._stage.airborne else "disarmed")
        if moved := self._pilot.moved_sticks():
            self._handed_over_s = vehicle.link.autopilot_time_s
            self._stage.nobody_has_it, self._stage.sticks_moved = self._nobody_has_it, True
            raise PilotTookOver(f"sticks moved: {moved}")
        self._watch_transmitter()
        if self._watchdog.tripped:
            stood_s = self._watchdog.longest_s
            self._watchdog.reset()
            raise Aborted(
                f"the control loop stood still for {stood_s:.2f} s, limit {self._watchdog.limit_s:g} s"
            )
        self._loop.check_absence()

    def _watch_transmitter(self) -> None:
        """A lost transmitter is no pilot: said, and landed or flown on with as set."""
        now_s, safety = self._vehicle.link.autopilot_time_s, self._settings.safety
        lost = self._pilot.lost_transmitter(now_s)
        if bool(lost) == self._transmitter_lost:
            return
        self._transmitter_lost = bool(lost)
        text = f"RC lost: {lost}" if lost else "RC is back"
        self._recorder.log.event("rc", now_s, lost=bool(lost), text=text)
        if lost and safety.rc_lost == "land":
            raise Aborted(f"{text} (flight.safety.rc_lost is land)")
        self._reporter.say(f"{text}; flying on" if lost else text)

    def _nobody_has_it(self) -> str:
        """Why nobody has the vehicle although it was handed over to the sticks; empty where somebody has."""
        vehicle, now_s = self._vehicle, self._vehicle.link.autopilot_time_s
        if not any(
            vehicle.adapter.is_mode(vehicle.status.custom_mode, intent)
            for intent in (Intent.EXTERNAL, Intent.HOLD)
        ):
            return ""
        if lost := self._pilot.lost_transmitter(now_s):
            return f"RC lost since: {lost}"
        waited_s = now_s - max(self._handed_over_s, self._pilot.alive_s)
        if waited_s < self._settings.safety.hand_over_s:
            return ""
        return f"nobody has chosen a mode or moved a stick for {waited_s:.0f} s"

    def _require_standing(self) -> None:
        """From here on, until thrust rises, only what is known to be on the ground goes on. Raises Refused."""
        vehicle = self._vehicle
        with suppress(WaitedTooLong):
            vehicle.until(lambda: vehicle.on_ground is not None, LANDED_STATE_HOLDS_S)
        self._standing_counts = True
        self._judge_standing()

    def _judge_standing(self) -> None:
        """Idle setpoints stop the motors, and whatever flies falls: landing, holding, or not saying which it is.

        Raises:
            HandedBack: it flies in our mode.
            Refused: it flies in another, or does not say that it stands.
        """
        vehicle, engaged = self._vehicle, self._stage.engaged
        if vehicle.on_ground:
            return
        if vehicle.on_ground is None:
            raise Refused(
                "the autopilot does not say whether the vehicle is on the ground (EXTENDED_SYS_STATE), and "
                "a flight begins there: is that stream passed on by what lies between?"
            )
        if engaged and vehicle.status.armed:
            raise HandedBack("the vehicle was in the air when our mode began, and idle setpoints let it fall")
        raise Refused("the vehicle is flying; a flight begins on the ground, with --wait-for-offboard too")

    def _on_message(self, message: Message) -> None:
        if message.get_msgId() == _RC_CHANNELS:
            vehicle = self._vehicle
            self._pilot.take(message, vehicle.link.autopilot_time_s, vehicle.status.receiver_healthy)
        self._journal.take(message)

    # Afterwards ------------------------------------------------------------------------------------------

    def _put_parameters_back(self, result: FlightResult) -> None:
        """As they were, where the vehicle is down and hears us; said where they stay changed."""
        changes = vars(self._preflight).get("changes")  # none where the flight did not get so far
        if changes is None or not changes.pending():
            return
        if result.outcome is not Outcome.LINK_LOST and not self._vehicle.status.armed:
            self._vehicle.watch = lambda: None
            with suppress(FlightEnd):  # the link may be lost meanwhile, which the last words say
                changes.put_back()
        if words := changes.in_words():
            self._reporter.say(f"warning: {words}")


def lowest_m(trajectory: Trajectory, duration_s: float) -> float:
    """The lowest z of a trajectory over its first `duration_s`, m."""
    times = np.linspace(0.0, min(duration_s, trajectory.duration_s), LOWEST_SAMPLES)
    return min(float(trajectory.sample(float(time_s)).position_enu[2]) for time_s in times)
