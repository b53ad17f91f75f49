"""A whole flight put together: link, log, control law, flight. What `companion fly` and `companion compare` call."""

from __future__ import annotations

import importlib.metadata
import json
import platform
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import numpy as np

from companion.autopilot.adapter import Finding, Intent, Verdict
from companion.autopilot.attitude_response import AttitudeResponseMeter
from companion.autopilot.drag import DragMeter
from companion.autopilot.hover_thrust import HoverThrustEstimator
from companion.autopilot.thrust import ThrustScale, mixer_of
from companion.config.provenance import Known, as_text, is_given
from companion.config.settings import Settings
from companion.control.law import ControlLaw
from companion.control.laws import AUTOPILOT, LAWS
from companion.control.prediction import Predictor
from companion.control.registry import build_law
from companion.control.structs import ControlLevel, Vector
from companion.flight import realtime
from companion.flight.control_loop import ControlLoop
from companion.flight.engagement import FlightFromAir
from companion.flight.flight import NO_POSITIONS, Flight
from companion.flight.known_vehicle import KnownVehicle
from companion.flight.outcome import Refused
from companion.flight.phases import Phase
from companion.flight.plan import FlightPlan
from companion.flight.preflight import GOOD_TO_HAVE_HZ, Preflight
from companion.flight.recorder import Recorder
from companion.flight.reporter import Reporter
from companion.flight.setpoint_gate import SetpointGate
from companion.flight.stage import FlightRequest, FlightResult, Interrupts
from companion.flight.standby import ENGAGE_PORT, Standby, StandbyFlight, Wishes
from companion.flight.vehicle import Vehicle
from companion.flightlog.law_channels import LATER_SETTINGS, LAW_TEXT
from companion.flightlog.writer import FlightLog
from companion.live.trajectory import LiveTrajectory, trajectory_or_live
from companion.mavlink.bandwidth import LinePlan, describe, plan_line
from companion.mavlink.connection import Connection
from companion.mavlink.link import mav
from companion.mavlink.outside_poses import DEFAULT_RATE_HZ, OutsidePoses
from companion.reference.feasibility import VehicleLimits, check_feasibility
from companion.reference.trajectory import Frame, Trajectory

_PACKAGES = ("dtlannc-companion", "numpy", "numba", "pymavlink", "mcap")


AnyFlight = TypeVar("AnyFlight", bound=Flight)


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """What a flight needs beside its settings."""

    connection: Connection
    log_path: Path
    overwrite: bool = False
    may_arm: bool = False
    fix: bool = False
    wait_for_offboard: bool = False
    from_air: bool = False  # the vehicle hovers already, under its pilot or its autopilot
    then: Intent = Intent.LAND  # what the autopilot is asked for once the plan is flown
    real_time: bool = True  # ask for real-time scheduling; a simulation in lockstep has no use for it
    command_line: str = ""
    outside_poses: tuple[str, int] | None = None  # host, port to hear poses at that are forwarded as ODOMETRY
    pose_rate_hz: float = DEFAULT_RATE_HZ  # at most so many of them
    schedule: tuple[
        tuple[str, float], ...
    ] = ()  # laws that take turns while tracking, s each; the first flies before
    law_text: str = ""  # of a law of one's own, for the log
    engage_port: int = ENGAGE_PORT  # `stand_by` hears `companion engage` there


MakeFlight = Callable[[type[AnyFlight]], AnyFlight]
"""Makes a flight of one kind over the connection that is open."""


def fly(settings: Settings, options: SessionOptions, reporter: Reporter) -> FlightResult:
    """Fly once, log it, and say how it ended.

    Raises:
        UserError: the flight could not begin for a reason that the user can mend.
    """
    kind = FlightFromAir if options.from_air else Flight

    def once(_vehicle: Vehicle, make: MakeFlight[Flight], _interrupts: Interrupts) -> FlightResult:
        return make(kind).run()

    names = dict.fromkeys((settings.flight.controller, *(name for name, _ in options.schedule)))
    return _connected(settings, options, reporter, once, tuple(names))


