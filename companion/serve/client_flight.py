"""One flight of a client's: the law takes over whenever the client streams setpoints in the air, and lets go again.

The vehicle is the client's: it arms, takes off, changes modes and lands as without us. While the autopilot is in its
external mode and points come that can be flown, the law flies them; whatever ends that, the autopilot has the client's
setpoints again, at once, and does with them what it would have done. Nothing here arms, lands or changes a mode.
"""

from __future__ import annotations

import math
import re
from contextlib import suppress

import numpy as np

from companion.config.safety import Reaction
from companion.control.structs import Reference, Vector
from companion.flight.control_loop import at_rest, yaw_of
from companion.flight.engagement import HOME_WAIT_S, Engagement
from companion.flight.fence import horizontal_margin
from companion.flight.flight import Flight
from companion.flight.outcome import FlightEnd, Interrupted, LinkLost, Outcome, PilotTookOver, WaitedTooLong
from companion.flight.phases import Phase
from companion.flight.pilot import Pilot
from companion.flight.plan import FlightPlan
from companion.flight.realtime import LoopWatchdog
from companion.flight.stage import FlightResult
from companion.flight.vehicle import HANDLED
from companion.live.course import reference_of, table_of
from companion.live.follower import LOOK_AHEAD_S, Follower
from companion.live.mavlink_points import Surroundings
from companion.live.offsets import Way, way_out
from companion.mavlink.link import Message, mav
from companion.mavlink.protocol import request_message
from companion.reference.trajectory import wrapped
from companion.serve.client_setpoints import LOST_S, ClientSetpoints

ABOVE_M = 1.0
"""Height above the place of take-off from which on the law takes over; lift-off and touch-down are the autopilot's."""
LOWEST_M = 0.5
"""Points lower than this are the autopilot's to fly."""
SAID_AFTER_S = 1.0
"""A reason against engaging that lasts for so long is said."""
AGAIN_AFTER_S = 5.0
"""Between two words on why not."""
CHANGES_WITHIN_S = 0.6
"""PX4 publishes vehicle_control_mode every 0.5 s while its mode stays."""
LONGEST_S = 1e6
_HOME_POSITION: int = mav.MAVLINK_MSG_ID_HOME_POSITION
_ATTITUDE_TARGET: int = mav.MAVLINK_MSG_ID_ATTITUDE_TARGET
_RC_CHANNELS: int = mav.MAVLINK_MSG_ID_RC_CHANNELS
_WANTED = HANDLED | {_RC_CHANNELS, _ATTITUDE_TARGET, _HOME_POSITION}
_STATUSTEXT_BYTES = 50


class LetGo(FlightEnd):
    """The client's setpoints are passed on again; we may take over again as soon as they can be flown."""

    outcome = Outcome.HANDED_BACK


class SteppedBack(FlightEnd):
    """The same, until our mode has been left and entered again."""

    outcome = Outcome.HANDED_BACK


class _Followed:
    """A follower as the trajectory of a plan that began at `started_s`, where the vehicle was and as it moved.

    The follower begins on the client's stream; what the vehicle is off it dies away within the limits of a transit.
    """

    duration_s = math.inf

    def __init__(self, follower: Follower, started_s: float, off: Way) -> None:
        self._follower = follower
        self._started_s = started_s
        self._off: Way | None = off

    def sample(self, time_s: float) -> Reference:
        """See `Trajectory`."""
        at_s = self._started_s + time_s
        reference = self._follower.sample(at_s)
        if self._off is None:
            return reference
        if at_s >= self._off.end_s:
            self._off = None
            return reference
        return reference_of(table_of(reference) + self._off.at(at_s))


