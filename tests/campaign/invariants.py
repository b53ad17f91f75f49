"""What has to hold of every flight, each as one function of the evidence. Nothing here shares code with the supervisor.

A function returns `KEPT`, `NOT_JUDGED` where the flight says nothing about it, or what is wrong in one sentence.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from campaign.evidence import OUTCOMES, Evidence
from campaign.faults import Fault
from campaign.flying import rests
from campaign.tape import POSITION, TICK_CPU, TICK_TIME, TICK_WALL, TIME, VELOCITY
from campaign.wire import (
    COMMAND_LONG,
    DO_SET_MODE,
    LOCAL_POSITION_NED,
    RC_CHANNELS,
    SET_ATTITUDE_TARGET,
    SETPOINTS,
    TIMESYNC,
    Frame,
    armed_of,
    command_of,
    is_ours,
    mode_of,
    setpoint_numbers,
    text_of,
)

KEPT, NOT_JUDGED = "", "-"

LOST_LOG_S = 0.2
"""What a killed flight's log may lose, on the wall clock."""
TILT_BOUND_DEG = 65.0
"""The supervisor lands beyond 50° for 0.3 s; what a vehicle may turn further until it obeys is on top."""
FENCE_REACTION_S = 0.25
"""From the first position outside to the end of our control: the limit acts at once, a position comes every 20 to 33 ms."""
FENCE_SLACK_M = 0.06
"""The estimate of where it stood when it was armed wanders by as much between two messages."""
FENCE_BLUR_M = {"mocap": 0.15, "perfect": 0.15, "gps": 1.0}
"""How far the truth may be from the estimate, by preset, so that the supervisor could not have seen it."""
STICK_TRAVEL_US = 300.0
"""A stick moved this far counts for certain; the companion's own threshold is half."""
LEVEL_S = 7.0
"""How long setpoints keep a vehicle level while the autopilot does not take the modes that are asked for."""
LANDS_WITHIN_S = 85.0
LONGEST_S = 150.0
QUIET_RMS_M = {"mocap": 0.25, "perfect": 0.25}
"""What a flight to which nothing was done may be off while tracking, by estimator; GPS wanders by more than it tracks."""
TRUTH_BENDING = ("motor_failure", "reboot", "pilot_disarm", "pilot_kill", "pilot_mode", "pilot_sticks")
FALLING = ("motor_failure", "reboot", "pilot_disarm", "pilot_kill")
LINK = (
    "link_loss",
    "link_delay",
    "link_jitter",
    "link_reorder",
    "link_corrupt",
    "link_truncate",
    "link_pieces",
)
CLOCKS = ("clock_jump", "clock_drift", "reboot")
MOVED_FRAMES = ("estimator_reset", "estimator_divergence", "gps_loss")
"""The local frame is reset, at once or when the fault ends, and the companion moves its fence along with it."""
ESTIMATES = ("estimator_reset", "estimator_divergence", "estimator_invalid", "gps_loss")
ENDS_WITHIN_S = {
    "battery_critical": 6.5,  # 5 s of `battery_remaining.land`, and SYS_STATUS once a second
    "estimator_invalid": 1.6,  # 0.3 s, and the estimator's status once a second
    "stream_stop": 1.0,  # 0.4 s of `position_age_s` or `attitude_age_s`
    "gps_loss": 7.5,  # the estimator gives up after 5 s
}
"""Faults that may not be flown with, and how long after they began our control may last, s."""
BATTERY_LAND = 0.12

Invariant = Callable[[Evidence], str]


def last_word(e: Evidence) -> str:
    """Exit code, last line and the log's last event say the same, and one of them is there."""
    if e.killed:
        return NOT_JUDGED
    if e.code is None:
        return NOT_JUDGED  # `bounded_time` says so
    outcome, text = e.ending
    if not outcome:
        if e.code == 2 and e.words and e.words[-1].startswith("error: "):
            return KEPT
        return f"exit code {e.code} without a last word; the last line is {e.words[-1] if e.words else 'missing'!r}"
    if OUTCOMES[outcome] != e.code:
        return f"it says {outcome!r}, which is exit code {OUTCOMES[outcome]}, but ended with {e.code}"
    logged = [event for event in e.events if event.kind == "ended"]
    if e.log_trouble:
        return KEPT
    if len(logged) != 1 or logged[0].fields.get("outcome") != outcome or logged[0].fields.get("text") != text:
        return f"the last line says {outcome}: {text}; the log says {[event.fields for event in logged]}"
    return KEPT