def stand_by(settings: Settings, options: SessionOptions, reporter: Reporter) -> FlightResult:
    """Engage each time somebody switches to our mode, until Ctrl-C; all of it in one log.

    Raises:
        UserError: it could not begin for a reason that the user can mend.
    """
    wishes = Wishes(options.engage_port)

    def again(vehicle: Vehicle, make: MakeFlight[StandbyFlight], interrupts: Interrupts) -> FlightResult:
        return Standby(vehicle, make, reporter, interrupts, wishes).run()

    names = dict.fromkeys((settings.flight.controller, *LAWS, AUTOPILOT))
    try:
        return _connected(settings, options, reporter, again, tuple(names))
    finally:
        wishes.close()


def _connected(
    settings: Settings,
    options: SessionOptions,
    reporter: Reporter,
    run: Callable[[Vehicle, Any, Interrupts], FlightResult],
    controllers: tuple[str, ...],
) -> FlightResult:
    """`run` over a connection of its own, with a log, all that compiles compiled: `controllers` are built."""
    settings, plan = _fitted(settings, options.connection, reporter)
    trajectory = trajectory_or_live(settings.flight.trajectory)
    for name in controllers:
        _law(settings, name, None).warm_up()  # seconds, so before anybody is listening to us
    Predictor(settings.profile, settings.level)
    try:
        if options.real_time:
            for line in realtime.prepare():
                reporter.say(line)
        else:
            realtime.steady_interpreter()
        return _fly(settings, options, reporter, trajectory, plan, run, controllers)
    finally:
        realtime.restore()


def _fly(
    settings: Settings,
    options: SessionOptions,
    reporter: Reporter,
    trajectory: Trajectory,
    plan: LinePlan | None,
    run: Callable[[Vehicle, Any, Interrupts], FlightResult],
    controllers: tuple[str, ...],
) -> FlightResult:
    poses = OutsidePoses(options.outside_poses, options.pose_rate_hz) if options.outside_poses else None
    live = trajectory if isinstance(trajectory, LiveTrajectory) else None
    if live is not None:
        live.open()
    link = options.connection.open(reporter.say)
    try:
        with FlightLog(
            options.log_path,
            metadata={"controller": settings.flight.controller, "level": settings.level.value},
            attachments=_attachments(settings, options),
            overwrite=options.overwrite,
        ) as log:
            log.metadata("versions", _versions())
            log.metadata("wall", _wall(options))
            recorder = Recorder(log)
            link.tap = recorder.frame
            vehicle = Vehicle(link, settings.flight.safety.silence_s)
            vehicle.address = str(options.connection.endpoint)
            vehicle.on_notice = _notices(vehicle, recorder, reporter)
            vehicle.outside_poses = poses
            request = FlightRequest(
                level=settings.level,
                trajectory=trajectory,
                frame=Frame.LOCAL if live is not None and live.is_mavlink else Frame(settings.flight.layout),
                duration_s=settings.flight.duration_s,
                may_arm=options.may_arm,
                fix=options.fix,
                wait_for_offboard=options.wait_for_offboard,
                then=options.then,
                schedule=options.schedule,
            )

            known = KnownVehicle(settings, reporter)

            told: list[str] = []

            def make_loop(heard: Vehicle) -> ControlLoop:
                tables = json.dumps(known.settings.as_tables(), indent=1, sort_keys=True)
                if told != [tables]:
                    name = (
                        f"{LATER_SETTINGS}{heard.link.autopilot_time_s:.6f}.json" if told else "settings.json"
                    )
                    told[:] = [tables]
                    log.attach(name, tables)
                    log.metadata("vehicle", {row.key: as_text(row) for row in known.provenance()})
                return _control_loop(known.settings, heard, recorder, reporter, controllers)

            def check_plan(plan: FlightPlan, ground_m: float) -> None:
                _check_plan(known.settings, plan, ground_m)

            def use_measured(loop: ControlLoop, time_s: float) -> None:
                _use_measured(known, loop, log, reporter, time_s)

            preflight = _preflight(known, vehicle, reporter, plan)
            with _signals(Interrupts()) as interrupts:

                def make(kind: type[AnyFlight]) -> AnyFlight:
                    return kind(
                        vehicle,
                        request,
                        settings.flight,
                        recorder,
                        preflight,
                        reporter,
                        interrupts,
                        make_loop,
                        check_plan,
                        use_measured,
                    )

                result = run(vehicle, make, interrupts)
            if poses is not None:
                _tell_poses(poses, vehicle)
            return result
    finally:
        link.close()
        if poses is not None:
            poses.close()
        if live is not None:
            live.close()


