"""From messages to one state: order, repeats, nonsense, resets of the estimator, and reboots."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavlink_wire import attitude, heartbeat, local_position

from companion.mavlink.state import JUMP_M, POSITION_TOO_OLD_S, StateAssembler

SQRT = math.sqrt(0.5)
NAN, INFINITE = math.nan, math.inf


def feed(assembler, *messages):
    """The states that come out, in order."""
    return [state for state in (assembler.take(message) for message in messages) if state is not None]


def test_a_state_by_hand():
    """Nose east, 10 ms after a position that moves north at 2 m/s: x is east, y north, z up."""
    (state,) = feed(
        StateAssembler(),
        local_position(1000, (1.0, 2.0, -3.0), (2.0, 0.5, 0.0)),
        attitude(1010, (SQRT, 0.0, 0.0, SQRT), (0.1, 0.2, 0.3)),
    )
    assert state.time_s == pytest.approx(1.010)
    np.testing.assert_allclose(state.position_enu, [2.0 + 0.005, 1.0 + 0.02, 3.0], atol=1e-6)
    np.testing.assert_allclose(state.velocity_enu, [0.5, 2.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(state.quaternion_wxyz, [1.0, 0.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(state.body_rate_flu, [0.1, -0.2, -0.3], atol=1e-6)


def test_no_state_without_a_position():
    assembler = StateAssembler()
    assert feed(assembler, attitude(1000), heartbeat()) == []
    assert assembler.counters["attitudes without position"] == 1


def test_every_attitude_makes_a_state_and_a_position_none():
    states = feed(
        StateAssembler(),
        local_position(1000),
        attitude(1000),
        attitude(1010),
        local_position(1020),
        attitude(1020),
    )
    assert [round(state.time_s, 3) for state in states] == [1.0, 1.01, 1.02]


def test_an_attitude_older_than_the_position_is_carried_back():
    (state,) = feed(StateAssembler(), local_position(1020, (0, 0, 0), (0, 1.0, 0)), attitude(1000))
    assert state.position_enu[0] == pytest.approx(-0.02)


@pytest.mark.parametrize(("age_ms", "states"), [(499, 1), (501, 0)])
def test_an_old_position_is_not_carried_forward(age_ms, states):
    assert POSITION_TOO_OLD_S == 0.5
    assembler = StateAssembler()
    assert len(feed(assembler, local_position(1000), attitude(1000 + age_ms))) == states


def test_repeats_and_late_ones_are_refused():
    assembler = StateAssembler()
    states = feed(
        assembler,
        local_position(1000, (0, 1.0, 0)),
        attitude(1010),
        attitude(1010),
        attitude(1005),
        local_position(990, (0, 2.0, 0)),
        local_position(1000, (0, 3.0, 0)),
        attitude(1020),
    )
    assert [round(state.time_s, 3) for state in states] == [1.01, 1.02]
    assert states[-1].position_enu[0] == 1.0
    assert assembler.counters["repeated or late attitudes"] == 2
    assert assembler.counters["repeated or late positions"] == 2


def test_a_reboot_is_not_late():
    assembler = StateAssembler()
    feed(assembler, local_position(60_000, (0, 5.0, 0)), attitude(60_000))
    states = feed(assembler, local_position(1500, (0, 1.0, 0)), attitude(1510))
    assert [state.position_enu[0] for state in states] == [1.0]
    assert assembler.take_jump() is None


@pytest.mark.parametrize("bad", [NAN, INFINITE, -INFINITE, 1e6])
@pytest.mark.parametrize("place", range(6))
def test_impossible_positions_are_refused(bad, place):
    assembler = StateAssembler()
    numbers = [0.0] * 6
    numbers[place] = bad
    feed(assembler, local_position(1000, numbers[:3], numbers[3:]))
    assert feed(assembler, attitude(1010)) == []
    assert assembler.counters["impossible positions"] == 1


@pytest.mark.parametrize(
    ("quaternion", "rates"),
    [
        ((NAN, 0, 0, 0), (0, 0, 0)),
        ((1, 0, 0, 0), (0, NAN, 0)),
        ((1, 0, 0, 0), (0, 0, INFINITE)),
        ((0, 0, 0, 0), (0, 0, 0)),
        ((0.9, 0, 0, 0), (0, 0, 0)),
        ((1, 1, 0, 0), (0, 0, 0)),
        ((2, 0, 0, 0), (0, 0, 0)),
        ((1, 0, 0, 0), (0, 0, 200.0)),
    ],
)
def test_impossible_attitudes_are_refused(quaternion, rates):
    assembler = StateAssembler()
    feed(assembler, local_position(1000))
    assert feed(assembler, attitude(1010, quaternion, rates)) == []
    assert assembler.counters["impossible attitudes"] == 1
    assert len(feed(assembler, attitude(1010))) == 1  # and the next good one of that moment counts


def test_a_slightly_long_quaternion_is_brought_to_length():
    (state,) = feed(StateAssembler(), local_position(1000), attitude(1000, (1.02 * SQRT, 0, 0, 1.02 * SQRT)))
    assert np.linalg.norm(state.quaternion_wxyz) == pytest.approx(1.0, abs=1e-12)


def test_a_reset_of_the_estimator_is_reported_once_with_its_size():
    """0.4 m to the north in 20 ms, of which 1 m/s explains 2 cm."""
    assembler = StateAssembler()
    feed(assembler, local_position(1000, (0, 0, 0), (1.0, 0, 0)))
    feed(assembler, local_position(1020, (0.42, 0, 0), (1.0, 0, 0)))
    np.testing.assert_allclose(assembler.take_jump(), [0.0, 0.40, 0.0], atol=1e-6)
    assert assembler.take_jump() is None
    assert assembler.counters["position jumps"] == 1


def test_jumps_add_up_until_they_are_taken():
    assembler = StateAssembler()
    for index, north in enumerate((0.0, 0.5, 0.5, 1.0)):
        feed(assembler, local_position(1000 + 20 * index, (north, 0, 0)))
    np.testing.assert_allclose(assembler.take_jump(), [0.0, 1.0, 0.0], atol=1e-6)


@given(st.floats(-15.0, 15.0), st.floats(-8.0, 8.0), st.integers(4, 100))
def test_hard_flight_is_no_jump(speed, acceleration, period_ms):
    """At ±8 m/s² between two positions the mean velocity explains the way, at any speed."""
    assembler = StateAssembler()
    dt_s = period_ms * 1e-3
    feed(assembler, local_position(1000, (0, 0, 0), (speed, 0, 0)))
    moved = speed * dt_s + 0.5 * acceleration * dt_s**2
    feed(assembler, local_position(1000 + period_ms, (moved, 0, 0), (speed + acceleration * dt_s, 0, 0)))
    assert assembler.take_jump() is None


def test_a_jump_after_a_gap_is_not_claimed():
    """Longer than a position is carried nobody knows what the vehicle did."""
    assembler = StateAssembler()
    feed(assembler, local_position(1000), local_position(1600, (5.0 * JUMP_M, 0, 0)))
    assert assembler.take_jump() is None
