"""MAVSDK 4: a dead loop that nothing keeps flying, and what is refused. That it flies: test_one_command.py."""

import sys
import time
from pathlib import Path

import pytest
from link_flights import companion, free_port, stub_behind
from pymavlink.dialects.v20 import all as mavlink
from wire_relay import Relay, UdpWire

from companion.config.errors import UserError
from companion.flight.phases import Phase
from companion.mavlink.connection import Connection, LinkLibrary
from companion.mavlink.endpoint import parse_endpoint

pytestmark = pytest.mark.flight
SETPOINT_IDS = (mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET,)


@pytest.fixture
def installed() -> None:
    pytest.importorskip("mavsdk")


@pytest.mark.usefixtures("installed")
def test_actuator_controls_are_refused_for_the_same_reason(tmp_path: Path) -> None:
    with stub_behind() as port:
        flown = companion(f"udpin:127.0.0.1:{port}", tmp_path, library=LinkLibrary.MAVSDK, level="actuator")
    assert flown.outcome == "refused" and "fly at --level body_rate" in flown.text


@pytest.mark.usefixtures("installed")
def test_a_hung_loop_sends_nothing_and_the_autopilot_takes_over(tmp_path: Path) -> None:
    """MAVSDK's Offboard plugin would go on with the last setpoint at 20 Hz; here nothing may come."""
    setpoints: list[float] = []
    others: list[float] = []
    hung: list[float] = []
    modes: list[tuple[float, int]] = []  # PX4's main mode; 6 is OFFBOARD
    codec = mavlink.MAVLink(None)
    codec.robust_parsing = True

    def watch(datagram: bytes) -> list[bytes]:
        for message in codec.parse_buffer(bytearray(datagram)) or []:
            (setpoints if message.get_msgId() in SETPOINT_IDS else others).append(time.monotonic())
        return [datagram]

    def listen(datagram: bytes) -> list[bytes]:
        for message in codec.parse_buffer(bytearray(datagram)) or []:
            if message.get_type() == "HEARTBEAT":
                modes.append((time.monotonic(), message.custom_mode >> 16 & 0xFF))
        return [datagram]

    def hang() -> None:
        hung.append(time.monotonic())
        time.sleep(2.5)
        hung.append(time.monotonic())

    port = free_port()
    with stub_behind(lockstep=False) as stub_port, Relay(stub_port, UdpWire(port), listen, watch):
        flown = companion(
            f"udpin:127.0.0.1:{port}", tmp_path, library=LinkLibrary.MAVSDK, at={Phase.TRACK: hang}
        )
    began, ended = hung
    assert [t for t in setpoints if t < began]
    assert not [t for t in setpoints if began + 0.2 < t < ended]
    assert [t for t in others if began + 0.2 < t < ended]  # MAVSDK itself was alive meanwhile
    assert [mode for t, mode in modes if t < began][-1] == 6
    assert [mode for t, mode in modes if t < ended][-1] != 6  # offboard loss: it left our mode by itself
    assert flown.outcome in ("aborted", "pilot took over"), flown.text


def test_without_mavsdk_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mavsdk", None)
    with pytest.raises(UserError, match=r"pip install 'dtlannc-companion\[mavsdk\]'"):
        Connection(parse_endpoint("udpin:127.0.0.1:14999"), LinkLibrary.MAVSDK).open()


def test_another_mavsdk_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    class Old:
        __version__ = "3.0.1"

    monkeypatch.setitem(sys.modules, "mavsdk", Old)  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"MAVSDK 3\.0\.1 has another interface; version 4\.1"):
        Connection(parse_endpoint("udpin:127.0.0.1:14999"), LinkLibrary.MAVSDK).open()


@pytest.mark.usefixtures("installed")
def test_a_simulator_that_is_started_later_is_connected_to() -> None:
    import socket

    port = free_port()
    link = Connection(parse_endpoint(f"tcp:127.0.0.1:{port}"), LinkLibrary.MAVSDK).open()
    try:
        with socket.create_server(("127.0.0.1", port)) as listener:
            listener.settimeout(30.0)
            listener.accept()[0].close()
    finally:
        link.close()


@pytest.mark.usefixtures("installed")
def test_a_taken_port_is_an_error_of_one_line() -> None:
    import socket

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        endpoint = parse_endpoint(f"udpin:127.0.0.1:{taken.getsockname()[1]}")
        with pytest.raises(UserError, match="BIND_ERROR; another program has this port"):
            Connection(endpoint, LinkLibrary.MAVSDK).open()