def truthful_end(e: Evidence) -> str:
    """What the last word claims is so: completed, landed, disarmed, handed back, refused."""
    outcome, text = e.ending
    if e.killed or not outcome or not len(e.box):
        return NOT_JUDGED
    then = e.at(e.companion_ended_s + 0.1)  # the black box writes every 20 ms, and learns of the end by then
    armed = bool(e.armed[then])
    down = e.height_m[then] < 0.3 and float(np.linalg.norm(e.box[then, VELOCITY])) < 0.3
    claims_down = "landed and disarmed" in text or outcome == "completed"
    if claims_down and (armed or not down):
        return f"says {text!r}, but the vehicle is {'armed' if armed else 'disarmed'}, {_height(e)} m up"
    if outcome == "completed" and e.tracked_s < e.planned.duration_s - 0.1 and not e.log_trouble:
        return f"completed, but tracked {e.tracked_s:.2f} s of {e.planned.duration_s:g} s"
    if outcome == "refused" and armed:
        return "refused, but the vehicle is armed"
    if "disarmed later" in text and armed:
        return "says that it was disarmed later, but the vehicle is armed"
    if e.planned.gone_at_s is not None and e.stub_code == -9 and outcome not in ("link lost", "refused"):
        return f"the autopilot was gone, and it says {outcome}: {text}"
    if outcome == "link lost" and e.planned.gone_at_s is None:
        return f"says {text!r}, but the autopilot was there"
    if outcome == "interrupted" and not e.planned.interrupts_at_s:
        return f"interrupted, but nobody did, unless it had not ended by itself after {LONGEST_S:g} s"
    if outcome == "pilot took over" and "sticks" not in text and armed and e.planned.faults == ():
        return "a pilot took over, but there was none"
    if outcome == "handed back" and "LAND" not in text:
        later = e.at(e.companion_ended_s + 2.5)
        if e.armed[later] and is_ours(e.planned.firmware, int(e.modes[later])):
            return "handed back, but the vehicle is still in the mode that waits for our setpoints"
    return KEPT


def safe_afterwards(e: Evidence) -> str:
    """With the companion gone or killed, the autopilot has landed the vehicle, or holds it still where that is its way."""
    if not len(e.box) or e.planned.has(*FALLING, "estimator_divergence", "autopilot_gone"):
        return NOT_JUDGED
    last = e.box[-1]
    if e.tilt_deg[-1] > TILT_BOUND_DEG:
        return NOT_JUDGED  # it lies on its back: `tilt` judges whether it might
    if e.ending[0] == "pilot took over" and e.planned.has("pilot_mode", "pilot_sticks"):
        return NOT_JUDGED  # he flies it
    if not e.armed[-1]:
        if e.height_m[-1] > 0.4:
            return f"disarmed {e.height_m[-1]:.1f} m up"
        return KEPT
    if rests(last) and _may_hang(e):
        return KEPT
    waited_s = last[TIME] - e.companion_ended_s
    return (
        f"armed and {e.height_m[-1]:.1f} m up, moving at {float(np.linalg.norm(last[VELOCITY])):.1f} m/s in mode "
        f"{int(e.modes[-1]):#x}, {waited_s:.0f} s after the companion's end ({e.ending[0] or 'killed'})"
    )


def _may_hang(e: Evidence) -> bool:
    """ArduCopter without targets levels and keeps its height in GUIDED; one handed back or taken keeps its place."""
    if e.planned.firmware == "ardupilot":
        return True
    return e.ending[0] in ("handed back", "pilot took over") or e.planned.has("pilot_mode", "pilot_sticks")


