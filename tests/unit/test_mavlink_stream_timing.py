"""Rate, jitter and age of streams, on clocks that are known."""

from __future__ import annotations

import math

import pytest

from companion.mavlink.received import mav
from companion.mavlink.stream_timing import STREAMS, StreamTiming, in_words
from companion.mavlink.timesync import TimeSync

ATTITUDE, POSITION = mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED
OFFSET_S = 1234.5  # the autopilot's clock minus ours


def synchronised(speed: float = 1.0, way_s: float = 0.004) -> TimeSync:
    """Twenty answers at 10 Hz over a way of `way_s` each way; a clock that runs at `speed`."""
    timesync = TimeSync()
    for k in range(20):
        sent_s = 10.0 + 0.1 * k
        there_s = sent_s + way_s
        timesync.add(
            round(sent_s * 1e9),
            round((speed * there_s + OFFSET_S) * 1e9),
            round((sent_s + 2.0 * way_s) * 1e9),
        )
    return timesync


def filled(timesync: TimeSync, message_id: int, rate_hz: float, ages_s: list[float]) -> StreamTiming:
    timing = StreamTiming(timesync)
    for k in range(round(2.0 * rate_hz)):
        true_s = 12.0 + k / rate_hz
        timing.note(message_id, true_s + OFFSET_S, round((true_s + ages_s[k % len(ages_s)]) * 1e9))
    return timing


def test_age_and_rate_are_what_they_were_made_of() -> None:
    (figures,) = filled(synchronised(), ATTITUDE, 100.0, [0.02]).figures()
    assert figures.name == "ATTITUDE_QUATERNION"
    assert figures.rate_hz == pytest.approx(100.0)
    assert figures.age_s == pytest.approx(0.02, abs=1e-6)
    assert figures.age_95_s == pytest.approx(0.02, abs=1e-6)
    assert figures.jitter_s == pytest.approx(0.0, abs=1e-6)
    assert in_words(figures) == "100 Hz, age 20.0 ms (95 %: 20.0 ms), jitter 0.0 ms"


def test_jitter_and_95_percent_of_a_stream_of_which_one_in_ten_is_late() -> None:
    (figures,) = filled(synchronised(), POSITION, 50.0, [0.03] + [0.01] * 9).figures()
    assert figures.age_s == pytest.approx(0.01, abs=1e-6)
    assert figures.age_95_s == pytest.approx(0.03, abs=1e-6)
    assert figures.jitter_s == pytest.approx(0.2 * 0.02, rel=0.06)  # 2 steps of 20 ms in 10 messages


def test_streams_are_told_apart_and_old_messages_forgotten() -> None:
    timing = filled(synchronised(), ATTITUDE, 100.0, [0.02])
    for k in range(400):  # a later, slower time of the same stream
        true_s = 20.0 + k / 50.0
        timing.note(ATTITUDE, true_s + OFFSET_S, round((true_s + 0.005) * 1e9))
        timing.note(POSITION, true_s + OFFSET_S, round((true_s + 0.007) * 1e9))
    attitude, position = timing.figures()
    assert (attitude.rate_hz, position.rate_hz) == (pytest.approx(50.0), pytest.approx(50.0))
    assert (attitude.age_s, position.age_s) == (pytest.approx(0.005), pytest.approx(0.007))


@pytest.mark.parametrize("timesync", [TimeSync(), synchronised(speed=3.0)], ids=["no answer", "simulation"])
def test_without_a_clock_like_ours_there_is_a_rate_and_no_age(timesync: TimeSync) -> None:
    (figures,) = filled(timesync, ATTITUDE, 100.0, [0.02]).figures()
    assert figures.rate_hz == pytest.approx(100.0)
    assert math.isnan(figures.age_s) and math.isnan(figures.jitter_s)
    assert "ages cannot be told" in in_words(figures)


def test_repeated_stamps_are_no_rate() -> None:
    timing = StreamTiming(synchronised())
    for k in range(10):
        timing.note(ATTITUDE, 5.0, k)
    assert timing.figures() == []


def test_the_streams_carry_a_stamp_that_can_be_read() -> None:
    from companion.mavlink.received import read

    codec = mav.MAVLink(None, srcSystem=1, srcComponent=1)
    for message_id in STREAMS:
        kind = mav.mavlink_map[message_id]
        blank = [[0.0] * n if n > 1 else 0 for n in kind.array_lengths]
        message = kind(*(blank[kind.ordered_fieldnames.index(name)] for name in kind.fieldnames))
        setattr(message, "time_usec" if hasattr(message, "time_usec") else "time_boot_ms", 12345)
        received = read(bytes(message.pack(codec)))
        assert received is not None
        assert 12345 in (received.boot_ms, received.time_us)