def check(
    settings: Settings,
    connection: Connection,
    reporter: Reporter,
    fix: bool = False,
    outside_poses: tuple[str, int] | None = None,
    restore: bool = False,
) -> tuple[list[Finding], list[tuple[str, float, float]], list[Known]]:
    """Look at everything a flight with these settings depends on; change nothing, unless `fix` or `restore`.

    Poses that arrive at `outside_poses` (host, port) are forwarded meanwhile, as in a flight, and looked at, too.
    Returns the findings, what was set for good (name, value before, value now), and the vehicle's numbers that would fly.

    Raises:
        UserError: nobody there.
        FlightEnd: the link broke off.
    """
    settings, plan = _fitted(settings, connection, reporter)
    poses = OutsidePoses(outside_poses) if outside_poses else None
    link = connection.open(reporter.say)
    try:
        vehicle = Vehicle(link, settings.flight.safety.silence_s)
        vehicle.outside_poses = poses
        vehicle.on_notice = reporter.say
        vehicle.address = str(connection.endpoint)
        vehicle.connect(settings.flight.procedure.connect_timeout_s)
        reporter.say(f"{vehicle.firmware}, system {link.target_system}")
        known = KnownVehicle(settings, reporter)
        preflight = _preflight(known, vehicle, reporter, plan)
        preflight.ask_for_streams()
        ground = preflight.ground_finding()
        findings = [ground, *preflight.parameter_findings()]
        if ground.verdict is Verdict.OK:  # of a vehicle that flies, or does not say, nothing is touched
            if restore:
                preflight.changes.put_back()
            if fix:
                findings = [ground, *preflight.fix(findings, for_good=True)]
        elif fix or restore:
            reporter.say("no parameter is set: the vehicle is not known to be on the ground")
        findings += preflight.change_findings()
        with suppress(Refused):  # what is missing then is among the findings
            preflight.wait_until_ready()
        measured = preflight.measure()
        findings += [*preflight.link_findings(measured), *preflight.vehicle_findings()]
        return findings, preflight.changed, known.provenance()
    finally:
        link.close()
        if poses is not None:
            poses.close()


def _preflight(known: KnownVehicle, vehicle: Vehicle, reporter: Reporter, plan: LinePlan | None) -> Preflight:
    share = plan.spare_share if plan is not None else 1.0
    return Preflight(vehicle, known, reporter, share)


def _fitted(
    settings: Settings, connection: Connection, reporter: Reporter
) -> tuple[Settings, LinePlan | None]:
    """Settings whose rates the line can carry. Raises UserError where none would do."""
    wished_hz = settings.flight.rate_hz
    spare = {**GOOD_TO_HAVE_HZ, mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 5.0}
    signed = connection.signing_key is not None
    plan = plan_line(connection.endpoint, wished_hz, settings.level.minimum_rate_hz, spare, signed)
    if plan is None:
        return settings, None
    reporter.say(describe(plan, wished_hz))
    flight = settings.flight.model_copy(update={"control_rate_hz": plan.rate_hz})
    return replace(settings, flight=flight), plan


