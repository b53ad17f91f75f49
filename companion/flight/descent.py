"""The way down: as planned, because a flight breaks off, or left to somebody else. Each way says how it went.

One rule holds for all of them: until somebody else has the vehicle, setpoints go on that keep it level (in the air) or
its motors idle (on the ground), and what is asked for is asked for every ASK_EVERY_S until it shows. Setpoints that
simply stop leave the last one standing for as long as the autopilot's timeout, whatever it was; one command may be lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from companion.autopilot.adapter import DISARM, STOP_MOTORS, Intent
from companion.config.settings import FlightSettings
from companion.flight.outcome import (
    FlightEnd,
    HandedBack,
    Interrupted,
    LeftFlying,
    LinkLost,
    MotorsStopped,
    NobodyHasIt,
    Outcome,
    PilotTookOver,
    PlanFlown,
    TippedOver,
    WaitedTooLong,
)
from companion.flight.phases import Phase
from companion.flight.stage import FlightResult, Stage
from companion.mavlink.link import mav
from companion.mavlink.protocol import Command

ASK_EVERY_S = 0.1
KEEPS_LEVEL_S = 5.0  # then no more setpoints: the autopilot's own offboard-loss action is what is left
ASKS_FOR_S = 15.0
HOLD_FOR_S = 1.5  # a hold that does not come is not to be had (no position): LAND
LISTENS_ON_S = 5.0  # for an autopilot that has fallen silent, our clock
TIPPED_DISARM_S = 3.0  # a land detector takes so long to believe in idle motors; LAND would turn them again
_DISARM_TIMEOUT_S = 1.5  # until HEARTBEAT shows what a COMMAND_ACK has said
_DISARMS = 3
_STAYS_DISARMED_S = 1.0  # longer than a frame is held up on its way
_FALL_S = 0.5  # how long a vehicle that was disarmed while landing is looked at
_FALLING_M_S = 2.0  # faster than an autopilot lets down; reached after 0.2 s without motors
_MISTAKES_BORNE = 1000  # of ours, one with every message while the autopilot is asked
_REFUSALS = (mav.MAV_RESULT_TEMPORARILY_REJECTED, mav.MAV_RESULT_DENIED, mav.MAV_RESULT_FAILED)


class Descent:
    """See the module. `end` may be called once a flight."""

    def __init__(self, stage: Stage, settings: FlightSettings) -> None:
        self._stage = stage
        self._vehicle = stage.vehicle
        self._settings = settings
        self._asking = False
        self._interrupted: Interrupted | None = None  # a first wish to stop that came on the way down
        self._again: HandedBack | None = None  # a second one
        self._mistake: Exception | None = None
        self._mistakes = 0
        self._noted = False

    def end(self, end: FlightEnd) -> FlightResult:
        """Bring the vehicle into the safest state that `end` allows, and say how it went.

        A mistake of ours that happens on the way is said at its end.
        """
        try:
            result = self._bring_down(end)
        except FlightEnd as another:
            outcome = another.outcome if not isinstance(end, LinkLost) else end.outcome
            result = FlightResult(outcome, f"{end}; then {another}")
        if self._mistake is not None:
            result = replace(result, text=f"{result.text}; mistake in this program: {self._mistake!r}")
        return result

    def _bring_down(self, end: FlightEnd) -> FlightResult:
        stage = self._stage
        engaged, stage.engaged, stage.ending = stage.engaged, False, True
        if not engaged or stage.loop is None:
            stage.stop_setpoints()
            self._note(end)
            return FlightResult(end.outcome, str(end))
        stands = self._stands(end)
        if isinstance(end, PilotTookOver) and self._not_ours():
            stage.stop_setpoints()
        elif stands:
            stage.loop.stand_down()
        else:
            stage.loop.level()
        if isinstance(end, PilotTookOver):
            return self._leave_to_pilot(end)
        if isinstance(end, LinkLost) and not self._heard_again(end):
            return FlightResult(end.outcome, str(end))
        if stands:
            return self._stay_down(end)
        if isinstance(end, MotorsStopped):
            return self._stop_motors(end)
        if isinstance(end, HandedBack):
            return self._hand_back(end, str(end))
        if isinstance(end, PlanFlown) and stage.then is not Intent.LAND:
            return self._leave_flying(end)
        how = self.land(end)
        if isinstance(end, PlanFlown):
            if self._interrupted is not None:
                return FlightResult(Outcome.INTERRUPTED, f"{self._interrupted}; {how}")
            return FlightResult(end.outcome, f"flown as planned, {how}")
        return FlightResult(end.outcome, f"{end}; {how}")

    def _note(self, end: FlightEnd) -> None:
        """What ended the flight, for the log: after what had to be sent first."""
        if not isinstance(end, PlanFlown) and not self._noted:
            self._noted = True
            log, now_s = self._stage.recorder.log, self._vehicle.link.autopilot_time_s
            log.event("safety", now_s, reaction=end.outcome.value, reason=str(end))

    # Asking, and what goes on meanwhile ------------------------------------------------------------------

    def _ask(
        self,
        command: Command,
        done: Callable[[], bool],
        for_s: float,
        said: Callable[[], None] = lambda: None,
    ) -> bool:
        """Send `command` every ASK_EVERY_S until `done()` holds; False when it does not after `for_s`.

        It is sent once in any case, and `said` is called after that. Wishes and mistakes of ours do not end it, nor does
        silence, before LISTENS_ON_S more: the autopilot may hear us all the while.
        """
        vehicle, silence_s = self._vehicle, self._settings.safety.silence_s
        self._asking, vehicle.silence_limit_s = True, math.inf
        try:
            for number in range(max(1, round(for_s / ASK_EVERY_S))):
                vehicle.commands.send(command, again=number > 0)
                if number == 0:
                    self._bear(said)
                with suppress(WaitedTooLong):
                    self._until(done, ASK_EVERY_S)
                    return True
                if vehicle.link.silence_s > silence_s + LISTENS_ON_S:
                    break
            return False
        finally:
            self._asking, vehicle.silence_limit_s = False, silence_s

    def _until(self, condition: Callable[[], bool], timeout_s: float = math.inf) -> None:
        """Wait as `Vehicle.until` does. Being interrupted once changes nothing; twice counts when our mode is left."""
        while True:
            try:
                self._vehicle.until(condition, timeout_s)
            except Interrupted as wish:
                self._interrupted = wish
                continue
            except HandedBack as wish:
                if not self._asking:
                    raise
                self._again = wish
                continue
            except (FlightEnd, WaitedTooLong):
                raise
            except Exception as mistake:
                self._mistake = self._mistake or mistake
                self._mistakes += 1
                if self._mistakes > _MISTAKES_BORNE:
                    raise
                continue
            return

    def _bear(self, say: Callable[[], None]) -> None:
        """Words must not end a landing: a terminal may be gone, a disk full."""
        try:
            say()
        except Exception as mistake:
            self._mistake = self._mistake or mistake

    def _leave(self, intent: Intent, for_s: float, said: Callable[[], None] = lambda: None) -> bool:
        """Ask for a mode until ours is left, or the vehicle disarmed; the setpoints end then, not before."""
        if self._not_ours():  # somebody's wish, which is not overruled
            said()
        left = self._not_ours() or self._ask(self._vehicle.adapter.mode(intent), self._not_ours, for_s, said)
        if left:
            self._stage.stop_setpoints()
        return left

    def _not_ours(self) -> bool:
        return not self._vehicle.is_ours or not self._vehicle.status.armed

    # The ways --------------------------------------------------------------------------------------------

    def land(self, end: FlightEnd) -> str:
        """Let the autopilot land and wait until it has disarmed; returns how it came down, for the last word."""
        stage = self._stage

        def said() -> None:
            self._note(end)
            stage.enter(Phase.LAND)
            stage.reporter.say(f"landing: {end}")

        if not self._leave(Intent.LAND, KEEPS_LEVEL_S, said):
            stage.stop_setpoints()
            if not self._leave(Intent.LAND, ASKS_FOR_S - KEEPS_LEVEL_S):
                raise self._nobody("LAND")
        if self._again is not None:
            raise self._again
        return self._come_down()

    def _land_for_nobody(self, why: str) -> str:
        """Land a vehicle that holds for somebody who is not there; returns how it came down."""
        vehicle, stage = self._vehicle, self._stage

        def lands() -> bool:
            return (
                vehicle.adapter.is_mode(vehicle.status.custom_mode, Intent.LAND) or not vehicle.status.armed
            )

        def said() -> None:
            stage.enter(Phase.LAND)
            stage.reporter.say(f"landing: {why}")

        if not self._ask(vehicle.adapter.mode(Intent.LAND), lands, ASKS_FOR_S, said):
            raise self._nobody("LAND")
        return self._come_down()

    def _come_down(self) -> str:
        """Wait until the autopilot has landed and disarmed; returns how it came down, for the last word."""
        vehicle, stage = self._vehicle, self._stage
        timeout_s = self._settings.procedure.land_timeout_s
        try:
            self._until(lambda: not vehicle.status.armed, timeout_s)
        except WaitedTooLong:
            raise LeftFlying(
                f"still armed {timeout_s:.0f} s after LAND; it is in "
                f"{vehicle.adapter.mode_name(vehicle.status.custom_mode)} and flies without us"
            ) from None
        how = self._how_it_came_down()
        stage.enter(Phase.DONE)
        return how

    def _how_it_came_down(self) -> str:
        """Just disarmed while landing: on the ground, unless it falls now, for who disarmed it was not us.

        Raises:
            PilotTookOver: it falls.
        """
        vehicle, assembler = self._vehicle, self._vehicle.assembler
        said_landed = vehicle.on_ground
        seen_s, height_m = assembler.position_time_s, self._height_m()
        with suppress(WaitedTooLong, LinkLost):
            self._until(self._falls, _FALL_S)
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

    def _stands(self, end: FlightEnd) -> bool:
        """Whether the vehicle is on the ground, as far as we know: thrust may end there, and nowhere else."""
        stage = self._stage
        assert stage.loop is not None
        if stage.airborne:
            return False
        return isinstance(end, TippedOver) or not self._vehicle.status.armed or stage.loop.cannot_have_left

    def _stay_down(self, end: FlightEnd) -> FlightResult:
        """On the ground: DISARM until it shows, then leave our mode. Where it is refused it has left the ground: land."""
        vehicle, loop = self._vehicle, self._stage.loop
        assert loop is not None
        tipped = isinstance(end, TippedOver)
        refused = False

        def settled() -> bool:
            nonlocal refused
            refused = refused or (vehicle.commands.result in _REFUSALS and not tipped)
            return not vehicle.status.armed or refused

        for _ in range(_DISARMS):  # our ARM may be under way still, and come after the first
            loop.stand_down()
            self._ask(DISARM, settled, TIPPED_DISARM_S, lambda: self._note(end))
            if vehicle.status.armed:
                break
            self._stage.stop_setpoints()
            if self._stays_disarmed():
                self._ask(vehicle.adapter.mode(Intent.HOLD), lambda: not vehicle.is_ours, HOLD_FOR_S)
                return FlightResult(end.outcome, str(end))
        if not tipped:
            loop.level()
        return FlightResult(end.outcome, f"{end}; {self.land(end)}")

    def _stays_disarmed(self) -> bool:
        vehicle, stays = self._vehicle, self._vehicle.disarmed_for(_STAYS_DISARMED_S)
        with suppress(WaitedTooLong):
            self._until(lambda: stays() or vehicle.status.armed, _STAYS_DISARMED_S + _DISARM_TIMEOUT_S)
        return not vehicle.status.armed

    def _stop_motors(self, end: FlightEnd) -> FlightResult:
        """Disarm in the air, which takes the autopilots' magic number; hand back where that is refused."""
        vehicle = self._vehicle
        if self._ask(
            STOP_MOTORS, lambda: not vehicle.status.armed, _DISARM_TIMEOUT_S, lambda: self._note(end)
        ):
            self._stage.stop_setpoints()
            return FlightResult(end.outcome, f"{end}; motors stopped")
        word = vehicle.result_word(vehicle.commands.result)
        return self._hand_back(HandedBack(str(end)), f"{end}; the autopilot would not disarm ({word})")

    def _hand_back(self, end: FlightEnd, text: str) -> FlightResult:
        """Nothing is waited for but that our mode is left: what follows is the autopilot's."""
        self._hold_or_land(lambda: self._note(end))
        return FlightResult(end.outcome, text)

    def _leave_flying(self, end: FlightEnd) -> FlightResult:
        """The plan is flown, and the autopilot flies on as was asked for; a hold where it does not take that."""
        vehicle, stage = self._vehicle, self._stage
        if not self._leave(stage.then, HOLD_FOR_S):
            self._hold_or_land(lambda: None)
        mode = vehicle.adapter.mode_name(vehicle.status.custom_mode)
        return FlightResult(end.outcome, f"flown as planned, handed back in {mode}")

    def _hold_or_land(self, said: Callable[[], None]) -> None:
        """A hold, or where that is not to be had a landing. Raises NobodyHasIt when neither is taken."""
        if self._leave(Intent.HOLD, HOLD_FOR_S, said) or self._leave(Intent.LAND, KEEPS_LEVEL_S):
            return
        self._stage.stop_setpoints()
        raise self._nobody("a hold or LAND")

    def _nobody(self, asked_for: str) -> FlightEnd:
        """What is to be said when the autopilot is in our mode still."""
        vehicle = self._vehicle
        if vehicle.link.silence_s > self._settings.safety.silence_s:
            return LinkLost(f"nothing heard from the autopilot for {vehicle.link.silence_s:.1f} s")
        return NobodyHasIt(
            f"the autopilot did not take {asked_for} ({vehicle.result_word(vehicle.commands.result)}); our setpoints "
            "have stopped, so its own offboard-loss action is what is left" + vehicle.last_texts()
        )

    def _leave_to_pilot(self, end: FlightEnd) -> FlightResult:
        """No more setpoints, as soon as the mode is not ours: where sticks do not change it by themselves, we do."""
        vehicle, stage = self._vehicle, self._stage
        if vehicle.is_ours and not vehicle.status.armed:
            vehicle.commands.send(vehicle.adapter.mode(Intent.HOLD))
        self._hold_or_land(lambda: self._note(end))
        stage.enter(Phase.WATCH)
        stage.reporter.say(f"{end.outcome.value}: {end}")
        stage.reporter.say("no more setpoints; logging until the vehicle is disarmed (Ctrl-C ends it)")
        try:
            if self._interrupted is None and self._again is None:
                disarmed = vehicle.disarmed_for(_STAYS_DISARMED_S)
                vehicle.until(lambda: disarmed() or bool(stage.nobody_has_it()))
                if nobody := stage.nobody_has_it():
                    return FlightResult(end.outcome, f"{end}; {nobody}; {self._land_for_nobody(nobody)}")
                return FlightResult(end.outcome, f"{end}; disarmed later")
        except (Interrupted, HandedBack, LinkLost):
            pass
        return FlightResult(end.outcome, f"{end}; not watched to the end")

    def _heard_again(self, end: FlightEnd) -> bool:
        """Whether a silent autopilot speaks again. It may hear us all the while: what an end would ask for is asked for."""
        vehicle, stage = self._vehicle, self._stage
        before = vehicle.link.last_message_ns
        command = DISARM if self._stands(end) else vehicle.adapter.mode(Intent.LAND)
        heard = self._ask(
            command, lambda: vehicle.link.last_message_ns != before, LISTENS_ON_S, lambda: self._note(end)
        )
        if not heard:
            stage.stop_setpoints()
        return heard
