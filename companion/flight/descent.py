"""The way down: as planned, because a flight breaks off, or left to somebody else. Each way says how it went."""

from __future__ import annotations

import math
from contextlib import suppress

from companion.autopilot.adapter import DISARM, STOP_MOTORS, Intent
from companion.config.settings import FlightSettings
from companion.flight.outcome import (
    Aborted,
    FlightEnd,
    HandedBack,
    Interrupted,
    LeftFlying,
    LinkLost,
    MotorsStopped,
    Outcome,
    PilotTookOver,
    Refused,
    WaitedTooLong,
)
from companion.flight.phases import Phase
from companion.flight.stage import FlightResult, Stage
from companion.flight.vehicle import Vehicle
from companion.mavlink.link import mav

_DISARM_TIMEOUT_S = 1.5  # until HEARTBEAT shows what a COMMAND_ACK has said
_STAYS_DISARMED_S = 1.0  # longer than a frame is held up on its way
_FALL_S = 0.5  # how long a vehicle that was disarmed while landing is looked at
_FALLING_M_S = 2.0  # faster than an autopilot lets down; reached after 0.2 s without motors


class Descent:
    """See the module."""

    def __init__(self, stage: Stage, settings: FlightSettings) -> None:
        self._stage = stage
        self._vehicle = stage.vehicle
        self._settings = settings

    def land(self, why: str) -> str:
        """Let the autopilot land and wait until it has disarmed; returns how it came down, for the last word."""
        vehicle = self._vehicle
        self._stage.enter(Phase.LAND)
        self._stage.reporter.say(f"landing: {why}")
        self._stage.engaged = False
        result: int | None = None
        for _ in range(3):
            result = vehicle.command(vehicle.adapter.mode(Intent.LAND), enough=self._not_ours)
            try:
                vehicle.until(self._not_ours, 2.5)
                break
            except WaitedTooLong:
                continue
        else:
            raise LeftFlying(
                f"the autopilot did not take LAND ({vehicle.result_word(result)}); our setpoints stop, "
                "so its own offboard-loss action brings it down" + self._vehicle.last_texts()
            )
        self._stage.stop_setpoints()
        timeout_s = self._settings.procedure.land_timeout_s
        try:
            vehicle.until(lambda: not vehicle.status.armed, timeout_s, "landing")
        except WaitedTooLong:
            raise LeftFlying(
                f"still armed {timeout_s:.0f} s after LAND; it is in "
                f"{vehicle.adapter.mode_name(vehicle.status.custom_mode)} and flies without us"
            ) from None
        how = self._how_it_came_down()
        self._stage.enter(Phase.DONE)
        return how

    def _how_it_came_down(self) -> str:
        """Just disarmed while landing: on the ground, unless it falls now, for who disarmed it was not us.

        Raises:
            PilotTookOver: it falls.
        """
        vehicle, assembler = self._vehicle, self._vehicle.assembler
        said_landed = vehicle.status.landed_state == mav.MAV_LANDED_STATE_ON_GROUND
        seen_s, height_m = assembler.position_time_s, self._height_m()
        with suppress(WaitedTooLong, LinkLost):
            vehicle.until(self._falls, _FALL_S)
        if self._falls():
            raise PilotTookOver(
                f"disarmed in the air while landing, {height_m:.1f} m above the place of take-off"
            )
        if assembler.position_time_s == seen_s and not said_landed:
            return "disarmed, where is not known: no position has come since"
        return "landed and disarmed"

    def _falls(self) -> bool:
        return float(self._vehicle.assembler.velocity_enu[2]) < -_FALLING_M_S

    def _height_m(self) -> float:
        state = self._vehicle.state
        return math.nan if state is None else float(state.position_enu[2]) - self._stage.ground_m

    def _not_ours(self) -> bool:
        status = self._vehicle.status
        return not self._vehicle.adapter.is_mode(status.custom_mode, Intent.EXTERNAL) or not status.armed

    def end_safely(self, end: FlightEnd) -> FlightResult:
        """Bring the vehicle into the safest state that `end` allows, and say how it went."""
        self._stage.recorder.log.event(
            "safety", self._vehicle.link.autopilot_time_s, reaction=end.outcome.value, reason=str(end)
        )
        try:
            return self._bring_down(end)
        except FlightEnd as another:
            if isinstance(another, HandedBack):
                self._hand_back()
            return FlightResult(another.outcome, f"{end}; then {another}")
        except WaitedTooLong as waited:
            return FlightResult(end.outcome, f"{end}; then {waited}")

    def _bring_down(self, end: FlightEnd) -> FlightResult:
        engaged, self._stage.engaged = self._stage.engaged, False
        if isinstance(end, Refused) or (
            not self._stage.airborne and not isinstance(end, (LinkLost, PilotTookOver))
        ):
            return self._stay_down(end, engaged)
        if isinstance(end, (Interrupted, Aborted)):
            if isinstance(end, Aborted):
                self._stage.stop_setpoints()
            return FlightResult(end.outcome, f"{end}; {self._land_whatever(str(end))}")
        self._stage.stop_setpoints()
        if isinstance(end, MotorsStopped):
            return self._stop_motors(end)
        if isinstance(end, PilotTookOver):
            if vehicle_is_ours(self._vehicle):  # sticks that do not change the mode by themselves
                self._vehicle.commands.send(self._vehicle.adapter.mode(Intent.HOLD))
            self._stage.enter(Phase.WATCH)
            self._stage.reporter.say(f"{end.outcome.value}: {end}")
            self._stage.reporter.say(
                "no more setpoints; logging until the vehicle is disarmed (Ctrl-C ends it)"
            )
            try:
                disarmed = self._vehicle.disarmed_for(_STAYS_DISARMED_S)
                self._vehicle.until(lambda: disarmed() or bool(self._stage.nobody_has_it()))
                if nobody := self._stage.nobody_has_it():
                    return FlightResult(end.outcome, f"{end}; {nobody}; {self._land_whatever(nobody)}")
            except (Interrupted, HandedBack, LinkLost):
                return FlightResult(end.outcome, f"{end}; not watched to the end")
            return FlightResult(end.outcome, f"{end}; disarmed later")
        if isinstance(end, HandedBack):
            self._hand_back()
        return FlightResult(end.outcome, str(end))

    def _land_whatever(self, why: str) -> str:
        """Land; a first wish to stop is what is being done already, a second one ends it."""
        try:
            return self.land(why)
        except Interrupted:
            return self.land(why)

    def _stay_down(self, end: FlightEnd, engaged: bool) -> FlightResult:
        """On the ground, as far as we know: disarm, leave our mode. What will not disarm has left the ground: land."""
        vehicle = self._vehicle
        self._stage.stop_setpoints()
        if not engaged:
            return FlightResult(end.outcome, str(end))
        vehicle.command(DISARM)  # armed or not: our ARM may be under way still
        try:
            vehicle.until(vehicle.disarmed_for(_STAYS_DISARMED_S), _STAYS_DISARMED_S + _DISARM_TIMEOUT_S)
        except WaitedTooLong:
            return FlightResult(end.outcome, f"{end}; {self._land_whatever(str(end))}")
        vehicle.command(vehicle.adapter.mode(Intent.HOLD))
        return FlightResult(end.outcome, str(end))

    def _stop_motors(self, end: FlightEnd) -> FlightResult:
        """Disarm in the air, which takes the autopilots' magic number; hand back where that is refused."""
        vehicle = self._vehicle
        result = vehicle.command(STOP_MOTORS)
        try:
            vehicle.until(lambda: not vehicle.status.armed, _DISARM_TIMEOUT_S)
        except WaitedTooLong:
            self._hand_back()
            return FlightResult(
                Outcome.HANDED_BACK, f"{end}; the autopilot would not disarm ({vehicle.result_word(result)})"
            )
        return FlightResult(end.outcome, f"{end}; motors stopped")

    def _hand_back(self) -> None:
        """One HOLD command, no waiting: what follows is the autopilot's."""
        self._stage.stop_setpoints()
        self._vehicle.commands.send(self._vehicle.adapter.mode(Intent.HOLD))


def vehicle_is_ours(vehicle: Vehicle) -> bool:
    """Whether the autopilot is still in the mode in which it follows our setpoints."""
    return vehicle.adapter.is_mode(vehicle.status.custom_mode, Intent.EXTERNAL)