def setpoints_after_takeover(e: Evidence) -> str:
    """Once a frame has said that the mode is not ours, or disarmed: at most one setpoint more.

    Sticks that moved do not change the mode by themselves everywhere: until it has changed setpoints keep the vehicle
    level, since the last one of the law would stand for as long as the autopilot's timeout. So only level ones may
    follow, and not for longer than LEVEL_S.
    """
    if e.log_trouble or not e.wire.frames:
        return NOT_JUDGED
    moment, why = _takeover(e)
    if moment is None:
        return KEPT
    after = [
        frame for frame in e.wire.frames[moment + 1 :] if frame.outgoing and frame.message_id in SETPOINTS
    ]
    if why == "moved sticks":
        seen_s = e.wire.frames[moment].time_s
        wild = next((f for f in after[1:] if not _is_level(f) or f.time_s > seen_s + LEVEL_S), None)
        if wild is not None:
            return f"a setpoint that is not level at {wild.time_s:.2f} s, after {why} at {seen_s:.2f} s"
        gone = next(
            (i for i, f in enumerate(e.wire.frames) if i > moment and _is_left(e.planned.firmware, f)), None
        )
        if gone is None:
            return KEPT
        after = [f for f in e.wire.frames[gone + 1 :] if f.outgoing and f.message_id in SETPOINTS]
    if len(after) > 1:
        seen_s = e.wire.frames[moment].time_s
        return f"{len(after)} setpoints after {why} at {seen_s:.2f} s, the last at {after[-1].time_s:.2f} s"
    return KEPT


def _is_left(firmware: str, frame: Frame) -> bool:
    if frame.outgoing:
        return False
    mode = mode_of(frame)
    return (mode is not None and not is_ours(firmware, mode)) or armed_of(frame) is False


def _is_level(frame: Frame) -> bool:
    """Whether a setpoint asks for level flight; one of rates or torques does not tell."""
    if frame.message_id != SET_ATTITUDE_TARGET or frame.payload[38:39] != b"\x07":
        return True
    _, x, y, _ = setpoint_numbers(frame)[:4]
    return 1.0 - 2.0 * (x * x + y * y) > math.cos(math.radians(1.0))


def never_taken_back(e: Evidence) -> str:
    """After a takeover neither our mode nor arming is asked for again."""
    if e.log_trouble or not e.wire.frames:
        return NOT_JUDGED
    moment, why = _takeover(e)
    if moment is None:
        return KEPT
    for frame in e.wire.frames[moment + 1 :]:
        if frame.outgoing and frame.message_id == COMMAND_LONG:
            command = command_of(frame)
            if command.arms or _asks_for_ours(e, frame):
                return (
                    f"command {command.number} {command.parameters[:2]} at {frame.time_s:.2f} s, after {why}"
                )
    return KEPT


def _takeover(e: Evidence) -> tuple[int | None, str]:
    """Index of the first frame that says that the vehicle is no longer the companion's own, and what it says."""
    firmware = e.planned.firmware
    asked = ours = was_armed = False
    rest: tuple[float, ...] | None = None
    moved = 0
    for index, frame in enumerate(e.wire.frames):
        if frame.outgoing:
            asked = asked or _asks_for_ours(e, frame)
            continue
        if (mode := mode_of(frame)) is not None:
            if ours and not is_ours(firmware, mode):
                return index, f"mode {mode:#x}"
            ours = ours or (asked and is_ours(firmware, mode))
        if (armed := armed_of(frame)) is not None:
            if was_armed and not armed:
                return index, "disarming"
            was_armed = was_armed or (ours and armed)
        if ours and frame.message_id == RC_CHANNELS:
            sticks = frame.unpack("<I5H")[1:5]
            if 0 in sticks or 65535 in sticks:
                continue
            rest = rest or sticks
            moved = (
                moved + 1
                if max(abs(a - b) for a, b in zip(sticks, rest, strict=True)) > STICK_TRAVEL_US
                else 0
            )
            if moved >= 2:
                return index, "moved sticks"
    return None, ""


def _asks_for_ours(e: Evidence, frame: Frame) -> bool:
    if frame.message_id != COMMAND_LONG:
        return False
    command = command_of(frame)
    if command.number != DO_SET_MODE:
        return False
    main = int(command.parameters[1])
    return main == 6 if e.planned.firmware == "px4" else main == 4


