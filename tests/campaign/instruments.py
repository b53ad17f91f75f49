"""Instruments put into the processes of one flight after they were forked: they watch, and strike at a simulated moment.

Nothing of either program is changed by them in what it does: the stub's autopilot reports after each of its steps, the
companion after each answer to TIMESYNC. Signals are sent from inside
so that they fall on the same simulated instant each time.
"""

from __future__ import annotations

import math
import os
import signal
import time
from typing import Any

import numpy as np

from campaign.tape import ARMED, BODY_RATE, BOX_WIDTH, MODE, POSITION, QUATERNION, TIME, VELOCITY, Tape

BOX_PERIOD_US = 20_000
WATCH_ENOUGH_S = 3.0
"""How long a flight that a pilot has taken is watched before Ctrl-C ends the watching, simulated s."""
LOCKSTEP_PATIENCE_S = 60.0
"""Wall time that simulated time waits for an answer: on a machine with other work two seconds may pass."""
LONGEST_FLIGHT_S = 150.0
"""Simulated s after arming at which a flight that has not ended is interrupted; nothing planned comes near."""


def obey(autopilot: Any, order: int) -> bool:
    """What `Tape.order` asks of an autopilot's pilot; whether it has to be done again at the next step."""
    if order == 1:
        autopilot.pilot_mode("position")
    elif order == 2:
        autopilot.pilot_sticks(0.0, 0.5, 0.0, 0.5)
        return True
    elif order == 3:
        autopilot.pilot_disarm(True)
    elif order == 4:
        autopilot.killed = True
    elif order == 5:
        autopilot.restart(1.0)
    return False


def watch_stub(
    tape: Tape, gone_at_s: float | None, heading_rad: float = 0.0, has_pilot: bool = False
) -> None:
    """In the stub's process: let every autopilot that is served write the black box, until it is gone.

    It stands with its nose to `heading_rad` (clockwise from north); `has_pilot`: with a radio that is on, sticks centred.
    """
    import sitl_stub.server as served

    plain_gone = served.Server._gone

    class WatchedServer(served.Server):
        def run(self, autopilot: Any) -> None:
            step = autopilot.step
            due_us = before_us = gone_us = 0
            row = np.zeros(BOX_WIDTH)
            _turn(autopilot, heading_rad)
            if has_pilot:
                autopilot.pilot_sticks(0.0, 0.0, 0.0, 0.5)

            def watched_step(*led: Any) -> int:
                nonlocal due_us, before_us, gone_us
                if tape.order and not obey(autopilot, tape.order):
                    tape.order = 0
                sent = step(*led)
                if autopilot.time_us < before_us:
                    gone_us += before_us  # restarted: the box's time goes on
                before_us = autopilot.time_us
                now_us = gone_us + before_us
                if now_us >= due_us:
                    due_us = now_us + BOX_PERIOD_US
                    _fill(row, autopilot)
                    row[TIME] = now_us * 1e-6
                    tape.note_vehicle(row)
                    if gone_at_s is not None and row[TIME] - tape.armed_at_s >= gone_at_s:
                        os.kill(os.getpid(), signal.SIGKILL)
                return int(sent)

            autopilot.step = watched_step
            super().run(autopilot)

        @staticmethod
        def _gone(link: Any) -> bool:
            return tape.companion_gone or plain_gone(link)

    served.BARRIER_PATIENCE_S = LOCKSTEP_PATIENCE_S
    served.Server = WatchedServer  # type: ignore[misc]


def _turn(autopilot: Any, heading_rad: float) -> None:
    from sitl_stub.physics import vehicle as body

    half = 0.5 * heading_rad
    autopilot.core.state[body.QUATERNION_WXYZ] = [math.cos(half), 0.0, 0.0, math.sin(half)]


def _fill(row: Any, autopilot: Any) -> None:
    from sitl_stub.physics import vehicle as body

    state = autopilot.core.state
    row[ARMED] = autopilot.armed
    row[MODE] = autopilot.state.mode.custom_mode
    row[POSITION] = state[body.POSITION_NED]
    row[VELOCITY] = state[body.VELOCITY_NED]
    row[QUATERNION] = state[body.QUATERNION_WXYZ]
    row[BODY_RATE] = state[body.BODY_RATE_FRD]


def watch_companion(tape: Tape, kill_at_s: float | None, interrupts_at_s: tuple[float, ...]) -> None:
    """In the companion's process: note ticks, and strike when the stub's black box says that it is time."""
    from companion.flight.phases import Phase
    from companion.flight.stage import Interrupts, Stage
    from companion.mavlink.link import Link

    answer, enter = Link.answer_timesync, Stage.enter
    strikes = sorted([(at_s, signal.SIGINT) for at_s in interrupts_at_s])
    if kill_at_s is not None:
        strikes.append((kill_at_s, signal.SIGKILL))
    strikes += [(LONGEST_FLIGHT_S, signal.SIGINT), (LONGEST_FLIGHT_S + 2.0, signal.SIGINT)]
    watching_until_s = math.inf
    struck_s = -math.inf

    def watched_answer(link: Any, question: Any) -> None:
        nonlocal struck_s, watching_until_s
        answer(link, question)
        tape.note_tick(question.ts1 * 1e-9, time.monotonic(), time.process_time())
        if tape.now_s >= watching_until_s:
            watching_until_s = math.inf
            os.kill(os.getpid(), signal.SIGINT)
        if strikes and tape.now_s - tape.armed_at_s >= strikes[0][0]:
            number = strikes.pop(0)[1]
            if number == signal.SIGINT:  # closer than this on our clock they are one wish
                time.sleep(max(0.0, struck_s + 2.0 * Interrupts.ONE_WISH_S - time.monotonic()))
                struck_s = time.monotonic()
            os.kill(os.getpid(), number)

    def watched_enter(stage: Any, phase: Phase) -> None:
        nonlocal watching_until_s
        if phase is Phase.WATCH:
            watching_until_s = tape.now_s + WATCH_ENOUGH_S
        enter(stage, phase)

    Link.answer_timesync = watched_answer  # type: ignore[method-assign, assignment]
    Stage.enter = watched_enter  # type: ignore[method-assign, assignment]
