"""Everything that is looked at before a flight, in one place: `companion check` shows it, `companion fly` acts on it.

Nothing is changed but message rates, which the autopilot forgets at its next start; parameters only by `fix`.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass

from companion.autopilot.adapter import Finding, Verdict
from companion.control.structs import ControlLevel
from companion.flight.changed_parameters import ChangedParameters
from companion.flight.known_vehicle import KnownVehicle
from companion.flight.outcome import Refused, WaitedTooLong
from companion.flight.pose_findings import pose_findings
from companion.flight.reporter import Reporter
from companion.flight.sources import Blind, blind, blind_findings
from companion.flight.supervisor import tilt_of
from companion.flight.vehicle import LANDED_STATE_HOLDS_S, Vehicle
from companion.mavlink.bandwidth import POSITION_RATE_HZ, spare_rate
from companion.mavlink.frames import angle_between, attitude_from_euler_ned
from companion.mavlink.link import Message, mav
from companion.mavlink.protocol import message_interval, request_message
from companion.mavlink.stream_timing import STATE_STREAMS, StreamFigures, in_words

MEASURE_S = 1.0
HEARD_WITHIN_S = 5.0
"""What was not heard after so long is not waited for; none is asked for at less than 5 Hz."""
_SHARE_WARNED = 0.8  # of a stream's rate asked for
_ROUND_TRIP_WARNED_S, _ROUND_TRIP_REFUSED_S = 0.05, 0.15
_AGE_WARNED_S = 0.05  # of a stream's 95 %
_LOSS_WARNED, _LOSS_REFUSED = 0.01, 0.2
_BATTERY_WARNED, _BATTERY_REFUSED = 0.35, 0.15  # the flight itself ends at limits.battery_remaining
_HOVER_MISMATCH = 0.25
_STANDING_TILT_DEG = 30.0  # a lift-off is given up at flight.safety.lift_off_tilt_deg, 20° as it ships
_APART_WARNED_DEG, _APART_REFUSED_DEG = 5.0, 20.0  # both are of one estimate, a few milliseconds apart

GOOD_TO_HAVE_HZ = {
    mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: 50.0,
    mav.MAVLINK_MSG_ID_HEARTBEAT: 10.0,  # nothing else says that the vehicle was disarmed
    mav.MAVLINK_MSG_ID_SYS_STATUS: 5.0,
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
    mav.MAVLINK_MSG_ID_CURRENT_MODE: 20.0,
    mav.MAVLINK_MSG_ID_RC_CHANNELS: 10.0,
}
"""Messages a flight can do with fewer of, Hz; beside them the simulator's truth and the estimator's flags."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What the link delivered while it was watched."""

    state_rate_hz: float
    position_rate_hz: float
    round_trip_s: float  # nan where TIMESYNC was not answered; a simulation's in its own time
    loss_ratio: float
    streams: tuple[StreamFigures, ...]  # each one's rate, jitter and age