def arming(e: Evidence) -> str:
    """Armed only in our mode, never a second time, and not by flights that were refused."""
    if e.log_trouble or not e.wire.frames:
        return NOT_JUDGED
    ours = was_armed = False
    for frame in e.wire.frames:
        if not frame.outgoing:
            if (mode := mode_of(frame)) is not None:
                ours = is_ours(e.planned.firmware, mode)
            was_armed = was_armed or bool(armed_of(frame))
        elif frame.message_id == COMMAND_LONG and command_of(frame).arms:
            if not ours:
                return f"ARM at {frame.time_s:.2f} s although the mode was not ours"
            if was_armed:
                return f"ARM at {frame.time_s:.2f} s although it had been armed before"
    return KEPT


def numbers(e: Evidence) -> str:
    """No setpoint carries a number that is none, a thrust outside 0..1 or a quaternion off unit length."""
    if e.log_trouble or not e.setpoints:
        return NOT_JUDGED
    for frame in e.setpoints:
        values = setpoint_numbers(frame)
        if not all(map(math.isfinite, values)):
            return f"a setpoint at {frame.time_s:.2f} s holds {values}"
        if frame.message_id == SET_ATTITUDE_TARGET:
            length, thrust = math.hypot(*values[:4]), values[7]
            if not -1e-6 <= thrust <= 1.0 + 1e-6:
                return f"thrust {thrust:g} at {frame.time_s:.2f} s"
            if abs(length - 1.0) > 1e-2 and any(values[:4]):
                return f"a quaternion of length {length:g} at {frame.time_s:.2f} s"
        elif max(map(abs, values)) > 1.0 + 1e-6:
            return f"actuator controls {values[:4]} at {frame.time_s:.2f} s"
    return KEPT


def fence_as_seen(e: Evidence) -> str:
    """By the positions that the companion was told: outside the fence our control ends within FENCE_REACTION_S."""
    moved = [kind for kind in e.planned.kinds if kind in MOVED_FRAMES]
    if e.log_trouble or not e.setpoints or e.planned.has(*CLOCKS) or (moved and e.planned.has(*LINK)):
        return NOT_JUDGED
    frame_resets = {text for kind in moved for text in (f"fault: {kind}", f"fault: {kind} off")}
    home: tuple[float, ...] | None = None
    armed = False
    for index, frame in enumerate(e.wire.frames):
        if frame.outgoing:
            continue
        if text_of(frame) in frame_resets:
            return KEPT  # from here on the fence stands elsewhere
        armed = armed or bool(armed_of(frame))
        if frame.message_id != LOCAL_POSITION_NED:
            continue
        place = frame.unpack("<I3f")[1:]
        if not armed:
            home = place
        elif home is not None and math.dist(place[:2], home[:2]) > e.planned.fence_radius_m + FENCE_SLACK_M:
            return _ended_by(e, index, f"{math.dist(place[:2], home[:2]):.2f} m from home")
    return KEPT


def _ended_by(e: Evidence, index: int, where: str) -> str:
    """Whether our control had ended, or the end was asked for, soon after a frame."""
    crossed_s = e.wire.frames[index].time_s
    for frame in e.wire.frames[:index]:
        if frame.outgoing and frame.message_id == COMMAND_LONG and _leaves(e, frame):
            return KEPT
    for frame in e.wire.frames[index:]:
        if frame.time_s > crossed_s + FENCE_REACTION_S:
            break
        if frame.outgoing and frame.message_id == COMMAND_LONG and _leaves(e, frame):
            return KEPT
    late = [frame for frame in e.setpoints if frame.time_s > crossed_s + FENCE_REACTION_S]
    if not late:
        return KEPT
    last_s = late[-1].time_s
    return f"{where}, fence {e.planned.fence_radius_m:g} m, at {crossed_s:.2f} s, and setpoints until {last_s:.2f} s"


def _leaves(e: Evidence, frame: Frame) -> bool:
    return command_of(frame).number == DO_SET_MODE and not _asks_for_ours(e, frame)


def fence_in_truth(e: Evidence) -> str:
    """By the true position: not further out than the estimate can be wrong while we are in control."""
    if not len(e.box) or not e.setpoints or e.planned.has(*CLOCKS, *ESTIMATES):
        return NOT_JUDGED
    away = np.hypot(*(e.box[:, POSITION][:, :2] - e.box[0, POSITION][:2]).T)
    beyond = away > e.planned.fence_radius_m + FENCE_BLUR_M[e.planned.estimator]
    if not beyond.any():
        return KEPT
    crossed_s = float(e.box[int(np.argmax(beyond)), TIME])
    end = next(
        (f.time_s for f in e.wire.frames if f.outgoing and f.message_id == COMMAND_LONG and _leaves(e, f)),
        math.inf,
    )
    last_s = min(end, e.setpoints[-1].time_s)
    if last_s > crossed_s + FENCE_REACTION_S:
        return f"truly outside the fence at {crossed_s:.2f} s, and in control until {last_s:.2f} s"
    return KEPT


