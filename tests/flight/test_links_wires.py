"""Every kind of wire flies, and what happens when one breaks."""

import threading
import time
from pathlib import Path

import pytest
from link_flights import companion, free_port, stub_behind
from wire_relay import Relay, SerialWire, TcpWire, UdpWire

from companion.flight.phases import Phase

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
    assert took_s < 5.0


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


def test_a_serial_port_at_921600_baud(tmp_path: Path) -> None:
    wire = SerialWire(tmp_path / "ttyACM0", 921600)
    with stub_behind() as stub_port, Relay(stub_port, wire):
        flown = companion(f"serial://{wire.path}:921600", tmp_path)
    assert flown.outcome == "completed", flown.text
    assert wire.carried > 50_000


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
