"""Who is heard: one client at a time over UDP, lines of standard input, and a bounded share of whatever comes."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import numpy as np
import pytest

from companion.config.errors import UserError
from companion.flightlog.writer import LIVE_NUMBERS
from companion.live import sources
from companion.live.heard import BEFORE_TRACKING, Heard
from companion.live.json_points import LONGEST_BYTES
from companion.live.mavlink_points import Surroundings
from companion.live.sources import LineSource, UdpSource
from companion.live.trajectory import (
    DATAGRAMS_AT_ONCE,
    HEAR_PERIOD_S,
    Beginning,
    LiveTrajectory,
    trajectory_or_live,
)
from companion.reference.transit import TransitLimits

POINT = b'{"position": [0, 0, 1], "velocity": [0, 0, 0]}'
NOWHERE = (Surroundings(None, 0.0, None, 0.0, None), np.zeros(3), 0.0)


@pytest.fixture
def heard() -> Iterator[tuple[UdpSource, socket.socket, socket.socket]]:
    """A source, and two who may send to it."""
    source = UdpSource(("127.0.0.1", 0), "test")
    senders = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for sender in senders:
        sender.connect(source.address)
        sender.setblocking(False)
    yield source, senders[0], senders[1]
    source.close()
    for sender in senders:
        sender.close()


def everything(source: UdpSource) -> list[bytes]:
    found = []
    while (data := source.take()) is not None:
        found.append(data)
    return found


@pytest.mark.parametrize("by_kernel", [True, False])
def test_once_believed_a_client_is_heard_alone_until_let_go(heard, monkeypatch, by_kernel: bool) -> None:
    source, client, stranger = heard
    if not by_kernel:
        monkeypatch.setattr(sources, "hear_only", lambda *_: False)
    stranger.send(b"first")
    client.send(b"second")
    assert everything(source) == [b"first", b"second"]
    source.believe()  # who sent the last one
    for number in range(20):
        stranger.send(b"flood")
        client.send(b"%d" % number)
    assert everything(source) == [b"%d" % number for number in range(20)]
    assert source.dropped == 20
    source.let_go()
    stranger.send(b"now me")
    assert everything(source) == [b"now me"]


def test_a_sender_who_does_not_listen_is_no_trouble(heard) -> None:
    source, client, _ = heard
    client.send(b"x")
    assert source.take() == b"x"
    client.close()
    for _ in range(3):
        source.answer(b"refused")  # the second finds what the first one's ICMP left
        assert source.take() is None


def test_a_port_that_is_taken_is_an_error_in_words(heard) -> None:
    source, _, _ = heard
    with pytest.raises(UserError, match="live:udp: Address already in use; is another program listening"):
        UdpSource(source.address, "live:udp")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("live:", "use live:udp"),
        ("live:tcp:14700", "use live:udp"),
        ("live:udp", "use live:udp"),
        ("live:stdin:1", "use live:udp"),
        ("live:udp:0", "not .HOST:.PORT"),
        ("live:udp:70000", "not .HOST:.PORT"),
        ("live:mavlink:here:port", "not .HOST:.PORT"),
    ],
)
def test_addresses_that_are_none_are_refused_in_words(text: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        trajectory_or_live(text)


def test_it_listens_on_this_machine_unless_told_otherwise() -> None:
    live = trajectory_or_live("live:udp:14799")
    assert isinstance(live, LiveTrajectory)
    live.open()
    try:
        assert live._source.address == ("127.0.0.1", 14799)
    finally:
        live.close()


def test_a_flood_of_good_points_costs_two_of_them_in_each_period() -> None:
    live = trajectory_or_live("live:udp:14798")
    assert isinstance(live, LiveTrajectory)
    live.open()
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        live.begin(Beginning(0.0, 0.0, TransitLimits(), 0.2, lambda p, a: ""))
        for _ in range(100):
            wire.sendto(POINT, ("127.0.0.1", 14798))
        taken: list[int] = []
        live.on_heard = lambda heard: taken.append(len(heard.data))
        for step in range(10):
            live.hear(1.0 + step * HEAR_PERIOD_S / 2.0, lambda: NOWHERE)
        assert len(taken) == 5 * DATAGRAMS_AT_ONCE
    finally:
        live.close()
        wire.close()


@pytest.fixture
def piped(monkeypatch) -> Iterator[tuple[LineSource, int]]:
    out, into = os.pipe()
    monkeypatch.setattr(sources, "STANDARD_INPUT", out)
    yield LineSource(), into
    os.close(out)


def test_lines_are_given_whole_and_the_end_is_an_end(piped) -> None:
    source, into = piped
    assert source.take() is None
    os.write(into, b'{"a": 1}\n\n  {"b"')
    assert source.take() == b'{"a": 1}'
    assert source.take() is None
    os.write(into, b": 2}\nlast without a newline")
    assert source.take() == b'{"b": 2}'
    assert source.take() is None
    os.close(into)
    assert source.take() == b"last without a newline"
    assert source.take() == b'{"end": true}' and source.take() == b'{"end": true}'


def test_a_line_that_never_ends_is_given_once_and_the_next_is_whole(piped) -> None:
    source, into = piped
    for _ in range(3):
        os.write(into, b"x" * 3000)
    given = []
    for _ in range(6):
        if (line := source.take()) is not None:
            given.append(line)
    assert len(given) == 1 and len(given[0]) > LONGEST_BYTES
    os.write(into, b"xxx\n" + POINT + b"\n")
    assert source.take() == POINT
    os.close(into)


def test_what_was_heard_survives_the_log() -> None:
    around = Surroundings(np.array([1.0, 2.0, 3.0]), 0.5, (47.0, 8.0, 400.0), -1.0, 7, True)
    for heard in (
        Heard(1.5, POINT, 12, around, np.array([0.1, 0.2, 0.3]), 0.4),
        Heard(0.0, b"", BEFORE_TRACKING, Surroundings(None, 0.0, None, 0.0, None)),
    ):
        again = Heard.from_log(heard.time_s, heard.numbers(), heard.data)
        assert len(heard.numbers()) == LIVE_NUMBERS
        np.testing.assert_equal(again.numbers(), heard.numbers())
        assert (again.around.position_enu is None) == (heard.around.position_enu is None)
        assert (again.around.system, again.around.origin) == (heard.around.system, heard.around.origin)


def test_a_point_after_an_estimator_reset_means_the_new_frame() -> None:
    """The plan was moved by 0.5 m in x and turned by 0.2 rad with the frame, and moves what is made of points, too."""
    live = trajectory_or_live("live:udp:14797")
    assert isinstance(live, LiveTrajectory)
    live.begin(Beginning(0.0, 0.0, TransitLimits(), 0.2, lambda p, a: ""))
    moved = np.array([0.5, 0.0, 0.0])
    for k in range(500):
        data = b'{"position": [0.5, 0, 1], "velocity": [0, 0, 0], "yaw": 0.2}'
        live.take(Heard(0.02 * k, data, moved_enu=moved, turned_rad=0.2))
        now = live.sample(0.02 * k)
    np.testing.assert_allclose(now.position_enu, [0.0, 0.0, 1.0], atol=1e-6)
    assert now.yaw_rad == pytest.approx(0.0, abs=1e-6)
