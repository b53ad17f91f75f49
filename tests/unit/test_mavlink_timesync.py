"""Clock offset out of late and jittery answers."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mavlink.timesync import WINDOW, TimeSync

OFFSET_S = -1234.5


def exchange(sync, at_s, out_s, back_s, autopilot_clock):
    """One question sent at `at_s`, `out_s` under way, answered at once, `back_s` under way."""
    autopilot_s = autopilot_clock(at_s + out_s)
    sync.add(round(at_s * 1e9), round(autopilot_s * 1e9), round((at_s + out_s + back_s) * 1e9))


def ahead(now_s):
    return now_s + 2000.0 + OFFSET_S


def test_by_hand():
    """Sent at 10 s, back at 10.006 s, autopilot's clock 500.001 s at the half-way point: 489.998 s ahead."""
    sync = TimeSync()
    sync.add(10_000_000_000, 500_001_000_000, 10_006_000_000)
    assert sync.offset_s == pytest.approx(500.001 - 10.003, abs=1e-9)
    assert sync.round_trip_s == pytest.approx(0.006)
    assert sync.autopilot_time_s(11.0) == pytest.approx(11.0 + 489.998)


def test_without_an_answer():
    sync = TimeSync()
    assert math.isnan(sync.offset_s)
    assert math.isnan(sync.round_trip_s)
    assert not sync.steady
    assert sync.samples == 0


@pytest.mark.parametrize("seed", range(5))
def test_px4_like_answers(seed):
    """0.15 ms each way, PX4's parser 1 to 2.5 ms late on the way out: within 1.3 ms, and steadier than its jitter."""
    draw = random.Random(seed)
    sync, offsets = TimeSync(), []
    for index in range(300):
        late_s = draw.uniform(1e-3, 2.5e-3)
        exchange(sync, 5.0 + 0.1 * index, 150e-6 + late_s, 150e-6 + draw.expovariate(1 / 50e-6), ahead)
        if index > WINDOW:
            offsets.append(sync.offset_s - (2000.0 + OFFSET_S))
    assert max(map(abs, offsets)) < 1.3e-3
    assert max(offsets) - min(offsets) < 0.5e-3  # a single answer jumps by 0.75 ms
    assert sync.steady


@given(st.lists(st.tuples(st.floats(1e-4, 0.4), st.floats(1e-4, 0.4)), min_size=1, max_size=60))
def test_never_further_off_than_half_the_quickest_round_trip(delays):
    sync = TimeSync()
    for index, (out_s, back_s) in enumerate(delays):
        exchange(sync, 5.0 + index, out_s, back_s, ahead)
    quickest_s = min(out_s + back_s for out_s, back_s in delays[-WINDOW:])
    assert abs(sync.offset_s - (2000.0 + OFFSET_S)) <= quickest_s / 2 + 1e-6


def test_a_burst_of_slow_answers_changes_nothing():
    sync = TimeSync()
    for index in range(20):
        exchange(sync, 1.0 + 0.1 * index, 0.5e-3, 0.5e-3, ahead)
    before = sync.offset_s
    for index in range(10):
        exchange(sync, 3.0 + 0.1 * index, 80e-3, 0.5e-3, ahead)
    assert sync.offset_s == before


def test_an_old_quick_answer_is_forgotten():
    """After a window the offset follows a clock that was set."""
    sync = TimeSync()
    exchange(sync, 1.0, 0.1e-3, 0.1e-3, ahead)
    for index in range(WINDOW):
        exchange(sync, 2.0 + 0.1 * index, 1e-3, 1e-3, lambda now_s: ahead(now_s) + 7.0)
    assert sync.offset_s == pytest.approx(2000.0 + OFFSET_S + 7.0, abs=1e-6)