class ClientFlight(Flight):
    """See the module."""

    begins_in_air = True
    clients: ClientSetpoints
    """To be set before `run`."""
    _engagement: Engagement | None = None
    _barred = ""
    """Why we do not take over before our mode is entered anew; empty: we may."""
    _why_not: tuple[str, float] = ("", 0.0)
    _said_s = -math.inf
    was_armed = False
    """Whether there is anything in the log."""

    def run(self) -> FlightResult:
        """Stand by until the vehicle is disarmed after a flight; says how often we flew.

        Raises:
            LinkLost, Interrupted, Refused: in the words of each.
        """
        vehicle = self._vehicle
        vehicle.watch = self._watch
        vehicle.on_message = self._on_message
        vehicle.link.tap = None  # hours on the ground are not worth a log
        try:
            self._prepare()
            self._reporter.say("standing by: setpoints of clients are passed on until they can be flown")
            vehicle.until(lambda: vehicle.status.armed)
            self.was_armed = True
            vehicle.link.tap = self._recorder.frame
            self.clients.on_heard = self._log_clients
            turns = self._stand_by()
        finally:
            self._watchdog.stop()
        return self._write_down(FlightResult(Outcome.COMPLETED, f"disarmed; flown for clients {turns} times"))

    def _stand_by(self) -> int:
        vehicle, loop = self._vehicle, self._loop
        vehicle.link.wanted = _WANTED
        engagement = self._engagement = Engagement(vehicle, loop, self._settings.procedure)
        vehicle.on_state = engagement.on_state
        self.clients.allowed = self._why_not_there
        vehicle.commands.send(request_message(_HOME_POSITION))
        with suppress(WaitedTooLong):
            vehicle.until(lambda: engagement.home_enu is not None, HOME_WAIT_S)
        turns = 0
        disarmed = vehicle.disarmed_for(1.0)
        while True:
            vehicle.until(lambda: disarmed() or self._may_take_over(engagement))
            if not vehicle.status.armed:
                return turns
            turns += 1
            try:
                self._take_over(engagement)
                vehicle.until(lambda: False)
            except FlightEnd as end:
                self._hand_back(engagement, end)
                if isinstance(end, LinkLost | Interrupted):
                    raise

    # Taking over ----------------------------------------------------------------------------------------

    def _may_take_over(self, engagement: Engagement) -> bool:
        """Whether the vehicle flies in our mode on a stream that can be flown; what else stands against it is said."""
        vehicle, clients = self._vehicle, self.clients
        now_s = vehicle.link.autopilot_time_s
        if not vehicle.is_ours:
            self._barred = ""
            return False
        if self._barred or not vehicle.status.armed or clients.is_own_business(now_s):
            return False
        if engagement.home_enu is None and vehicle.state is not None:
            x, y, _ = vehicle.state.position_enu.tolist()
            engagement.home_enu = np.array([x, y, 0.0])
            self._tell("no HOME_POSITION: heights count from 0 of the local frame", mav.MAV_SEVERITY_NOTICE)
        if clients.silent_s(now_s) > LOST_S and not clients.refusal:
            return False
        reasons = engagement.why_not()
        if not reasons and clients.refusal:
            reasons.append(clients.refusal)
        elif not reasons and not clients.is_stream(now_s):
            reasons.append("setpoints come too rarely, 4 a second are the least")
        elif not reasons and self._height_m(engagement) < ABOVE_M:
            reasons.append(f"lower than {ABOVE_M:g} m")
        self._say_why_not(", ".join(reasons), now_s)
        return not reasons

    def _height_m(self, engagement: Engagement) -> float:
        state = self._vehicle.state
        assert state is not None and engagement.home_enu is not None
        return float(state.position_enu[2] - engagement.home_enu[2])

    def _say_why_not(self, reasons: str, now_s: float) -> None:
        """Numbers change all the time, and short waits are no news."""
        kind = re.sub(r"[-\d.]+", "", reasons)
        before, since_s = self._why_not
        if kind != before or now_s < since_s:
            self._why_not = kind, now_s
        elif reasons and since_s + SAID_AFTER_S <= now_s and not 0.0 <= now_s - self._said_s < AGAIN_AFTER_S:
            self._said_s, self._why_not = now_s, (kind, math.inf)
            self._tell(f"setpoints are passed on: {reasons}", mav.MAV_SEVERITY_WARNING)

    def _take_over(self, engagement: Engagement) -> None:
        vehicle, stage, state = self._vehicle, self._stage, self._vehicle.state
        assert (
            state is not None and engagement.home_enu is not None and vehicle.link.target_system is not None
        )
        stage.engaged = stage.airborne = self._armed_by_now = vehicle.taken_off = True
        stage.ground_m = float(engagement.home_enu[2])
        vehicle.link.look_out(False)
        self._pilot.sticks_are_at_rest()
        self.clients.hold_back(vehicle.link.target_system)
        if vehicle.adapter.wants_setpoints_first:
            self._change_controllers(engagement)
        state = vehicle.state
        assert state is not None
        limits = self._transit_limits(stage.ground_m)
        start, stream = engagement.start, self.clients.newest(engagement.start)
        gap = table_of(start) - table_of(stream)
        gap[0, 3] = wrapped(float(gap[0, 3]))
        follower = Follower(stream, state.time_s + LOOK_AHEAD_S, limits)
        self.clients.follow(follower)
        stage.plan = FlightPlan(
            [(Phase.TRACK, _Followed(follower, state.time_s, way_out(gap, limits, state.time_s)), LONGEST_S)]
        )
        watching = self._watch_over(at_rest(engagement.home_enu, start.yaw_rad))
        engagement.begin(stage.plan, watching)
        stage.enter(Phase.TRACK)
        self._recorder.log.event("tracking", state.time_s, active=True)
        self._recorder.log.event("engaged", state.time_s, text="for a client")
        self._tell(
            f"flying the client's setpoints, hover thrust {self._loop.hover_thrust:.2f}",
            mav.MAV_SEVERITY_NOTICE,
        )

    def _change_controllers(self, engagement: Engagement) -> None:
        """PX4 looks only twice a second which of its controllers a setpoint is for: till then its position controller
        goes on with the client's last one, and what we ask for has to be what the vehicle does anyhow.
        """
        vehicle = self._vehicle
        self._stage.enter(Phase.PROVE)
        engagement.prove()
        begun_s = vehicle.link.autopilot_time_s
        vehicle.until(lambda: vehicle.link.autopilot_time_s - begun_s >= CHANGES_WITHIN_S)

    def _why_not_there(self, position_enu: Vector) -> str:
        """Why a point (3,) m, NaN where it is the vehicle's own, may not be flown to; empty when it may."""
        engagement, state, safety = self._engagement, self._vehicle.state, self._settings.safety
        if engagement is None or engagement.home_enu is None or state is None:
            return ""
        asked = np.where(np.isnan(position_enu), state.position_enu, position_enu) - engagement.home_enu
        east, north, up = asked.tolist()
        needed = {
            name: max((at for r, at, _ in safety.ladder(name).rungs() if r >= Reaction.HOLD), default=0.0)
            for name in ("fence_margin_m", "ceiling_margin_m")
        }
        if horizontal_margin(safety.fence, east, north) < needed["fence_margin_m"]:
            return "outside the fence (flight.safety.fence)"
        if safety.fence.height_max_m - up < needed["ceiling_margin_m"]:
            return f"above the ceiling: {up:.1f} m high (flight.safety.fence.height_max_m)"
        if up < max(LOWEST_M, self._vehicle.status.height_accuracy_m or 0.0):
            return f"near the ground: {up:.1f} m high, the autopilot lands by itself"
        return ""

    # While it flies, and afterwards ---------------------------------------------------------------------

    def _watch(self) -> None:
        vehicle, clients = self._vehicle, self.clients
        clients.hear(vehicle.link.autopilot_time_s)
        if clients.streams_changed and self._stage.loop is not None:
            clients.streams_changed = False
            self._preflight.ask_again()
        super()._watch()
        if not self._stage.engaged:
            return
        now_s = vehicle.link.autopilot_time_s
        if clients.is_own_business(now_s):
            raise LetGo("the client flies the attitude itself")
        if clients.has_lapsed:
            raise SteppedBack("the law stood still")
        if self._loop.held:
            raise SteppedBack(self._loop.held)
        if self._loop.world_moved:
            raise LetGo("the estimate has jumped")
        if (silent_s := clients.silent_s(now_s)) > LOST_S:
            raise LetGo(clients.refusal or f"the client has sent no setpoint for {silent_s:.1f} s")

    def _hand_back(self, engagement: Engagement, end: FlightEnd) -> None:
        """The autopilot has its client's setpoints again; ours have stopped."""
        vehicle, stage = self._vehicle, self._stage
        if vehicle.is_ours and vehicle.state is not None:
            self._loop.leave_level(vehicle.state)
        self._loop.stop()
        self.clients.let_go()
        stage.engaged, self._barred = False, "" if isinstance(end, LetGo) else str(end)
        vehicle.on_state = engagement.on_state
        self._watchdog.stop()
        self._watchdog = LoopWatchdog(self._settings.safety.stall_s, self._note_stall)
        self._pilot = Pilot(self._settings.safety.stick_share)
        self._recorder.log.event("tracking", vehicle.link.autopilot_time_s, active=False)
        self._recorder.log.event(
            "safety", vehicle.link.autopilot_time_s, reaction=end.outcome.value, reason=str(end)
        )
        stage.enter(Phase.WATCH)
        mild = isinstance(end, PilotTookOver)
        self._tell(
            f"stopped flying: {end}" if mild else f"setpoints are passed on: {end}",
            mav.MAV_SEVERITY_NOTICE if mild else mav.MAV_SEVERITY_WARNING,
        )

    def _tell(self, text: str, severity: int) -> None:
        """Say it here, in the log, and to ground stations."""
        self._reporter.say(text)
        self._recorder.log.event("live", self._vehicle.link.autopilot_time_s, text=text)
        words = text.encode("ascii", "replace")[:_STATUSTEXT_BYTES]
        self._vehicle.link.send(mav.MAVLink_statustext_message(severity, words))

    def _log_clients(self, time_s: float, frame: bytes) -> None:
        self._recorder.log.mavlink("in", time_s, frame)

    def _on_message(self, message: Message) -> None:
        if self._engagement is not None:
            self._engagement.take(message)
        super()._on_message(message)

    def surroundings(self) -> Surroundings:
        """What of the vehicle a client's message may count from."""
        vehicle, state = self._vehicle, self._vehicle.state
        yaw_rad = yaw_of(state.quaternion_wxyz) if state is not None else 0.0
        return Surroundings(
            state.position_enu if state is not None else None,
            yaw_rad,
            vehicle.status.global_origin,
            float(self._engagement.home_enu[2])
            if self._engagement is not None and self._engagement.home_enu is not None
            else 0.0,
            vehicle.link.target_system,
            body_frame_of_px4=vehicle.adapter.wants_setpoints_first,
        )