def _control_loop(
    settings: Settings,
    vehicle: Vehicle,
    recorder: Recorder,
    reporter: Reporter,
    controllers: tuple[str, ...],
) -> ControlLoop:
    """Build everything that depends on which autopilot it is, and warm it up; the first of `controllers` flies first."""
    profile, adapter = settings.profile, vehicle.adapter
    names = [name for name in controllers if name != AUTOPILOT or adapter.takes_positions]
    laws = {name: _law(settings, name, adapter.profile_key) for name in names}
    if controllers[0] not in laws:
        raise Refused(NO_POSITIONS)
    law = laws[controllers[0]]
    for warning in law.warnings:
        reporter.say(f"warning: {warning}")
        recorder.log.event("warning", vehicle.link.autopilot_time_s, text=warning)
    if law.warnings and settings.flight.safety.unproven == "refuse":
        raise Refused(f"{law.warnings[0]}; change the gains, or fly with flight.safety.unproven=warn")
    hover = vehicle.parameters.values.get(adapter.hover_thrust_parameter, profile.hover_thrust)
    arms = profile.rotors.arms_m
    thrust = ThrustScale(
        hover_thrust=hover,
        mass_kg=profile.mass_kg,
        rotor_max_newton=profile.rotors.thrust_max_newton,
        least=profile.limits.thrust_min_ratio,
        most=profile.limits.thrust_max_ratio,
        mixer=mixer_of(np.column_stack((arms, np.zeros(len(arms)))), profile.rotors.spins),
    )
    recorder.define_law(law.hidden)
    recorder.log.metadata(
        "flight",
        {
            "controller": law.name,
            "level": law.level.value,
            "firmware": vehicle.firmware,
            "profile": profile.name,
            "mass_ratio": profile.mass_ratio,
            "seed": law.seed,
            "trajectory": settings.flight.trajectory,
        },
    )
    recorder.log.metadata("parameters", vehicle.parameters.values)
    predictor = Predictor(profile, settings.level, adapter.profile_key)
    gate = SetpointGate(np.radians(profile.limits.body_rate_max_deg_s))
    response = profile.response(adapter.profile_key)
    estimator = HoverThrustEstimator(
        hover, response.thrust_dead_time(settings.level), profile.rotors.lag_rad_s
    )
    loop = ControlLoop(vehicle, law, predictor, thrust, estimator, settings.flight, recorder, gate, laws)
    given = settings.given
    if given is not None:  # what somebody wrote is flown as it is
        answers = settings.level is ControlLevel.ATTITUDE and not is_given(
            given, f"responses.{adapter.profile_key}"
        )
        drags = settings.level is not ControlLevel.ACTUATOR and not is_given(given, "drag_kg_s")
        loop.measure(
            AttitudeResponseMeter(response.dead_time_s, response.tilt) if answers else None,
            DragMeter() if drags else None,
        )
    return loop


def _use_measured(
    known: KnownVehicle, loop: ControlLoop, log: FlightLog, reporter: Reporter, time_s: float
) -> None:
    """Fly on by the response that was measured, where it is known well enough and is another one; said and logged."""
    drag = loop.measured_drag()
    if drag is not None:
        log.event("drag", time_s, drag_1_s=drag[0], deviation=drag[1])
        reporter.say(f"measured: slowed down by {drag[0]:.2f} ± {drag[1]:.2f} m/s² for each m/s")
    measured = loop.measured()
    if measured is None or not measured.sure:
        return
    before = known.profile.response(known.autopilot)
    if before.dead_time_s == measured.dead_time_s and before.tilt == measured.tilt:
        return
    if not known.measured(measured):
        return
    settings = known.settings
    assert known.autopilot is not None
    from_s = loop.controlled_until_s
    loop.laws = {name: _law(settings, name, known.autopilot) for name in loop.laws}
    loop.change_law(loop.laws[loop.law.name], settings.profile, known.autopilot)
    log.attach(
        f"{LATER_SETTINGS}{from_s:.6f}.json", json.dumps(settings.as_tables(), indent=1, sort_keys=True)
    )
    log.metadata("vehicle", {row.key: as_text(row) for row in known.provenance()})
    total_s = measured.dead_time_s + measured.tilt.lag_s
    log.event(
        "response",
        time_s,
        dead_time_s=measured.dead_time_s,
        natural_frequency_rad_s=measured.tilt.natural_frequency_rad_s,
        damping=measured.tilt.damping,
        deviation=measured.deviation,
    )
    reporter.say(
        f"measured: attitude answers within {total_s:.2f} s ± {100 * measured.deviation:.0f} %, "
        f"{measured.dead_time_s:.2f} of it dead time; until now {before.dead_time_s + before.tilt.lag_s:.2f} s"
    )