@pytest.mark.parametrize(
    ("sent_ns", "autopilot_ns", "received_ns"),
    [
        (2_000_000_000, 5, 1_000_000_000),  # answers a question of the future
        (1_000_000_000, 5_000_000_000, 2_500_000_000),  # 1.5 s under way
        (1_000_000_000, 0, 1_001_000_000),  # its clock stands
        (1_000_000_000, -5, 1_001_000_000),
        (-(2**63), 5, 2**63 - 1),
    ],
)
def test_impossible_answers_are_dropped(sent_ns, autopilot_ns, received_ns):
    sync = TimeSync()
    sync.add(sent_ns, autopilot_ns, received_ns)
    assert sync.samples == 0


@pytest.mark.parametrize(
    ("speed", "steady"),
    [(1.0, True), (1.0001, True), (0.9999, True), (20.0, False), (0.5, False), (1.1, False)],
)
def test_steady_is_a_clock_as_fast_as_ours(speed, steady):
    draw = random.Random(1)
    sync = TimeSync()
    for index in range(40):
        exchange(
            sync,
            5.0 + 0.1 * index / speed,
            draw.uniform(0.1e-3, 0.4e-3),
            draw.uniform(0.1e-3, 0.4e-3),
            lambda now_s: 100.0 + speed * now_s,
        )
    assert sync.steady is steady


def test_a_lockstep_clock_that_stands_between_answers_is_not_steady():
    """4 s of the autopilot's time within 0.2 s of ours."""
    sync = TimeSync()
    for index in range(40):
        exchange(sync, 5.0 + 0.005 * index, 20e-6, 20e-6, lambda now_s, i=index: 10.0 + 0.1 * i)
    assert not sync.steady


def test_lateness_is_believed_up_to_the_longest_recent_round_trip():
    """Offset 100 s; a state stamped 99.5 s at our 0 s is 0.5 s old by the clocks."""
    sync = TimeSync()
    assert math.isnan(sync.lateness_s(0.0, 0.0))
    for k in range(8):
        sent = k * 100_000_000
        sync.add(sent, sent + 100_000_000_000 + 1_000_000, sent + 2_000_000)  # 2 ms round trip
    assert sync.lateness_s(99.5, 0.0) == pytest.approx(0.002)  # a simulation that fell behind
    sent = 800_000_000
    sync.add(sent, sent + 100_000_000_000 + 300_000_000, sent + 600_000_000)  # the link is slow now
    assert sync.lateness_s(99.5, 0.0) == pytest.approx(0.5, abs=0.01)
    assert sync.lateness_s(99.99, 0.0) == pytest.approx(0.01, abs=0.005)


@pytest.mark.parametrize("drift", [0.01, -0.01, 0.007, 0.0])
def test_a_drift_of_up_to_a_percent_is_taken_along(drift):
    """Answers as PX4's, one of them 0.4 s late: the autopilot's time is right to 2 ms, and the clock is still steady."""
    draw, sync = random.Random(3), TimeSync()

    def clock(now_s):
        return 100.0 + (1.0 + drift) * now_s

    for index in range(60):
        at_s = 5.0 + 0.1 * index
        late_s = 0.4 if index == 59 else draw.uniform(0.2e-3, 2.5e-3)
        exchange(sync, at_s, late_s, 0.2e-3, clock)
        if index > 20:
            assert sync.autopilot_time_s(at_s) == pytest.approx(clock(at_s), abs=2e-3)
            assert sync.steady
    assert sync.drift == pytest.approx(drift, abs=1e-3)


def test_a_lockstep_clock_that_runs_as_fast_as_ours_on_average_is_not_steady():
    """A slow machine: in fits and starts of up to 0.1 s, and so no drift is proven; an age would be told that is none."""
    draw, sync, autopilot_s = random.Random(3), TimeSync(), 10.0
    for index in range(60):
        autopilot_s = max(autopilot_s + 0.001, 10.0 + 0.1 * index + draw.uniform(-0.05, 0.05))
        exchange(sync, 5.0 + 0.1 * index, 200e-6, 200e-6, lambda now_s, at=autopilot_s: at)
    assert abs(sync.drift) < 0.02
    assert not sync.steady
