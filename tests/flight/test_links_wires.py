"""Every kind of wire flies, and what happens when one breaks."""

import os
import re
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from link_flights import companion, free_port, stub_behind
from wire_relay import Pace, Relay, SerialWire, TcpWire, UdpWire

from companion.config.errors import UserError
from companion.flight.descent import LISTENS_ON_S
from companion.flight.phases import Phase
from companion.flightlog.reader import read_log

pytestmark = pytest.mark.flight


def test_a_broken_tcp_connection_is_opened_again_and_the_flight_goes_on(tmp_path: Path) -> None:
    wire = TcpWire()
    with stub_behind() as stub_port, Relay(stub_port, wire) as relay:
        flown = companion(
            f"tcp:127.0.0.1:{wire.port}",
            tmp_path,
            at={Phase.READY: lambda: relay.order(wire.drop), Phase.TRACK: lambda: relay.order(wire.drop)},
        )
    assert flown.outcome == "completed", flown.text
    assert wire.accepted == 3
    told = [line for line in flown.lines if line.startswith("endpoint tcp:")]
    assert [line.split("; ")[-1].split(": ")[-1][:9] for line in told] == ["trying to", "connected"] * 2


def test_a_simulator_that_is_started_later_is_waited_for(tmp_path: Path) -> None:
    wire = TcpWire()
    port = wire.port
    wire.close()  # nobody listens there now
    late: list[TcpWire] = []

    with ExitStack() as stack:

        def start() -> None:
            late.append(TcpWire(port))
            stack.enter_context(Relay(stack.enter_context(stub_behind()), late[0]))

        at = {Phase.CONNECT: lambda: threading.Timer(0.7, start).start()}
        flown = companion(f"tcp:127.0.0.1:{port}", tmp_path, at=at)
    assert flown.outcome == "completed", flown.text
    told = [line for line in flown.lines if line.startswith("endpoint tcp:")]
    assert "nobody listens there yet; waiting" in told[0] and "connected after" in told[1]


def test_a_simulator_that_never_comes_is_one_line(tmp_path: Path) -> None:
    port = free_port()
    with pytest.raises(
        UserError, match=r"no autopilot within 1 s; nobody listens there; is the autopilot or sim"
    ):
        companion(f"tcp:127.0.0.1:{port}", tmp_path, settings={"procedure.connect_timeout_s": 1.0})


def test_a_tcp_connection_that_stays_away_ends_the_flight_in_words(tmp_path: Path) -> None:
    wire = TcpWire()

    def gone() -> None:
        wire.listener.close()
        wire.drop()
        wire.sources = list  # type: ignore[method-assign]

    with stub_behind() as stub_port, Relay(stub_port, wire) as relay:
        began = []

        def break_it() -> None:
            began.append(time.monotonic())
            relay.order(gone)

        flown = companion(
            f"tcp:127.0.0.1:{wire.port}",
            tmp_path,
            at={Phase.TRACK: break_it},
            settings={"safety.silence_s": 1.0},
        )
        took_s = time.monotonic() - began[0]
    assert flown.outcome == "link lost" and "1.0 s" in flown.text
    assert took_s < 1.0 + LISTENS_ON_S + 4.0


def test_a_udp_peer_that_moves_is_followed(tmp_path: Path) -> None:
    port = free_port()
    wire = UdpWire(port)
    with stub_behind() as stub_port, Relay(stub_port, wire) as relay:

        def move() -> None:
            time.sleep(1.2)  # its program starts again; by its silence it stops being our peer
            wire.move()

        flown = companion(f"udpin:127.0.0.1:{port}", tmp_path, at={Phase.READY: lambda: relay.order(move)})
        moved_to = wire.socket.getsockname()[1]
    assert flown.outcome == "completed", flown.text
    assert f"the autopilot now speaks from 127.0.0.1:{moved_to}" in flown.lines


def test_a_stranger_cannot_take_the_place_of_a_peer_that_speaks(tmp_path: Path) -> None:
    """Somebody with the autopilot's ids sends from another port all the time, and is not heard."""
    port = free_port()
    wire, stranger = UdpWire(port), UdpWire(port)
    going = True
    with stub_behind() as stub_port, Relay(stub_port, wire):

        def babble(data: bytes = bytes.fromhex("fd09000000010100000000000600020c5104039ddb")) -> None:
            while going:
                stranger.write(data)
                time.sleep(0.002)

        thread = threading.Thread(target=babble)
        flown = companion(f"udpin:127.0.0.1:{port}", tmp_path, at={Phase.CHECK: thread.start})
        going = False
        thread.join()
    stranger.close()
    assert flown.outcome == "completed", flown.text
    assert not [line for line in flown.lines if "now speaks from" in line]


def test_a_line_is_as_fast_as_its_baud_rate(tmp_path: Path) -> None:
    """The pseudo-terminal of the tests below: 92160 bytes a second each way, not more."""
    wire = SerialWire(tmp_path / "ttyAMA0", 921600)
    other = os.open(wire.path, os.O_RDWR | os.O_NOCTTY)
    began = time.monotonic()
    for _ in range(200):
        wire.write(bytes(50))
        os.read(other, 4096)
        os.write(other, bytes(50))
        assert len(wire.read(wire.master)[0]) == 50
    took_s = time.monotonic() - began
    os.close(other)
    wire.close()
    assert (wire.carried, wire.received, wire.dropped) == (10_000, 10_000, 0)
    assert took_s >= (10_000 - Pace.BURST_BYTES) / 92160.0


def test_a_serial_port_at_921600_baud(tmp_path: Path) -> None:
    """Flies, loses nothing, and takes of the line no more than was said before (docs/links.md)."""
    wire = SerialWire(tmp_path / "ttyAMA0", 921600)
    with stub_behind() as stub_port, Relay(stub_port, wire):
        flown = companion(
            f"serial://{wire.path}:921600",
            tmp_path,
            level="body_rate",
            settings={"control_rate_hz": 200.0, "procedure.hold_s": 0.1, "duration_s": 0.5},
        )
    assert flown.outcome == "completed", flown.text
    said = next(line for line in flown.lines if line.startswith("serial line: "))
    planned_down, planned_up, usable = map(int, re.findall(r"(\d+)(?: bytes/s| sent| usable)", said))
    assert usable == 73728
    times_ns, _ = read_log(flown.log).mavlink["in"]
    flown_s = (times_ns[-1] - times_ns[0]) * 1e-9
    # What PX4 sends unasked comes on top (docs/links.md); it has room, too.
    assert 0.8 * planned_down < wire.carried / flown_s < usable
    assert 0.5 * planned_up < wire.received / flown_s < usable
    assert wire.dropped == flown.counters["bad frames"] == flown.counters["stray bytes"] == 0


def test_a_line_too_slow_for_the_level_is_refused_before_it_is_opened(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"57600 baud carry 4608 bytes/s .* or a higher --level"):
        companion(f"serial://{tmp_path}/ttyAMA0:57600", tmp_path, level="body_rate")


def test_a_pulled_plug_is_noticed_and_put_in_again(tmp_path: Path) -> None:
    wire = SerialWire(tmp_path / "ttyACM0", 921600)
    with stub_behind() as stub_port, Relay(stub_port, wire) as relay:

        def replug() -> None:
            wire.pull()
            time.sleep(0.5)
            wire.plug()

        flown = companion(
            f"serial://{wire.path}:921600", tmp_path, at={Phase.READY: lambda: relay.order(replug)}
        )
    assert flown.outcome == "completed", flown.text
    assert len([line for line in flown.lines if "connected again after" in line]) == 1