def _law(settings: Settings, name: str, autopilot: str | None) -> ControlLaw:
    gains, seed = settings.gains_of(name), settings.flight.seed
    return build_law(name, gains, settings.profile, settings.level, seed, autopilot=autopilot)


def _check_plan(settings: Settings, plan: FlightPlan, ground_m: float) -> None:
    """Refuse a trajectory that the vehicle cannot fly, before anything is armed (UserError)."""
    profile, leg = settings.profile, plan.leg(Phase.TRACK)
    arm_m = float(np.max(np.abs(profile.rotors.arms_m)))
    torque = profile.rotors.thrust_max_newton * arm_m
    acceleration: Vector = torque / np.asarray(profile.inertia_kg_m2)
    rates = np.radians(profile.limits.body_rate_max_deg_s)
    limits = VehicleLimits(
        mass_kg=profile.mass_kg,
        thrust_min_newton=profile.limits.thrust_min_ratio * profile.thrust_available_newton,
        thrust_max_newton=profile.limits.thrust_max_ratio * profile.thrust_available_newton,
        tilt_max_rad=profile.tilt_max_rad,
        body_rate_max_rad_s=tuple(rates.tolist()),
        angular_acceleration_max_rad_s2=tuple(acceleration.tolist()),
        height_min_m=ground_m + 0.1,
        height_max_m=ground_m + settings.flight.safety.fence.height_max_m,
    )
    # what is told in flight is checked as it comes
    check_feasibility(leg.trajectory, limits, leg.moves_s).require(settings.flight.trajectory)


@contextmanager
def _signals(interrupts: Interrupts) -> Iterator[Interrupts]:
    """Ctrl-C and SIGTERM ask the flight to stop; a closed terminal (SIGHUP) is none of its business.

    Nor are Ctrl-Z and a terminal that stops whoever writes from the background (`stty tostop`): a stopped process would
    leave its last setpoint standing.
    """

    def ask(_signal: int, _frame: FrameType | None) -> None:
        interrupts.ask(time.monotonic())

    wanted: dict[signal.Signals, Callable[[int, FrameType | None], None] | signal.Handlers] = {
        signal.SIGINT: ask,
        signal.SIGTERM: ask,
        signal.SIGHUP: signal.SIG_IGN,
        signal.SIGTSTP: signal.SIG_IGN,
        signal.SIGTTOU: signal.SIG_IGN,
    }
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    try:
        yield interrupts
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _attachments(settings: Settings, options: SessionOptions) -> dict[str, str]:
    """What repeating a step takes: the settings, and a law of one's own."""
    kept = {"settings.json": json.dumps(settings.as_tables(), indent=1, sort_keys=True)}
    return kept | {LAW_TEXT: options.law_text} if options.law_text else kept


def _wall(options: SessionOptions) -> dict[str, str]:
    """What of this flight is this run's, not the vehicle's."""
    return {
        "endpoint": str(options.connection.endpoint),
        "link": options.connection.library.value,
        "command": options.command_line,
    }


def _notices(vehicle: Vehicle, recorder: Recorder, reporter: Reporter) -> Callable[[str], None]:
    def tell(text: str) -> None:
        reporter.say(text)
        recorder.log.event("link", vehicle.link.autopilot_time_s, text=text)

    return tell


def _tell_poses(poses: OutsidePoses, vehicle: Vehicle) -> None:
    counts = ", ".join(f"{count} {what}" for what, count in sorted(poses.counters.items()))
    vehicle.on_notice(f"poses from outside: {counts or 'none came'}")


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version(), "machine": f"{sys.platform} {platform.machine()}"}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions
