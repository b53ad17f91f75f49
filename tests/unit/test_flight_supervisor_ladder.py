"""The supervisor's state machine: durations, hysteresis, what is taken back and what never is."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.safety import QUANTITIES, Reaction, SafetyLimits
from companion.control.structs import AdaptationGate
from companion.flight.ladder import START, next_reaction, rung_table, step, transitions
from companion.flight.provocation import PROVOCATIONS, Scene, just_beyond

NOTHING = [None] * len(QUANTITIES)
POSITION_ERROR = list(QUANTITIES).index("position_error_m")
REACTIONS = st.sampled_from(list(Reaction))


def run(values, table=None, times=None, state=START):
    """Feed position errors 10 ms apart; the states after each, and all changes."""
    table = table or rung_table(SafetyLimits())
    states, changes = [], []
    for number, value in enumerate(values):
        seen = list(NOTHING)
        seen[POSITION_ERROR] = value
        state, new = step(table, state, seen, 0.01 * number if times is None else times[number])
        states.append(state)
        changes += new
    return states, changes


def limits(**rungs):
    return SafetyLimits.model_validate({"position_error_m": rungs})


def test_a_rung_acts_after_its_duration_and_not_before():
    table = rung_table(SafetyLimits())  # warn beyond 0.8 m for 0.5 s
    states, changes = run([0.9] * 60, table)
    acting = [state.reaction for state in states]
    assert acting[:50] == [Reaction.NONE] * 50  # 0 to 0.49 s
    assert acting[50] is Reaction.WARN  # at 0.5 s
    assert [(change.rung.reaction, change.began) for change in changes] == [(Reaction.WARN, True)]
    assert changes[0].value == 0.9 and changes[0].lasted_s == pytest.approx(0.5)


def test_one_good_value_starts_the_duration_anew():
    states, changes = run([0.9] * 45 + [0.1] + [0.9] * 45)
    assert all(state.reaction is Reaction.NONE for state in states) and not changes


def test_a_rung_lets_go_only_after_being_well_within_for_the_recovery_time():
    values = [0.9] * 51 + [0.79] * 300 + [0.7] * 201  # 0.79 is within 0.8, but not within 0.9 of it
    states, changes = run(values)
    assert states[350].reaction is Reaction.WARN
    assert states[550].reaction is Reaction.WARN  # 1.99 s of 2 s
    assert states[551].reaction is Reaction.NONE
    assert [change.began for change in changes] == [True, False]


def test_each_reaction_is_told_once_however_long_it_lasts():
    _, changes = run([2.0] * 1000)
    told = [(change.rung.reaction, change.began) for change in changes]
    expected = [Reaction.WARN, Reaction.NON_ADAPTIVE, Reaction.HOLD, Reaction.LAND]
    assert told == [(reaction, True) for reaction in expected]


def test_nan_counts_as_beyond_every_limit():
    states, _ = run([math.nan] * 60)
    assert states[-1].reaction is Reaction.LAND


def test_what_is_not_known_changes_nothing():
    states, changes = run([0.9] * 40 + [None] * 500 + [0.9])
    assert states[-1].reaction is Reaction.WARN  # 5.4 s after it began, never seen to be good
    assert len(changes) == 1
    states, _ = run([None] * 100)
    assert states[-1] is START


def test_hold_is_bounded_in_time_and_ends_in_a_landing():
    table = rung_table(limits(warn="off", non_adaptive="off", hold=[1.0, 0.0], land=[5.0, 0.0]))
    states, _ = run([1.1] + [0.0] * 1000, table)
    assert states[0].reaction is Reaction.HOLD
    assert states[999].reaction is Reaction.HOLD  # 9.99 s
    assert states[1000].reaction is Reaction.LAND  # hold_s = 10


def test_quantities_that_are_bad_below_are_watched_from_below():
    scene = Scene(SafetyLimits())
    scene.step()
    scene.status.battery_remaining = 0.2
    for _ in range(520):
        judgement = scene.step()
    assert judgement.reaction is Reaction.WARN
    scene.status.battery_remaining = 0.26  # not yet 0.25 / 0.9
    for _ in range(300):
        judgement = scene.step()
    assert judgement.reaction is Reaction.WARN
    scene.status.battery_remaining = 0.3
    for _ in range(230):
        judgement = scene.step()
    assert judgement.reaction is Reaction.NONE


@given(current=REACTIONS, wanted=REACTIONS, over=st.booleans())
def test_the_machine_never_does_less_than_is_wanted(current, wanted, over):
    assert next_reaction(current, wanted, over) >= wanted


@given(current=REACTIONS, wanted=REACTIONS, over=st.booleans())
def test_from_hold_on_nothing_is_taken_back(current, wanted, over):
    if current >= Reaction.HOLD:
        assert next_reaction(current, wanted, over) >= current


@given(
    values=st.lists(st.one_of(st.none(), st.floats(0.0, 3.0), st.just(math.nan)), min_size=1, max_size=200),
    gap=st.floats(0.001, 0.5),
)
def test_whatever_comes_the_machine_keeps_its_word(values, gap):
    times = [gap * number for number in range(len(values))]
    states, changes = run(values, times=times)
    hardest = Reaction.NONE
    for before, after in zip([START, *states], states, strict=False):
        if before.reaction >= Reaction.HOLD:
            assert after.reaction >= before.reaction
        hardest = max(hardest, after.reaction)
    began = {change.rung.reaction for change in changes if change.began}
    assert hardest in began | {Reaction.NONE, Reaction.LAND}  # LAND may also come of HOLD having lasted
    again, _ = run(values, times=times)
    assert again == states  # nothing but its arguments


def test_the_diagram_knows_every_way_up_and_no_way_down_from_hold():
    edges = transitions()
    for soft in Reaction:
        for hard in Reaction:
            if hard > soft:
                assert (soft, hard) in edges
            elif hard < soft:
                assert ((soft, hard) in edges) == (soft < Reaction.HOLD)
    assert edges[(Reaction.HOLD, Reaction.LAND)] == "limit or held for hold_s"


@pytest.mark.parametrize(
    ("name", "reaction", "at", "for_s"),
    [
        (name, reaction, at, for_s)
        for name in QUANTITIES
        for reaction, at, for_s in SafetyLimits().ladder(name).rungs()
    ],
)
def test_every_limit_is_noticed_within_its_time(name, reaction, at, for_s):
    """Through the supervisor's real inputs; what comes on top of the duration is the quantity's own filter."""
    scene = Scene(SafetyLimits())
    for _ in range(30):
        assert scene.step().reaction is Reaction.NONE
    PROVOCATIONS[name](scene, just_beyond(name, at, QUANTITIES[name].below))
    filters_s = {
        "link_loss": 2.0,
        "lyapunov_rise": 8.0,
        "position_stuck_s": at,
        "velocity_mismatch": 0.6,
        "ground_support": 0.5,
    }
    deadline_s = scene.time_s + for_s + filters_s.get(name, 0.0) + 0.12  # slow ones are looked at every 0.1 s
    began_s = scene.time_s
    while scene.step().reaction < reaction:
        assert scene.time_s < deadline_s, f"no {reaction.name} within its time"
    assert scene.time_s - began_s >= for_s - 1e-6
    assert name in scene.supervisor.reason


GROW_BY_THEMSELVES = (
    "position_stuck_s",
    "lyapunov_rise",
    "mode_age_s",
    "estimator_age_s",
    "sys_status_age_s",
)


@pytest.mark.parametrize("name", [n for n in QUANTITIES if not n.startswith(("position_jump", "yaw_jump"))])
def test_just_within_the_softest_limit_nothing_happens(name):
    rungs = SafetyLimits().ladder(name).rungs()
    if not rungs or name in GROW_BY_THEMSELVES:
        pytest.skip("no threshold that a still value can stay within")
    scene = Scene(SafetyLimits())
    scene.step()
    below = QUANTITIES[name].below
    at = rungs[0][1]
    value = at + abs(at) * 0.02 + 0.01 if below else at * 0.98
    PROVOCATIONS[name](scene, value)
    assert {scene.step().reaction for _ in range(600)} == {Reaction.NONE}


def test_our_own_clock_counts_in_real_time_only():
    scene = Scene(SafetyLimits(), real_time=False)
    scene.overrun_share, scene.link.timesync.round_trip_s = 1.0, 3.0
    assert {scene.step().reaction for _ in range(600)} == {Reaction.NONE}


def test_a_simulations_round_trip_is_judged_in_its_own_time():
    scene = Scene(SafetyLimits(), real_time=False)
    scene.link.timesync.autopilot_trip_s = 0.16
    assert [scene.step().reaction for _ in range(600)][-1] is Reaction.LAND


def test_a_silent_state_is_noticed_by_the_autopilots_time_alone():
    scene = Scene(SafetyLimits())
    for _ in range(10):
        scene.step()
    last_s = scene.time_s
    reactions = {}
    for number in range(1, 60):
        age_s = 0.01 * number
        judgement = scene.supervisor.judge_absence(last_s + age_s, age_s, age_s)
        reactions.setdefault(judgement.reaction, age_s)
    assert reactions[Reaction.WARN] == pytest.approx(0.11)
    assert reactions[Reaction.FREEZE] == pytest.approx(0.16)
    assert reactions[Reaction.LAND] == pytest.approx(0.41)


def test_the_gate_of_adaptation_follows_the_reactions_that_act():
    scene = Scene(SafetyLimits())
    assert scene.step().gate is AdaptationGate.RUN
    scene.network = 0.87
    for _ in range(51):
        judgement = scene.step()
    assert (judgement.reaction, judgement.gate) == (Reaction.FREEZE, AdaptationGate.FREEZE)
    scene.network = 0.94
    for _ in range(51):
        judgement = scene.step()
    assert judgement.reaction is Reaction.NON_ADAPTIVE
    assert (
        judgement.gate is AdaptationGate.FREEZE_WEIGHTS
    )  # integrals go on: they have to take the networks' place
    scene.position_age_s = 0.25  # a stale position stops them all the same
    judgement = scene.step()
    assert (judgement.reaction, judgement.gate) == (Reaction.NON_ADAPTIVE, AdaptationGate.FREEZE)
