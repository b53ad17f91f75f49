"""How a flight can end, in types: what interrupts it, and what is said afterwards."""

from __future__ import annotations

import enum

from companion.config.safety import Reaction


class Outcome(enum.Enum):
    """The last word on a flight. `exit_code` is the process's."""

    COMPLETED = "completed"
    """Everything that was asked was flown, and the vehicle is disarmed."""
    REFUSED = "refused"
    """Nothing left the ground: a check refused the flight, or the autopilot would not arm."""
    PILOT = "pilot took over"
    """The pilot changed the mode or disarmed; our control ended there."""
    INTERRUPTED = "interrupted"
    """Ctrl-C or SIGTERM: landed by the autopilot."""
    ABORTED = "aborted"
    """The supervisor ended the flight: landed by the autopilot."""
    HANDED_BACK = "handed back"
    """A second Ctrl-C, a limit, or an autopilot that does not come down: it has the vehicle, we are gone."""
    LEFT_FLYING = "left flying"
    """The autopilot took no mode that we asked for: what it does now is its own offboard-loss action."""
    LINK_LOST = "link lost"
    """The autopilot fell silent; what it does now is its own offboard-loss action."""

    @property
    def exit_code(self) -> int:
        """0 completed; 1 link lost or left flying; 2 refused; 3 ended early, in safe hands."""
        return {"completed": 0, "link lost": 1, "left flying": 1, "refused": 2}.get(self.value, 3)


class FlightEnd(Exception):
    """Base of what ends a flight before its plan does. `str()` is a sentence for the pilot."""

    outcome = Outcome.ABORTED


class PlanFlown(FlightEnd):
    """The end that was planned."""

    outcome = Outcome.COMPLETED


class Refused(FlightEnd):
    """The flight may not begin."""

    outcome = Outcome.REFUSED


class PilotTookOver(FlightEnd):
    """A mode change or disarm that was not ours."""

    outcome = Outcome.PILOT


class Interrupted(FlightEnd):
    """Ctrl-C or SIGTERM."""

    outcome = Outcome.INTERRUPTED


class Aborted(FlightEnd):
    """A limit of the supervisor was reached."""

    outcome = Outcome.ABORTED


class TippedOver(Aborted):
    """It leans before it flies: thrust ends at once, on the ground as it is."""


class HandedBack(FlightEnd):
    """A second Ctrl-C, or a limit whose reaction is to hand back."""

    outcome = Outcome.HANDED_BACK


class LeftFlying(FlightEnd):
    """The autopilot lands, and did not come down in time; nothing more is asked of it."""

    outcome = Outcome.HANDED_BACK


class NobodyHasIt(FlightEnd):
    """The autopilot is in our mode still, although another was asked for again and again."""

    outcome = Outcome.LEFT_FLYING


class MotorsStopped(FlightEnd):
    """A limit whose configured reaction is to disarm, in the air too."""

    outcome = Outcome.ABORTED


class LinkLost(FlightEnd):
    """Nothing has been heard from the autopilot for too long."""

    outcome = Outcome.LINK_LOST


class WaitedTooLong(Exception):
    """A condition did not come true in time; the caller knows what that means."""


def ending(reaction: Reaction, reason: str) -> FlightEnd:
    """The end that a final reaction of the supervisor means. Raises KeyError for one that is not final."""
    ends: dict[Reaction, type[FlightEnd]] = {
        Reaction.LAND: Aborted,
        Reaction.HAND_BACK: HandedBack,
        Reaction.DISARM: MotorsStopped,
    }
    return ends[reaction](reason)
