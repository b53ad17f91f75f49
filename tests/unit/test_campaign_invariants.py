"""Every invariant of the campaign: kept by a good flight, and broken by what it is there for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from campaign.evidence import Evidence, LogEvent
from campaign.faults import Fault
from campaign.invariants import INVARIANTS, KEPT, NOT_JUDGED, judge
from campaign.tape import ARMED, POSITION, QUATERNION, VELOCITY
from campaign.wire import ARM_DISARM, DO_SET_MODE
from campaign_evidence import (
    END_S,
    LAND,
    LAND_MODE,
    OFFBOARD,
    OFFBOARD_MODE,
    OVER_S,
    PLAN,
    answers,
    box,
    command,
    flight_frames,
    frame,
    good,
    heartbeat,
    mav,
    position,
    setpoint,
    sticks,
    with_row,
)

LAND_AT = next(i for i, one in enumerate(flight_frames()) if one.time_s >= OVER_S)
GUST = Fault("gust", "airborne", 1.0, 1.0)


def said(name: str, evidence: Evidence) -> str:
    return INVARIANTS[name](evidence)


def test_a_good_flight_keeps_everything() -> None:
    words = judge(good())
    assert {name: word for name, word in words.items() if word not in (KEPT, NOT_JUDGED)} == {}
    assert {name for name, word in words.items() if word == NOT_JUDGED} == {
        "pilot heard",
        "serious fault ends it",
    }


def test_a_judge_that_stumbles_is_a_finding() -> None:
    words = judge(good(box=np.zeros((5, 2))))
    assert any(word.startswith("could not be judged") for word in words.values())


@pytest.mark.parametrize("late", [0, 1])
def test_one_setpoint_after_a_takeover_is_none_too_many(late: int) -> None:
    frames = [*flight_frames(), *(setpoint(OVER_S + 0.2) for _ in range(late))]
    assert said("setpoints after takeover", good(frames=frames)) == KEPT


@pytest.mark.parametrize(
    "sign",
    [
        [heartbeat(10.0, LAND, True)],
        [heartbeat(10.0, OFFBOARD, False)],
    ],
    ids=["mode", "disarmed"],
)
def test_setpoints_after_a_takeover_are_noticed(sign: list) -> None:
    frames = flight_frames()
    frames[100:100] = sign
    assert "setpoints after" in said("setpoints after takeover", good(frames=frames))


MOVED = [sticks(9.9, 1500), *[sticks(10.0, 1900)] * 2]


@pytest.mark.parametrize(
    ("later", "word"),
    [
        ([*(setpoint(10.1 + 0.1 * i) for i in range(5)), heartbeat(10.7, LAND, True)], ""),
        ([setpoint(10.1), setpoint(10.2, 0.4, (0.996, 0.087, 0, 0)), heartbeat(10.7, LAND, True)], "10.20 s"),
        ([setpoint(10.1), setpoint(17.1)], "17.10 s"),
        ([heartbeat(10.1, LAND, True), setpoint(10.2), setpoint(10.3)], "setpoints after"),
    ],
    ids=["level until the mode shows", "tilted by 10°", "for longer than 7 s", "after the mode has shown"],
)
def test_after_moved_sticks_only_level_setpoints_may_follow(later: list, word: str) -> None:
    frames = [*flight_frames()[:100], *MOVED, *later]
    kept = said("setpoints after takeover", good(frames=frames))
    assert word in kept if word else kept == KEPT


def test_a_single_glitch_of_a_stick_is_no_takeover() -> None:
    frames = flight_frames()
    frames[100:100] = [sticks(9.9, 1500), sticks(10.0, 1900), sticks(10.1, 1500)]
    assert said("setpoints after takeover", good(frames=frames)) == KEPT


@pytest.mark.parametrize(
    "asked",
    [command(OVER_S + 1.0, DO_SET_MODE, 1, *OFFBOARD_MODE), command(OVER_S + 1.0, ARM_DISARM, 1)],
    ids=["mode", "arm"],
)
def test_a_vehicle_that_is_taken_back_is_noticed(asked: object) -> None:
    assert said("never taken back", good(frames=[*flight_frames(), asked])) != KEPT


def test_arming_before_our_mode_or_twice_is_noticed() -> None:
    first = [command(0.5, ARM_DISARM, 1), *flight_frames()]
    assert "not ours" in said("no arming unasked", good(frames=first))
    frames = flight_frames()
    frames.insert(100, command(10.0, ARM_DISARM, 1))
    assert "armed before" in said("no arming unasked", good(frames=frames))


def test_a_flight_that_goes_on_after_the_pilot_took_it_is_noticed() -> None:
    plan = replace(PLAN, faults=(Fault("pilot_mode", "airborne", 1.0, None),))
    frames = flight_frames()
    frames[100:100] = [heartbeat(10.0, LAND, True)]
    assert "pilot" in said("pilot heard", good(planned=plan, frames=frames))
    assert said("pilot heard", good(planned=plan)) == KEPT


def announced(time_s: float, text: str) -> object:
    return frame(mav.MAVLink_statustext_message(5, text.encode()), time_s)


def test_a_fault_that_must_not_be_flown_with_ends_the_flight_in_time() -> None:
    plan = replace(PLAN, faults=(Fault("estimator_invalid", "airborne", 5.0, None),))
    frames = flight_frames()
    frames[200:200] = [announced(13.0, "fault: estimator_invalid on")]
    assert "since 13.00 s" in said("serious fault ends it", good(planned=plan, frames=frames))
    frames[240:] = [command(14.0, DO_SET_MODE, 1, *LAND_MODE), setpoint(14.0)]
    assert said("serious fault ends it", good(planned=plan, frames=frames)) == KEPT
    short = replace(PLAN, faults=(Fault("estimator_invalid", "airborne", 5.0, 0.5),))
    assert said("serious fault ends it", good(planned=short)) == NOT_JUDGED


@pytest.mark.parametrize(("remaining", "word"), [(0.05, "battery_critical since"), (0.2, NOT_JUDGED)])
def test_an_empty_battery_ends_a_flight_and_half_an_empty_one_does_not(remaining: float, word: str) -> None:
    plan = replace(
        PLAN, faults=(Fault("battery_critical", "airborne", 1.0, None, (("remaining", remaining),)),)
    )
    frames = [announced(5.0, "fault: battery_critical on"), *flight_frames()]
    assert word in said("serious fault ends it", good(planned=plan, frames=frames))


def outside(until_s: float) -> Evidence:
    frames = [frame for frame in flight_frames()[:LAND_AT] if frame.time_s <= until_s]
    return good(frames=[*frames[:100], position(10.0, 2.5), *frames[100:]])


def test_control_that_goes_on_outside_the_fence_is_noticed() -> None:
    assert "setpoints until" in said("fence as seen", outside(12.0))
    in_time = [
        *flight_frames()[:60],
        position(7.0, 2.5),
        command(7.1, DO_SET_MODE, 1, *LAND_MODE),
        setpoint(7.2),
    ]
    assert said("fence as seen", good(frames=in_time)) == KEPT


def test_a_fence_that_moved_with_the_frame_is_judged_up_to_then() -> None:
    plan = replace(PLAN, faults=(Fault("estimator_reset", "airborne", 1.0, None),))
    late = outside(12.0)
    assert "setpoints until" in said("fence as seen", replace(late, planned=plan))
    reset = [announced(4.5, "fault: estimator_reset"), *late.wire.frames]
    assert said("fence as seen", good(frames=reset, planned=plan)) == KEPT
    lossy = replace(plan, faults=(*plan.faults, Fault("link_loss", "airborne", 1.0, 1.0)))
    assert said("fence as seen", replace(late, planned=lossy)) == NOT_JUDGED


def test_the_truth_outside_the_fence_is_noticed() -> None:
    far = good(box=with_row(box(), 10.0, POSITION, (2.3, 0.0, -1.0)))
    assert "truly outside" in said("fence in truth", far)
    blurred = replace(far, planned=replace(PLAN, estimator="gps"))
    assert said("fence in truth", blurred) == KEPT


def test_a_tilt_in_the_air_is_noticed_and_one_on_the_ground_is_not() -> None:
    over = (math.cos(0.7), math.sin(0.7), 0.0, 0.0)  # 80°
    assert "80°" in said("tilt bounded", good(box=with_row(box(), 10.0, QUATERNION, over)))
    assert said("tilt bounded", good(box=with_row(box(), END_S, QUATERNION, over))) == KEPT


@pytest.mark.parametrize(
    "bad",
    [setpoint(9.0, math.nan), setpoint(9.0, 1.2), setpoint(9.0, quaternion=(0.5, 0.5, 0, 0))],
    ids=["nan", "thrust", "quaternion"],
)
def test_numbers_that_must_not_be_sent_are_noticed(bad: object) -> None:
    assert said("no NaN on the wire", good(frames=[*flight_frames()[:50], bad])) != KEPT


def killed(**changes: object) -> Evidence:
    plan = replace(PLAN, kill_at_s=16.0)
    return good(planned=plan, code=-9, words=("[track]",), companion_ended_s=OVER_S, events=(), **changes)


def test_a_vehicle_left_in_the_air_is_noticed() -> None:
    up = with_row(with_row(box(), OVER_S, POSITION, (0.0, 0.0, -1.0)), OVER_S, ARMED, 1.0)
    assert "armed and 1.0 m up" in said("safe afterwards", killed(box=up))
    assert said("safe afterwards", killed()) == KEPT


def test_a_vehicle_that_fell_is_noticed() -> None:
    fell = with_row(box(), OVER_S - 1.0, ARMED, 0.0)
    fell[:, POSITION] = (0.0, 0.0, -1.0)
    fell[0, POSITION] = 0.0
    assert "disarmed 1.0 m up" in said("safe afterwards", killed(box=fell))


def test_a_vehicle_on_its_back_is_for_another_judge() -> None:
    over = with_row(with_row(box(), OVER_S, QUATERNION, (0.0, 1.0, 0.0, 0.0)), OVER_S, ARMED, 1.0)
    assert said("safe afterwards", killed(box=over)) == NOT_JUDGED


def test_a_vehicle_that_a_pilot_flies_is_his() -> None:
    plan = replace(PLAN, faults=(Fault("pilot_mode", "airborne", 1.0, None),))
    up = with_row(with_row(box(), OVER_S, POSITION, (0.0, 0.0, -99.0)), OVER_S, ARMED, 1.0)
    up[:, VELOCITY] = (0.0, 0.0, 5.0)
    his = good(planned=plan, words=("pilot took over: mode",), code=3, box=up)
    assert said("safe afterwards", his) == NOT_JUDGED
    assert said("safe afterwards", good(planned=PLAN, words=("aborted: a limit",), code=3, box=up)) != KEPT


def test_arducopter_may_hang_level_but_not_sink() -> None:
    plan = replace(PLAN, firmware="ardupilot", kill_at_s=16.0)
    up = with_row(with_row(box(), OVER_S, POSITION, (0.0, 0.0, -1.0)), OVER_S, ARMED, 1.0)
    assert said("safe afterwards", replace(killed(box=up), planned=plan)) == KEPT
    up[-1, VELOCITY] = (0.0, 0.0, 1.5)
    assert said("safe afterwards", replace(killed(box=up), planned=plan)) != KEPT


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"code": 3}, "exit code 0"),
        ({"words": ("[land]",)}, "without a last word"),
        ({"events": ()}, "the log says"),
        ({"events": (LogEvent("ended", 1.0, {"outcome": "aborted", "text": "?"}),)}, "the log says"),
    ],
)
def test_a_last_word_that_does_not_fit_is_noticed(changes: dict, word: str) -> None:
    assert word in said("last word", good(**changes))


def test_wrong_input_needs_no_outcome() -> None:
    assert said("last word", good(code=2, words=("error: no such trajectory",))) == KEPT


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"box": with_row(box(), END_S, ARMED, 1.0)}, "is armed"),
        ({"box": with_row(box(), END_S, POSITION, (0.0, 0.0, -1.0))}, "1.0 m up"),
        ({"tracked_s": 2.0}, "tracked 2.00 s of 5 s"),
        ({"words": ("interrupted: by Ctrl-C",), "code": 3}, "nobody did"),
        (
            {"words": ("pilot took over: mode is now AUTO",), "box": with_row(box(), END_S, ARMED, 1.0)},
            "there was none",
        ),
    ],
)
def test_claims_that_are_not_so_are_noticed(changes: dict, word: str) -> None:
    assert word in said("truthful end", good(**changes))


def test_an_autopilot_that_is_gone_has_to_be_missed_and_no_other() -> None:
    gone = replace(PLAN, gone_at_s=3.0)
    lost = good(words=("link lost: nothing heard",), code=1, stub_code=-9)
    assert said("truthful end", replace(lost, planned=gone)) == KEPT
    assert "was there" in said("truthful end", lost)
    assert "was gone" in said(
        "truthful end", good(planned=gone, words=("aborted: a limit",), code=3, stub_code=-9)
    )
    assert said("no traceback", replace(lost, planned=gone)) == KEPT


def test_a_vehicle_handed_back_in_our_mode_is_noticed() -> None:
    words = ("handed back: a limit",)
    rows = with_row(box(), OVER_S, ARMED, 1.0)
    assert said("truthful end", good(words=words, code=3, box=rows)) == KEPT
    rows[:, 2] = OFFBOARD
    assert "still in the mode" in said("truthful end", good(words=words, code=3, box=rows))


@pytest.mark.parametrize(
    "changes",
    [
        {"log_trouble": "damaged"},
        {"log_losses": '{"dropped": "3"}'},
        {"log_cut": "the file ends within a record"},
    ],
)
def test_a_log_that_is_not_whole_is_noticed(changes: dict) -> None:
    assert said("log whole", good(**changes)) != KEPT


def test_what_a_killed_flights_log_may_lose() -> None:
    plan = replace(PLAN, kill_at_s=16.0)
    frames = [*flight_frames(), *answers(23.9)]
    assert said("log whole", good(planned=plan, code=-9, frames=frames)) == KEPT
    frames = [*flight_frames(), *answers(23.5)]
    assert "lost the last" in said("log whole", good(planned=plan, code=-9, frames=frames))
    assert "the log ends" in said("log whole", good(frames=frames)), (
        "one that was not killed may lose nothing"
    )


def test_a_clock_that_jumps_back_does_not_hide_what_a_log_lost() -> None:
    """The clock passes 20 s twice, the log ends at the first time: what came after is lost."""
    ticks = good().ticks.copy()
    ticks[2200:, 0] -= 3.0
    evidence = good(
        planned=replace(PLAN, kill_at_s=16.0),
        code=-9,
        ticks=ticks[:2310],  # killed as the clock comes by 20.09 s again
        frames=[*flight_frames(), *answers(20.0)],
    )
    assert "the log lost the last 3.0" in said("log whole", evidence)


@pytest.mark.parametrize(
    "changes",
    [
        {"words": ("Traceback (most recent call last):", "ValueError"), "code": 1},
        {"code": 70},
        {"stub_code": 1},
        {"stub_words": "Traceback (most recent call last):"},
    ],
)
def test_a_traceback_is_noticed(changes: dict) -> None:
    assert said("no traceback", good(**changes)) != KEPT


def test_a_flight_that_does_not_end_is_noticed() -> None:
    assert said("bounded time", good(code=None)) != KEPT
    assert said("bounded time", good(companion_ended_s=400.0)) != KEPT


def test_a_quiet_flight_that_is_not_flown_well_is_noticed() -> None:
    assert "0.40 m" in said("quiet flight", good(rms_error_m=0.4))
    assert said("quiet flight", good(words=("aborted: a limit",), code=3)) != KEPT
    assert said("quiet flight", good(planned=replace(PLAN, faults=(GUST,)), rms_error_m=0.4)) == NOT_JUDGED


def test_every_invariant_is_told_what_it_is() -> None:
    for name, invariant in INVARIANTS.items():
        assert invariant.__doc__, name