def tilt(e: Evidence) -> str:
    """The true tilt in the air stays bounded."""
    if not len(e.box) or e.planned.has(*TRUTH_BENDING):
        return NOT_JUDGED
    if e.planned.level != "attitude" and e.planned.has(*LINK, *CLOCKS, "stream_stop"):
        return NOT_JUDGED  # with rates or torques for setpoints half a second late or missing tips any vehicle over
    flying = (e.height_m > 0.15) & (e.armed > 0)
    if e.killed and e.planned.level == "actuator":
        flying &= e.box[:, TIME] <= e.companion_ended_s  # nobody stabilises until the autopilot notices
    if not flying.any():
        return NOT_JUDGED
    worst = int(np.argmax(np.where(flying, e.tilt_deg, 0.0)))
    if e.tilt_deg[worst] > TILT_BOUND_DEG:
        return f"tilted by {e.tilt_deg[worst]:.0f}° at {e.box[worst, TIME]:.2f} s"
    return KEPT


def log_whole(e: Evidence) -> str:
    """The log can be read; it is whole, or of a killed flight, and then it lacks at most LOST_LOG_S."""
    if not e.killed and e.code == 2 and not e.ending[0]:
        return NOT_JUDGED  # nothing was begun
    if e.log_trouble:
        return f"the log cannot be read: {e.log_trouble}"
    if not e.killed and (e.log_cut or not e.wire.whole):
        return f"the log is not whole: {e.log_cut or 'no footer'}"
    if e.log_losses:
        return f"the log lost records: {e.log_losses}"
    if not len(e.ticks):
        return KEPT
    answered_s = [f.unpack("<qq")[1] * 1e-9 for f in e.wire.frames if _is_answer(f)]
    logged_s = answered_s[-1] if answered_s else -math.inf
    same = np.flatnonzero(np.abs(e.ticks[:, TICK_TIME] - logged_s) < 1e-6)
    times = sum(
        abs(time_s - logged_s) < 1e-6 for time_s in answered_s
    )  # a clock that jumps back comes by again
    later = e.ticks[same[min(times, len(same)) - 1] + 1 :] if len(same) else e.ticks
    if not len(later):
        return KEPT
    wall_s = float(e.ticks[-1, TICK_WALL] - later[0, TICK_WALL])
    cpu_s = float(e.ticks[-1, TICK_CPU] - later[0, TICK_CPU])
    lost_s = min(wall_s, 2.0 * cpu_s)  # a machine with other work lets both threads wait
    if not e.killed:
        return f"the log ends at {logged_s:.2f} s, the flight at {e.ticks[-1, TICK_TIME]:.2f} s"
    if lost_s > LOST_LOG_S:
        return f"the log lost the last {wall_s:.2f} s ({cpu_s:.2f} s of processor time)"
    return KEPT


def _is_answer(frame: Frame) -> bool:
    return frame.outgoing and frame.message_id == TIMESYNC and frame.unpack("<q")[0] != 0


def no_traceback(e: Evidence) -> str:
    """Neither program shows a traceback, and the stub ends as it was asked to."""
    text = "\n".join(e.words)
    if "Traceback (most recent call last)" in text or (
        e.code is not None and e.code not in (0, 1, 2, 3) and not e.killed
    ):
        return f"the companion ended with {e.code}: {e.words[-1] if e.words else 'nothing said'}"
    gone = e.planned.gone_at_s is not None and e.stub_code == -9
    if "Traceback" in e.stub_words or (e.stub_code != 0 and not gone):
        lines = e.stub_words.strip().splitlines()
        return f"the stub ended with {e.stub_code}: {lines[-1] if lines else 'nothing said'}"
    return KEPT