class Preflight:
    """The checks of one vehicle for one level of control."""

    def __init__(
        self,
        vehicle: Vehicle,
        known: KnownVehicle,
        reporter: Reporter,
        spare_share: float = 1.0,
    ) -> None:
        """`spare_share`: how much of the messages that are only good to have the line carries (`LinePlan`)."""
        self._spare_share = spare_share
        self._vehicle = vehicle
        self._known = known
        self._level = known.settings.level
        self._settings = known.settings.flight
        self._rate_hz = self._settings.rate_hz
        self._reporter = reporter
        self._attitude: Message | None = None  # the newest ATTITUDE, where the autopilot sends it
        self.changed: list[tuple[str, float, float]] = []  # name, value before, value set

    def ask_for_streams(self) -> None:
        """Ask for what a flight needs, and for what is good to have in its log."""
        vehicle = self._vehicle
        for message_id, rate in self._needed_hz.items():
            if not vehicle.ask_for_stream(message_id, rate):
                self._reporter.say(
                    f"the autopilot refused message {message_id} at {rate:g} Hz; using what it sends"
                )
        wished = {
            **GOOD_TO_HAVE_HZ,
            vehicle.adapter.truth_message_id: 50.0,
            vehicle.adapter.estimator_message_id: 5.0,
        }
        for message_id, rate in wished.items():
            # a refusal is an answer too
            vehicle.command(message_interval(message_id, spare_rate(rate, self._spare_share)))
        vehicle.command(request_message(mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN))

    @property
    def _needed_hz(self) -> dict[int, float]:
        return {
            mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: min(self._rate_hz, POSITION_RATE_HZ),
            mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._rate_hz,
        }

    def ask_again(self) -> None:
        """Ask for the same without waiting for an answer: somebody else on the link has asked for other rates."""
        for message_id, rate in {**self._needed_hz, **GOOD_TO_HAVE_HZ}.items():
            share = 1.0 if message_id in self._needed_hz else self._spare_share
            self._vehicle.commands.send(message_interval(message_id, spare_rate(rate, share)))

    def parameter_findings(self) -> list[Finding]:
        """Read the parameters that matter and judge them."""
        vehicle = self._vehicle
        vehicle.read_parameters(vehicle.adapter.parameters_needed())
        values = vehicle.parameters.values
        if vehicle.outside_poses is not None:
            vehicle.read_parameters(vehicle.adapter.pose_parameters)
            vehicle.poses_are_used = vehicle.adapter.uses_poses(values)
        vehicle.adapter = vehicle.adapter.suited(values)
        self._known.learn(vehicle)
        profile = self._known.profile
        findings = vehicle.adapter.check(values, self._level, vehicle.version)
        cut_deg, asked_deg = vehicle.adapter.tilt_limit_deg(values), profile.limits.tilt_max_deg
        if self._level is ControlLevel.ATTITUDE and cut_deg < asked_deg:
            findings.append(
                Finding(
                    Verdict.WARNING,
                    "tilt limit",
                    f"{cut_deg:g}°, profile {profile.name!r} asks for up to {asked_deg:g}°",
                    "the autopilot cuts our attitude there, and the law does not know",
                    "set ANGLE_MAX (ATC_ANGLE_MAX) higher, or fly with "
                    f"--set profile.limits.tilt_max_deg={cut_deg:g}",
                )
            )
        hover = values.get(vehicle.adapter.hover_thrust_parameter)
        if hover is not None and abs(hover / profile.hover_thrust - 1.0) > _HOVER_MISMATCH:
            findings.append(
                Finding(
                    Verdict.WARNING,
                    "hover thrust",
                    f"{hover:.3f}, profile {profile.name!r} says {profile.hover_thrust:.3f}",
                    "is this the profile of this vehicle? Thrust in newtons is scaled by the autopilot's value",
                    "choose another --profile, or correct hover_thrust in it",
                )
            )
        return [*findings, *self._known.doubts(vehicle)]

    def fix(self, findings: list[Finding], *, for_good: bool) -> list[Finding]:
        """Set what is safe to set, for this flight or for good, note it in `changed`, and judge again.

        Raises UserError where old values cannot be kept on disk.
        """
        vehicle = self._vehicle
        how_long = "for good" if for_good else "for this flight"
        for finding in findings:
            if finding.fix is None:
                continue
            name, value = finding.fix
            before = vehicle.parameters.values[name]
            if vehicle.set_parameter(name, value) if for_good else self.changes.set(name, value):
                self.changed.append((name, before, value))
                self._reporter.say(f"set {name} from {before:g} to {value:g} {how_long}")
        return self.parameter_findings()

    @functools.cached_property
    def changes(self) -> ChangedParameters:
        """What has been changed for a flight, this one or one before. Raises UserError for a damaged note of it."""
        return ChangedParameters(self._vehicle, self._reporter.say)

    def ground_finding(self) -> Finding:
        """Whether it stands on the ground, where a flight begins and parameters may be set (EXTENDED_SYS_STATE)."""
        vehicle = self._vehicle
        with suppress(WaitedTooLong):
            vehicle.until(lambda: vehicle.on_ground is not None, LANDED_STATE_HOLDS_S)
        if vehicle.on_ground:
            return Finding(Verdict.OK, "landed state", "on the ground")
        if vehicle.on_ground is None:
            return Finding(
                Verdict.REFUSAL,
                "landed state",
                "not told",
                "a flight begins on the ground, and idle setpoints let a vehicle fall that flies",
                "is EXTENDED_SYS_STATE passed on by what lies between?",
            )
        return Finding(
            Verdict.REFUSAL, "landed state", "the vehicle flies", "a flight begins on the ground", "land it"
        )

    def change_findings(self) -> list[Finding]:
        """Parameters that an earlier flight left changed."""
        words = self.changes.in_words()
        return (
            [Finding(Verdict.WARNING, "parameters", words, "an earlier flight could not put them back")]
            if words
            else []
        )

    def wait_until_ready(self, timeout_s: float | None = None) -> float:
        """Wait until the autopilot can be armed and the state flows; return how long that took, its clock.

        `timeout_s`: None: as set.

        Raises:
            Refused: it does not get ready; says what is missing, in the autopilot's words too.
        """
        vehicle, started_s = self._vehicle, self._vehicle.link.autopilot_time_s
        timeout_s = self._settings.procedure.ready_timeout_s if timeout_s is None else timeout_s
        told: list[str] = []

        def ready() -> bool:
            nonlocal told
            reasons = self.not_ready()
            if vehicle.link.autopilot_time_s - started_s < HEARD_WITHIN_S:
                reasons += [
                    f"{item.source.message} not heard yet" for item in self._blind() if self._stops(item)
                ]
            if reasons and reasons != told:
                self._reporter.say("waiting: " + ", ".join(reasons))
            told = reasons
            return not reasons

        try:
            vehicle.until(ready, timeout_s, "getting ready")
        except WaitedTooLong:
            raise Refused(
                f"not ready after {timeout_s:.0f} s: {', '.join(told)}{vehicle.last_texts()}"
            ) from None
        return vehicle.link.autopilot_time_s - started_s

    def not_ready(self) -> list[str]:
        """What is missing now; empty when nothing is."""
        reasons = self._vehicle.adapter.not_ready(self._vehicle.status)
        if self._vehicle.state is None:
            reasons.append("no local position yet")
        return reasons

    def _blind(self) -> list[Blind]:
        vehicle = self._vehicle
        link, safety = vehicle.link, self._settings.safety
        return blind(vehicle.adapter, vehicle.status, link.timesync, safety, link.autopilot_time_s)

    def _stops(self, item: Blind) -> bool:
        return not item.heard and item.source.verdict(self._settings.safety) is Verdict.REFUSAL

    def measure(self) -> Measured:
        """Watch the link for a second of the autopilot's time. No setpoint goes out meanwhile."""
        vehicle = self._vehicle
        seen: Counter[int] = Counter()
        on_state, on_message = vehicle.on_state, vehicle.on_message

        def count(message: Message) -> None:
            kind = message.get_msgId()
            seen[kind] += 1
            if kind == mav.MAVLINK_MSG_ID_ATTITUDE:
                self._attitude = message
            on_message(message)

        vehicle.on_state, vehicle.on_message = lambda _: None, count
        started_s = vehicle.link.autopilot_time_s
        try:
            vehicle.until(
                lambda: vehicle.link.autopilot_time_s - started_s >= MEASURE_S, 5.0, "measuring streams"
            )
        except WaitedTooLong:
            raise Refused("no time-stamped messages arrive; is this the autopilot's own link?") from None
        finally:
            vehicle.on_state, vehicle.on_message = on_state, on_message
        span_s = vehicle.link.autopilot_time_s - started_s
        timesync = vehicle.link.timesync
        return Measured(
            seen[mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION] / span_s,
            seen[mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED] / span_s,
            timesync.round_trip_s if timesync.steady else timesync.autopilot_trip_s,
            vehicle.link.loss_ratio,
            tuple(vehicle.link.streams.figures()),
        )

    def link_findings(self, measured: Measured) -> list[Finding]:
        """Judge what was measured, for this level."""
        state_hz, wanted_hz, least_hz = measured.state_rate_hz, self._rate_hz, self._level.minimum_rate_hz
        rate = _graded(
            state_hz >= _SHARE_WARNED * wanted_hz,
            state_hz >= least_hz,
            "attitude stream",
            f"{state_hz:.0f} Hz of {wanted_hz:.0f}",
            f"level {self._level.value} needs {least_hz:.0f} Hz at least, and tracks better at {wanted_hz:.0f}",
            "raise the link's rate (PX4: MAV_n_RATE; serial: baud rate), or fly a higher level",
        )
        position_hz = measured.position_rate_hz
        position = _graded(
            position_hz >= 0.5 * min(wanted_hz, POSITION_RATE_HZ),
            position_hz >= 5.0,
            "position stream",
            f"{position_hz:.0f} Hz",
            "position is extrapolated by its velocity between messages",
            "raise the link's rate",
        )
        trip_s = measured.round_trip_s
        known = trip_s == trip_s
        trip = _graded(
            known and trip_s < _ROUND_TRIP_WARNED_S,
            not known or trip_s < _ROUND_TRIP_REFUSED_S,
            "round trip",
            f"{trip_s * 1e3:.1f} ms" if known else "TIMESYNC not answered",
            "setpoints act late by it" if known else "the link's delay is not known",
            "use a faster link" if known else "let the router between pass TIMESYNC (message 111)",
        )
        loss = _graded(
            measured.loss_ratio < _LOSS_WARNED,
            measured.loss_ratio < _LOSS_REFUSED,
            "lost frames",
            f"{measured.loss_ratio * 100:.2f} %",
            "counted by sequence numbers since connecting",
            "lower the rates, look at cable, antenna and baud rate",
        )
        return [rate, position, *self._stream_findings(measured), trip, loss, *self._signing_findings()]

    def _stream_findings(self, measured: Measured) -> list[Finding]:
        """How old each stream is when it arrives. A flight reacts to lateness itself; here it is a line to read."""
        return [
            _graded(
                not stream.age_95_s > _AGE_WARNED_S,
                True,
                f"delay of {stream.name}",
                in_words(stream),
                "the law sees the vehicle as it was then"
                if stream.message_id in STATE_STREAMS
                else "not used for control, so it only tells of the link",
                "use a faster link, or lower the rates on this one (MAV_n_RATE, SRn_*)",
            )
            for stream in measured.streams
        ]

    def _signing_findings(self) -> list[Finding]:
        link = self._vehicle.link
        if link.signer is None:
            return []
        refused = sum(link.refused.values())
        return [
            _graded(
                not refused,
                True,
                "signing",
                f"on, {refused} frames refused" if refused else "on",
                "somebody else speaks on this link: "
                + ", ".join(f"{count} frames {how}" for how, count in link.refused.items()),
                "find out who; they are not believed",
            )
        ]

    def vehicle_findings(self) -> list[Finding]:
        """Judge what the autopilot says of itself now: battery, estimator, pre-arm checks."""
        vehicle, status = self._vehicle, self._vehicle.status
        findings = [*blind_findings(self._blind(), self._settings.safety), *self._own_messages()]
        if status.battery_remaining is not None:
            findings.append(
                _graded(
                    status.battery_remaining >= _BATTERY_WARNED,
                    status.battery_remaining >= _BATTERY_REFUSED or self._vehicle.simulated,
                    "battery",
                    f"{status.battery_remaining * 100:.0f} %",
                    "a flight ends with what is left",
                    "charge it",
                )
            )
        reasons = self.not_ready()
        findings.append(
            Finding(Verdict.OK, "readiness", "ready" if vehicle.on_ground is not False else "flying")
            if not reasons
            else Finding(
                Verdict.REFUSAL, "readiness", ", ".join(reasons), "it would not arm", "wait, or mend it"
            )
        )
        if vehicle.outside_poses is not None:
            figures = vehicle.poses.figures(vehicle.link.autopilot_time_s)
            findings += pose_findings(vehicle.outside_poses, figures, vehicle.poses_are_used)
        return findings

    def _own_messages(self) -> list[Finding]:
        """Whether the autopilot's own messages are of one attitude, and that one a vehicle's that stands on the ground."""
        state, euler = self._vehicle.state, self._attitude
        if state is None:
            return []
        tilt_deg = math.degrees(tilt_of(state.quaternion_wxyz))
        findings = (
            []
            if self._vehicle.on_ground is False
            else [
                _graded(
                    tilt_deg <= _STANDING_TILT_DEG,
                    tilt_deg <= _STANDING_TILT_DEG,
                    "tilt on the ground",
                    f"{tilt_deg:.0f}°",
                    "no vehicle takes off like that: it has tipped over, or its attitude is in other axes",
                    "put it upright; else look at the autopilot's board orientation (SENS_BOARD_ROT, AHRS_ORIENTATION)",
                )
            ]
        )
        if euler is not None:
            other = attitude_from_euler_ned(euler.roll, euler.pitch, euler.yaw)
            apart_deg = math.degrees(angle_between(state.quaternion_wxyz, other))
            findings.append(
                _graded(
                    apart_deg <= _APART_WARNED_DEG,
                    apart_deg <= _APART_REFUSED_DEG,
                    "attitude messages",
                    f"ATTITUDE and ATTITUDE_QUATERNION are {apart_deg:.0f}° apart",
                    "one of the two is in other axes, and the law flies by ATTITUDE_QUATERNION",
                    "is a program between that changes messages? Connect to the autopilot itself",
                )
            )
        return findings


def require(findings: list[Finding]) -> None:
    """Raise Refused with every refusal among `findings`."""
    refusals = [f for f in findings if f.verdict is Verdict.REFUSAL]
    if refusals:
        raise Refused("; ".join(f"{f.subject} {f.found}: {f.why}: {f.remedy}" for f in refusals))


def _graded(good: bool, bearable: bool, subject: str, found: str, why: str, remedy: str) -> Finding:
    if good:
        return Finding(Verdict.OK, subject, found)
    return Finding(Verdict.WARNING if bearable else Verdict.REFUSAL, subject, found, why, remedy)
