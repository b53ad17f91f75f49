"""Standing by: each time our mode begins in the air the law engages, each time it is left it stops, ready for the next.

One flight after another over one connection, into one log: each begins with waiting, its engagement is marked by the
events `engaged` and `ended`. Our mode counts when it begins, not while it lasts: what was refused, or was on before we
were, has to be left and chosen again.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Callable

from companion.autopilot.adapter import Intent
from companion.config.errors import UserError
from companion.flight.control_loop import Activity
from companion.flight.engagement import Engagement, FlightFromAir
from companion.flight.flight import MISTAKE
from companion.flight.outcome import HandedBack, Outcome, Refused
from companion.flight.phases import Phase
from companion.flight.reporter import Reporter
from companion.flight.stage import FlightResult, Interrupts
from companion.flight.vehicle import Vehicle
from companion.mavlink.link import mav
from companion.mavlink.protocol import request_message
from companion.mavlink.status_text import status_texts

ENGAGE_PORT = 14610
"""Where `companion engage` is heard, on this machine only."""
HEARD_S = 0.5
LASTS_S = 1.0
ASKS_EVERY_S = 0.5
ASKS_FOR_S = 4.0  # PX4 takes OFFBOARD after a second of setpoints only
_LONGEST_WISH = 256


class Wishes:
    """What `companion engage` asks for, one datagram each: the name of a law, or nothing. Each is answered in words."""

    def __init__(self, port: int) -> None:
        """Listen on this machine's loopback. Raises UserError where the port is taken."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", port))
        except OSError as error:
            self._socket.close()
            raise UserError(
                f"port {port} for `companion engage` cannot be had ({error.strerror}): does another `companion "
                "standby` run? Choose another one with --engage-port"
            ) from None
        self._socket.setblocking(False)
        self._from: tuple[str, int] | None = None

    def take(self) -> str | None:
        """The newest wish: a law's name, empty for the law that is set; None: there is none."""
        wish = None
        while True:
            try:
                data, self._from = self._socket.recvfrom(_LONGEST_WISH)
            except (BlockingIOError, ConnectionRefusedError):
                return wish
            wish = data.decode("ascii", "replace").strip()

    def answer(self, text: str) -> None:
        """Tell whoever asked last."""
        if self._from is not None:
            try:
                self._socket.sendto(text.encode(), self._from)
            except OSError:
                return  # gone meanwhile

    def close(self) -> None:
        """Listen no more."""
        self._socket.close()


