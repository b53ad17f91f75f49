"""Put into the companion's process of one cell: waits for the cell's moment by simulated time, and lets the end happen."""

from __future__ import annotations

import math
import os
import signal
import time
from typing import Any

from campaign.tape import Tape

from handover.cells import LIFT_OFF_HOVERS, MIDDLE_S, Cell

SILENCE_S = 0.4
"""`flight.safety.silence_s` of cells whose link is lost, our clock: a simulation goes on meanwhile."""
OUTAGE_S = 1.5
"""How long a link that comes back is away, our clock."""
HOLDS_S = 4.0
"""How long the supervisor's hold lasts before it lands, simulated."""
_TWICE_S = 0.6
_DO_SET_MODE, _ARM_DISARM, _COMMAND_ACK, _TIMESYNC, _COMMAND_LONG = 176, 400, 77, 111, 76
ORDERS = {
    "pilot by mode": 1,
    "pilot by sticks": 2,
    "pilot disarms": 3,
    "pilot kills": 4,
    "autopilot restarts": 5,
}
"""What the stub's process is asked to do (`campaign.instruments`)."""


class Strike:
    """One cell's end."""

    def __init__(self, cell: Cell, tape: Tape) -> None:
        self._cell = cell
        self._tape = tape
        self._stage: Any = None
        self._phase_began_s = math.nan
        self._struck = False
        self._now_s = 0.0
        self._lost_until_s = -math.inf
        self._drops_left = 0
        self._drop_acks = False

    def install(self) -> None:
        """Patch the classes through which a flight passes anyway; nothing happens before the moment has come."""
        from companion.flight.stage import Stage
        from companion.mavlink.link import Link
        from companion.mavlink.received import read

        enter, receive, send, believe = Stage.enter, Link.receive, Link.send, Link._believe

        def watched_enter(stage: Any, phase: Any) -> None:
            enter(stage, phase)
            self._stage = stage
            if phase.value == self._cell.phase:
                self._phase_began_s = self._now_s
                self._look()

        def watched_receive(link: Any, timeout_s: float) -> Any:
            message = receive(link, timeout_s)
            self._now_s = link.autopilot_time_s
            self._look()
            if message is None:
                return None
            return None if self._drop_acks and message.get_msgId() == _COMMAND_ACK else message

        def watched_believe(link: Any, frame: bytes) -> Any:
            if time.monotonic() >= self._lost_until_s:
                return believe(link, frame)
            message = read(frame)
            if message is not None and message.msg_id == _TIMESYNC and not message.tc1:
                link.answer_timesync(message)  # a simulation in lockstep would wait for it
            return None

        def watched_send(link: Any, message: Any) -> bool:
            number = message.get_msgId()
            if time.monotonic() < self._lost_until_s and not (number == _TIMESYNC and message.tc1):
                return True
            if (
                self._drops_left
                and number == _COMMAND_LONG
                and message.command in (_DO_SET_MODE, _ARM_DISARM)
            ):
                self._drops_left -= 1
                return True
            return send(link, message)

        Stage.enter = watched_enter  # type: ignore[method-assign]
        Link._believe = watched_believe  # type: ignore[method-assign]
        Link.receive = watched_receive  # type: ignore[method-assign]
        Link.send = watched_send  # type: ignore[method-assign]

    def _look(self) -> None:
        """Strike when the moment has come."""
        if self._struck or math.isnan(self._phase_began_s) or not self._is_time():
            return
        self._struck = True
        self._tape.struck_at_s = self._tape.now_s or self._now_s
        self._happen()

    def _is_time(self) -> bool:
        cell = self._cell
        if cell.moment == "begin":
            return True
        if cell.phase == "lift-off":
            loop = self._stage.loop
            return bool(loop.lift_off_thrust >= LIFT_OFF_HOVERS[cell.moment] * loop.hover_thrust)
        return self._now_s - self._phase_began_s >= MIDDLE_S[cell.phase]

    def _happen(self) -> None:
        end = self._cell.end
        if end in ORDERS:
            self._tape.order = ORDERS[end]
        elif end in ("ctrl-c", "ctrl-c twice"):
            os.kill(os.getpid(), signal.SIGINT)
            if end == "ctrl-c twice":
                time.sleep(_TWICE_S)
                os.kill(os.getpid(), signal.SIGINT)
        elif end in ("sigterm", "sighup"):
            os.kill(os.getpid(), signal.SIGTERM if end == "sigterm" else signal.SIGHUP)
        elif end == "dead terminal":
            reading, writing = os.pipe()
            os.close(reading)
            os.dup2(writing, 1)
            os.dup2(writing, 2)
        elif end.startswith("supervisor"):
            self._supervise({"lands": "LAND", "holds": "HOLD", "hands back": "HAND_BACK"}[end[11:]])
        elif end in ("law refuses", "exception in the law"):
            self._break_law(end == "law refuses")
        elif "frame lost" in end:
            self._drops_left = 1 if end.endswith("once") else 3
            if end.startswith("hold"):
                self._supervise("HAND_BACK")
            else:
                os.kill(os.getpid(), signal.SIGINT)
        elif end == "ack lost":
            self._drop_acks = True
            os.kill(os.getpid(), signal.SIGINT)
        elif end.startswith("link lost"):
            self._lost_until_s = time.monotonic() + OUTAGE_S if end.endswith("back") else math.inf
        elif end == "killed and started again":
            os.kill(os.getpid(), signal.SIGKILL)

    @staticmethod
    def _supervise(reaction: str) -> None:
        from companion.config.safety import Reaction
        from companion.flight.supervisor import Supervisor

        judge = Supervisor.judge
        began_s: list[float] = []

        def judged(supervisor: Any, state: Any, *given: Any, **named: Any) -> Any:
            began_s.append(state.time_s)
            held = state.time_s - began_s[0] > HOLDS_S
            wanted = Reaction.LAND if held and reaction == "HOLD" else Reaction[reaction]
            judgement = judge(supervisor, state, *given, **named)
            return judgement._replace(reaction=wanted, reason="by the matrix")

        Supervisor.judge = judged  # type: ignore[method-assign]

    @staticmethod
    def _break_law(refuses: bool) -> None:
        from companion.control.law import ControlLaw, StepRefused

        def broken(*_: Any) -> Any:
            raise StepRefused("by the matrix") if refuses else ZeroDivisionError("by the matrix")

        ControlLaw.step_packed = broken  # type: ignore[method-assign]