def bounded_time(e: Evidence) -> str:
    """The companion ends by itself."""
    if e.code is None:
        return f"still running after {e.wall_s:.0f} s"
    flown_s = e.companion_ended_s - e.armed_at_s
    if flown_s > LONGEST_S and not e.killed:
        return f"had not ended {flown_s:.0f} s after arming"
    return KEPT


def quiet_flight(e: Evidence) -> str:
    """Nothing was done to it, and it varies within what the profile claims to bear: flown as planned, and close."""
    bound = QUIET_RMS_M.get(e.planned.estimator)
    if not e.planned.quiet or bound is None:
        return NOT_JUDGED
    outcome, text = e.ending
    if outcome != "completed":
        return f"nothing was done to it, and it ended as {outcome}: {text}"
    if not e.rms_error_m <= bound:
        return f"tracked with an error of {e.rms_error_m:.2f} m RMS"
    return KEPT


def _height(e: Evidence) -> str:
    return f"{e.height_m[e.at(e.companion_ended_s)]:.1f}"


def serious_fault(e: Evidence) -> str:
    """A fault that may not be flown with ends our control in its time, counted from when the stub told of it."""
    if e.killed or e.log_trouble or e.planned.has(*LINK, *CLOCKS):
        return NOT_JUDGED
    judged = NOT_JUDGED
    for fault in e.planned.faults:
        limit_s = ENDS_WITHIN_S.get(fault.kind)
        lasts_s = math.inf if fault.for_s is None else fault.for_s
        if limit_s is None or lasts_s < limit_s or not _is_serious(fault):
            continue
        began_s = next((f.time_s for f in e.wire.frames if text_of(f) == f"fault: {fault.kind} on"), math.inf)
        late = [frame for frame in e.setpoints if frame.time_s > began_s + limit_s]
        if late and not _landing_by(e, began_s + limit_s):
            return f"{fault.kind} since {began_s:.2f} s, and setpoints until {late[-1].time_s:.2f} s"
        judged = KEPT
    return judged


def _is_serious(fault: Fault) -> bool:
    if fault.kind == "battery_critical":
        remaining = fault.value("remaining")
        return isinstance(remaining, float) and remaining < BATTERY_LAND - 0.01
    if fault.kind == "stream_stop":
        messages = fault.value("messages")
        return isinstance(messages, tuple) and "LOCAL_POSITION_NED" in messages
    return True


def _landing_by(e: Evidence, time_s: float) -> bool:
    """Whether LAND or another mode had been asked for by then: setpoints go on until it is there."""
    return any(
        f.outgoing and f.message_id == COMMAND_LONG and _leaves(e, f) and f.time_s <= time_s
        for f in e.wire.frames
    )


def heard_pilot(e: Evidence) -> str:
    """A flight that a pilot took in the air ends as his: it does not go on, and claims nothing else."""
    if e.killed or not e.planned.has("pilot_mode", "pilot_disarm") or e.log_trouble:
        return NOT_JUDGED
    moment, _ = _takeover(e)
    if moment is None or e.ending[0] != "completed":
        return KEPT
    landing = any(
        f.outgoing and f.message_id == COMMAND_LONG and _leaves(e, f) for f in e.wire.frames[: moment + 1]
    )
    return KEPT if landing else "completed although a pilot had taken it"


INVARIANTS: dict[str, Invariant] = {
    "setpoints after takeover": setpoints_after_takeover,
    "never taken back": never_taken_back,
    "pilot heard": heard_pilot,
    "serious fault ends it": serious_fault,
    "fence as seen": fence_as_seen,
    "fence in truth": fence_in_truth,
    "tilt bounded": tilt,
    "no NaN on the wire": numbers,
    "no arming unasked": arming,
    "safe afterwards": safe_afterwards,
    "last word": last_word,
    "truthful end": truthful_end,
    "log whole": log_whole,
    "no traceback": no_traceback,
    "bounded time": bounded_time,
    "quiet flight": quiet_flight,
}
"""All of them, by the names that the table uses."""


def judge(e: Evidence) -> dict[str, str]:
    """Every invariant's word on a flight. A judge that stumbles is itself a finding."""
    words = {}
    for name, invariant in INVARIANTS.items():
        try:
            words[name] = invariant(e)
        except Exception as error:
            words[name] = f"could not be judged: {type(error).__name__}: {error}"
    return words