class StandbyFlight(FlightFromAir):
    """One engagement, and the waiting before it. `before` and `wishes` are set by `Standby`."""

    wishes: Wishes
    before: StandbyFlight | None = None
    """The flight before on this connection; None: everything is to be looked at first."""
    has_engaged = False
    patience_s = math.inf
    _was_ours = False
    _hindered = True  # whether something stood against engaging when the pilot was told last
    _changed_s = -math.inf
    _asked_s = _asks_until_s = -math.inf  # for our mode, because of a wish

    def _get_ready(self) -> None:
        self._stage.stands_by = True
        before = self.before
        if before is None:
            super()._get_ready()
            return
        self._vehicle.on_message = self._on_message
        self._loop = self._stage.loop = self._make_loop(self._vehicle)
        self._vehicle.on_lone_attitude = self._loop.on_lone_attitude
        self._clocks_s = before._clocks_s

    def _take_off(self) -> None:
        """In place of a take-off: wait until our mode begins, and engage."""
        vehicle, stage = self._vehicle, self._stage
        self._was_ours = vehicle.is_ours
        engagement = self._meet()
        stage.enter(Phase.STANDBY)
        mode = vehicle.adapter.mode_name(vehicle.status.custom_mode)
        self._reporter.say(
            f"standing by; it is in {mode}, which counts when it is chosen anew"
            if self._was_ours
            else f"standing by; it is in {mode}"
        )
        vehicle.until(lambda: self._begins(engagement))
        stage.airborne = stage.engaged = self.has_engaged = True
        self._pilot.sticks_are_at_rest()
        try:
            self._begin()
        except (Refused, UserError) as refused:
            self._tell(f"not engaged: {refused}", mav.MAV_SEVERITY_WARNING)
            raise HandedBack(f"not engaged: {refused}") from refused
        self._tell(f"engaged: {self._loop.law.name}", mav.MAV_SEVERITY_INFO)

    def _meet(self) -> Engagement:
        before = self.before._engagement if self.before is not None else None
        if before is None or before.home_enu is None:
            return super()._meet()
        self._stage.ground_m = float(before.home_enu[2])
        self._vehicle.commands.send(
            request_message(mav.MAVLINK_MSG_ID_HOME_POSITION)
        )  # it may be another by now
        return self._watch_hover(before.home_enu)

    def _begins(self, engagement: Engagement) -> bool:
        """Whether our mode has just begun, and nothing stands against engaging; refuses it otherwise.

        PX4 takes OFFBOARD only where setpoints come in. They do while nothing stands against engaging: the autopilot
        itself refuses the mode where we would.
        """
        vehicle, loop = self._vehicle, self._loop
        reasons = engagement.why_not()
        if vehicle.adapter.wants_setpoints_first:
            if reasons:
                loop.stop()
            elif loop.activity is Activity.NOTHING:
                engagement.prove()
        self._tell_readiness(reasons)
        self._take_wish(reasons)
        was_ours, self._was_ours = self._was_ours, vehicle.is_ours
        if was_ours or not vehicle.is_ours:
            return False
        if not reasons:
            return True
        text = f"not engaged: {', '.join(reasons)}"
        self._recorder.log.event("refused", vehicle.link.autopilot_time_s, text=text)
        self._reporter.say(text)
        self._tell(text, mav.MAV_SEVERITY_WARNING)
        if vehicle.adapter.wants_setpoints_first and vehicle.status.armed and vehicle.on_ground is False:
            self._stage.airborne = self._stage.engaged = True
            raise HandedBack(text)  # ArduCopter's GUIDED holds by itself, PX4's OFFBOARD does not
        return False

    def _tell_readiness(self, reasons: list[str]) -> None:
        """In the air: where PX4 refuses OFFBOARD for want of setpoints, the pilot has to know why they do not come."""
        now_s = self._vehicle.link.autopilot_time_s
        if bool(reasons) == self._hindered or self._vehicle.on_ground is not False:
            self._changed_s = now_s
        elif now_s - self._changed_s >= LASTS_S:
            self._hindered = bool(reasons)
            text = f"cannot engage: {', '.join(reasons)}" if reasons else "ready to engage"
            self._reporter.say(text)
            self._tell(text, mav.MAV_SEVERITY_INFO)

    def _take_wish(self, reasons: list[str]) -> None:
        """Ask for our mode where `companion engage` wishes it, and nothing stands against it."""
        vehicle, loop, now_s = self._vehicle, self._loop, self._vehicle.link.autopilot_time_s
        if self._asked_s <= now_s < self._asks_until_s and not reasons and not vehicle.is_ours:
            self._asked_s = now_s + ASKS_EVERY_S
            vehicle.commands.send(vehicle.adapter.mode(Intent.EXTERNAL))
        wish = self.wishes.take()
        if wish is None:
            return
        if wish and wish not in loop.laws:
            self.wishes.answer(f"refused: no law {wish!r} here; there are {', '.join(loop.laws)}")
        elif reasons:
            self.wishes.answer(f"refused: {', '.join(reasons)}")
        elif vehicle.is_ours:
            self.wishes.answer("refused: our mode is on already; leave it first")
        else:
            if wish:
                loop.fly_by(wish)
            self.wishes.answer(f"engaging with {loop.law.name}")
            self._asked_s, self._asks_until_s = now_s, now_s + ASKS_FOR_S

    def _watch(self) -> None:
        super()._watch()
        if self._stage.engaged and not self._stage.ending and (wish := self.wishes.take()) is not None:
            if wish not in self._loop.laws:
                self.wishes.answer(f"refused: engaged already, with {self._loop.law.name}")
            else:
                self._loop.fly_by(wish)
                self.wishes.answer(f"flying on with {wish}")
                self._reporter.say(f"flying on with {wish}")

    def _tell(self, text: str, severity: int) -> None:
        """Tell the ground station."""
        for message in status_texts(severity, f"companion: {text}"):
            self._vehicle.link.send(message)


class Standby:
    """Engagement after engagement until Ctrl-C; see the module."""

    def __init__(
        self,
        vehicle: Vehicle,
        make_flight: Callable[[type[StandbyFlight]], StandbyFlight],
        reporter: Reporter,
        interrupts: Interrupts,
        wishes: Wishes,
    ) -> None:
        """`make_flight(kind)` makes a flight of that class over the vehicle's connection."""
        self._vehicle = vehicle
        self._make_flight = make_flight
        self._reporter = reporter
        self._interrupts = interrupts
        self._wishes = wishes

    def run(self) -> FlightResult:
        """Stand by until the user ends it; returns how that went.

        Raises:
            UserError: nothing to fly was found at the endpoint, or the trajectory cannot be flown.
        """
        before: StandbyFlight | None = None
        engagements = 0
        while True:
            flight = self._make_flight(StandbyFlight)
            flight.before, flight.wishes = before, self._wishes
            result = flight.run()
            engagements += flight.has_engaged
            if self._interrupts.count:
                return result if flight.has_engaged else _over(engagements)
            if result.outcome is Outcome.REFUSED or MISTAKE in result.text:
                return result  # neither goes away by itself
            self._reporter.say(f"{result.outcome.value}: {result.text}")
            held = flight.has_engaged or result.outcome is Outcome.HANDED_BACK
            before = flight if held and result.outcome is not Outcome.LINK_LOST else None
            if before is None and not self._hear_again():
                return _over(engagements)

    def _hear_again(self) -> bool:
        """Wait for an autopilot that fell silent or started anew; False when the user ends it first."""
        vehicle = self._vehicle
        limit_s, vehicle.silence_limit_s, vehicle.watch = vehicle.silence_limit_s, math.inf, lambda: None
        vehicle.on_state = vehicle.on_lone_attitude = vehicle.on_message = lambda _: None
        self._reporter.say("waiting for the autopilot")
        vehicle.until(lambda: bool(self._interrupts.count) or vehicle.link.silence_s < HEARD_S)
        vehicle.silence_limit_s = limit_s
        return not self._interrupts.count


def _over(engagements: int) -> FlightResult:
    return FlightResult(Outcome.COMPLETED, f"stood by, {engagements} engagements")
