"""Passing on over real sockets, byte for byte: every kind of client wire, the law's part, strangers, floods and deaths."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from companion.config.errors import UserError
from companion.mavlink.endpoint import parse_endpoint
from companion.mavlink.layouts import mav
from companion.mavlink.signing import Signer
from companion.mavlink.transport import open_transport
from companion.serve.client_wires import open_door
from companion.serve.forwarder import LAW_COMPONENT, LET_GO, READY, TAKE, Forwarder, joined, whole_frames

HERE = "127.0.0.1"
KEY = bytes(range(32))
POSITION = mav.MAVLink_set_position_target_local_ned_message(
    5, 1, 1, 1, 0x0DF8, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
)
ATTITUDE = mav.MAVLink_set_attitude_target_message(5, 1, 1, 7, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0.5)
PING = mav.MAVLink_ping_message(7, 1, 1, 1)
GCS = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
VEHICLE = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_PX4, 81, 0, 4, 3)


def packed(message: Any, system: int = 245, component: int = 190, signer: Signer | None = None) -> bytes:
    codec = mav.MAVLink(None, srcSystem=system, srcComponent=component)
    if signer is not None:
        signer.prepare(codec)
    return bytes(message.pack(codec))


UNKNOWN = bytes([0xFD, 4, 0, 0, 9, 245, 190, 0xFE, 0xFF, 0x7F, 1, 2, 3, 4, 0xAB, 0xCD])
"""A message that no dialect has."""


class Wire:
    """A peer's UDP socket."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((HERE, 0))
        self.socket.settimeout(5.0)
        self.port = self.socket.getsockname()[1]

    def send(self, data: bytes, port: int) -> None:
        self.socket.sendto(data, (HERE, port))

    def receive(self) -> bytes:
        return self.socket.recv(65535)

    def is_silent(self) -> bool:
        """Nothing has come, once what was sent before has: the caller has received something later elsewhere."""
        self.socket.setblocking(False)
        try:
            self.socket.recv(65535)
        except BlockingIOError:
            return True
        finally:
            self.socket.settimeout(5.0)
        return False


class Served:
    """A forwarder in a thread, between an autopilot and whoever comes."""

    def __init__(self, *clients: str, **options: Any) -> None:
        self.autopilot = Wire()
        self.port = free_port()
        self.said: list[str] = []
        self.doors = [open_door(text) for text in clients]
        transport = open_transport(parse_endpoint(f"udpin:{HERE}:{self.port}"))
        self.forwarder = Forwarder(transport, list(self.doors), self.said.append, **options)
        self.law = self.control = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Served:
        self._thread.start()
        return self

    def _run(self) -> None:
        while not self._stop.is_set():
            self.forwarder.step(0.02)

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self.forwarder.close()
        self.autopilot.socket.close()

    def employ(self) -> tuple[socket.socket, socket.socket]:
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2)]
        for ours, _ in pairs:
            ours.settimeout(5.0)
        self.forwarder.employ(pairs[0][1], pairs[1][1])
        pairs[1][0].send(READY)
        assert until(lambda: self.forwarder._law_listens)
        return pairs[0][0], pairs[1][0]

    def from_vehicle(self, data: bytes) -> None:
        self.autopilot.send(data, self.port)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((HERE, 0))
        return int(probe.getsockname()[1])


def until(condition: Callable[[], bool]) -> bool:
    end = time.monotonic() + 5.0
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.005)
    return True


@pytest.fixture
def served() -> Iterator[tuple[Served, Wire, int]]:
    """One UDP client behind a door that listens, known to both sides."""
    port = free_port()
    with Served(f"udpin::{port}") as served:
        client = Wire()
        served.from_vehicle(packed(VEHICLE, 1, 1))
        assert until(lambda: served.forwarder._believed is not None)
        client.send(packed(GCS), port)
        assert served.autopilot.receive() == packed(GCS)
        yield served, client, port
        client.socket.close()


def test_frames_of_a_datagram_by_their_lengths() -> None:
    both = packed(PING) + UNKNOWN
    assert whole_frames(both) == [packed(PING), UNKNOWN]
    assert whole_frames(both[:-1]) is None
    assert whole_frames(b"hello") is None
    assert joined([b"a" * 900, b"b" * 400, b"c" * 200]) == [b"a" * 900 + b"b" * 400, b"c" * 200]


@pytest.mark.parametrize(
    "data",
    [packed(PING), UNKNOWN, packed(PING) + UNKNOWN, packed(PING, signer=Signer(KEY))],
    ids=["known", "unknown", "several", "signed"],
)
def test_both_ways_byte_for_byte(served: tuple[Served, Wire, int], data: bytes) -> None:
    """Known or not, one frame or several, signed with a key that we do not have."""
    run, client, port = served
    run.from_vehicle(data)
    assert client.receive() == data
    client.send(data, port)
    assert run.autopilot.receive() == data


def test_a_known_message_with_fields_of_a_newer_dialect_is_passed_on(
    served: tuple[Served, Wire, int],
) -> None:
    """Its checksum is another dialect's: not ours to judge, while it fills its datagram."""
    run, client, port = served
    foreign = bytearray(packed(PING))
    foreign[-1] ^= 0x55
    client.send(bytes(foreign), port)
    assert run.autopilot.receive() == bytes(foreign)
    run.from_vehicle(bytes(foreign))
    assert client.receive() == bytes(foreign)


def test_every_kind_of_client_hears_the_vehicle_and_not_the_others() -> None:
    listens, tcp_port, listener = free_port(), free_port(), Wire()
    with Served(
        f"udpin:{HERE}:{listens}", f"tcpin:{HERE}:{tcp_port}", f"udpout:{HERE}:{listener.port}"
    ) as run:
        speaker, other = Wire(), Wire()
        run.from_vehicle(packed(VEHICLE, 1, 1))
        assert listener.receive() == packed(VEHICLE, 1, 1)
        connection = socket.create_connection((HERE, tcp_port), timeout=5.0)
        assert until(lambda: len(run.doors[1].clients) == 1)
        for wire in (speaker, other):
            wire.send(packed(GCS), listens)
            assert run.autopilot.receive() == packed(GCS)
        connection.sendall(packed(PING)[:5])
        connection.sendall(packed(PING)[5:] + UNKNOWN[:3])
        assert run.autopilot.receive() == packed(PING)
        run.from_vehicle(packed(PING, 1, 1))
        assert speaker.receive() == other.receive() == listener.receive() == packed(PING, 1, 1)
        assert connection.recv(len(packed(PING, 1, 1))) == packed(PING, 1, 1)
        assert listener.is_silent() and speaker.is_silent() and other.is_silent()
        connection.close()
        assert until(lambda: not run.doors[1].clients)
        for wire in (speaker, other, listener):
            wire.socket.close()


def test_what_listens_listens_here_only() -> None:
    port = free_port()
    door = open_door(f"udpin::{port}")
    try:
        assert door._socket.getsockname() == (HERE, port)  # type: ignore[attr-defined]
        with pytest.raises(UserError, match="another program"):
            open_door(f"udpin::{port}")
    finally:
        door.close()
    with pytest.raises(UserError, match="clients come to us"):
        open_door(f"tcp:{HERE}:{port}")


def test_strangers_are_dropped_and_counted(served: tuple[Served, Wire, int]) -> None:
    run, client, port = served
    stranger = Wire()
    stranger.send(b"GET / HTTP/1.1", port)
    damaged = bytearray(packed(PING))
    damaged[-1] ^= 1
    stranger.send(bytes(damaged), port)
    assert until(lambda: run.doors[0].counters["strangers' datagrams"] == 2)
    assert len(run.doors[0].clients) == 1
    client.send(packed(PING), port)
    assert run.autopilot.receive() == packed(PING)
    stranger.socket.close()


def test_another_program_cannot_take_a_clients_port(served: tuple[Served, Wire, int]) -> None:
    _, _, port = served
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
        thief.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with pytest.raises(OSError, match="in use"):
            thief.bind((HERE, port))


def test_nobody_but_the_autopilot_is_the_autopilot(served: tuple[Served, Wire, int]) -> None:
    run, client, _ = served
    Wire().send(packed(VEHICLE, 1, 1), run.port)
    run.from_vehicle(packed(PING, 1, 1))
    assert client.receive() == packed(PING, 1, 1)


def test_the_law_hears_the_vehicle_and_flies_what_clients_ask_for(served: tuple[Served, Wire, int]) -> None:
    run, client, port = served
    law, control = run.employ()
    run.from_vehicle(packed(VEHICLE, 1, 1))
    assert law.recv(4096) == client.receive() == packed(VEHICLE, 1, 1)
    client.send(packed(POSITION), port)
    assert run.autopilot.receive() == control.recv(4096) == packed(POSITION)
    law.send(packed(ATTITUDE, 1, LAW_COMPONENT))  # has not taken over
    assert until(lambda: run.forwarder.switch.counters["setpoints of the law held back"] == 1)
    control.send(TAKE.pack(b"T", 1))
    law.send(packed(ATTITUDE, 1, LAW_COMPONENT))
    assert run.autopilot.receive() == packed(ATTITUDE, 1, LAW_COMPONENT)
    client.send(packed(POSITION) + packed(PING), port)
    assert control.recv(4096) == packed(POSITION)
    assert run.autopilot.receive() == packed(PING)
    control.send(LET_GO)
    assert run.autopilot.receive() == packed(POSITION)  # held back, and its client's last word


def test_when_the_law_dies_setpoints_are_passed_on(served: tuple[Served, Wire, int]) -> None:
    run, client, port = served
    law, control = run.employ()
    control.send(TAKE.pack(b"T", 1))
    assert until(lambda: run.forwarder.switch.taken)
    client.send(packed(POSITION), port)
    assert control.recv(4096) == packed(POSITION)
    law.close()
    control.close()
    assert run.autopilot.receive() == packed(POSITION)
    client.send(packed(POSITION), port)
    assert run.autopilot.receive() == packed(POSITION)
    assert run.said == ["our law is gone: setpoints of clients are passed on"]


def test_a_law_that_hangs_has_let_go(served: tuple[Served, Wire, int]) -> None:
    """The vehicle speaks, and no setpoint of ours comes: the client's go on."""
    run, client, port = served
    _, control = run.employ()
    control.send(TAKE.pack(b"T", 1))
    assert until(lambda: run.forwarder.switch.taken)

    def lapsed() -> bool:
        run.from_vehicle(packed(PING, 1, 1))
        return not run.forwarder.switch.taken

    assert until(lapsed)
    assert control.recv(64) == LET_GO
    client.send(packed(POSITION), port)
    assert run.autopilot.receive() == packed(POSITION)


def test_answers_to_the_laws_questions_are_its_own(served: tuple[Served, Wire, int]) -> None:
    """A client may be of the same kind, and not look at whom an answer is for."""
    run, client, _ = served
    law, _ = run.employ()
    law.send(packed(mav.MAVLink_timesync_message(0, 77), 1, LAW_COMPONENT))
    run.autopilot.receive()
    ours = packed(mav.MAVLink_command_ack_message(511, 0, 0, 0, 1, LAW_COMPONENT), 1, 1)
    theirs = packed(mav.MAVLink_command_ack_message(511, 0, 0, 0, 1, 191), 1, 1)
    our_time = packed(mav.MAVLink_timesync_message(5, 77), 1, 1)
    their_time = packed(mav.MAVLink_timesync_message(5, 78), 1, 1)
    run.from_vehicle(ours + theirs)
    run.from_vehicle(our_time)
    run.from_vehicle(their_time)
    assert [client.receive() for _ in range(2)] == [theirs, their_time]
    assert [law.recv(4096) for _ in range(3)] == [ours + theirs, our_time, their_time]


def test_the_law_is_told_when_a_client_asks_for_other_rates(served: tuple[Served, Wire, int]) -> None:
    run, client, port = served
    _, control = run.employ()
    asked = packed(mav.MAVLink_command_long_message(1, 1, 511, 0, 30, 100000, 0, 0, 0, 0, 0))
    client.send(packed(PING), port)
    client.send(asked, port)
    assert [run.autopilot.receive() for _ in range(2)] == [packed(PING), asked]
    assert control.recv(4096) == asked


def test_signing_can_be_demanded_of_clients() -> None:
    port, signer = free_port(), Signer(KEY)
    with Served(f"udpin::{port}", signer=Signer(KEY), demand_signing=True) as run:
        run.from_vehicle(packed(VEHICLE, 1, 1))
        client = Wire()
        client.send(packed(PING), port)
        signed = packed(PING, signer=signer)
        client.send(signed, port)
        assert run.autopilot.receive() == signed
        assert run.forwarder.counters["of clients, refused: not signed"] == 1
        client.socket.close()


def test_a_client_gone_is_forgotten_and_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.serve.client_wires.REFUSED_FOR_S", 0.1)
    port = free_port()
    with Served(f"udpin::{port}") as run:
        run.from_vehicle(packed(VEHICLE, 1, 1))
        client = Wire()
        client.send(packed(GCS), port)
        assert run.autopilot.receive() == packed(GCS)
        client.socket.close()

        def forgotten() -> bool:
            run.from_vehicle(packed(PING, 1, 1))
            return not run.doors[0].clients

        assert until(forgotten)
        again = Wire()
        again.send(packed(GCS), port)
        assert run.autopilot.receive() == packed(GCS)
        again.socket.close()


def test_a_flood_of_one_client_costs_the_others_nothing(
    served: tuple[Served, Wire, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is more than may be read waits in the flooder's own queue; all of another client's frames pass meanwhile."""
    monkeypatch.setattr("companion.serve.forwarder.BURST", 20)
    monkeypatch.setattr("companion.serve.forwarder.MOST_PER_S", 50)
    run, client, port = served
    flooder = Wire()
    flooder.send(packed(GCS), port)
    run.autopilot.receive()
    for _ in range(250):
        flooder.send(UNKNOWN, port)
    begun = time.monotonic()
    floods = 0
    for k in range(100):
        ping = packed(mav.MAVLink_ping_message(k, 1, 1, 1))
        client.send(ping, port)
        while (came := run.autopilot.receive()) != ping:
            assert came == UNKNOWN
            floods += 1
    assert floods <= 20 + 8 + 50 * (time.monotonic() - begun)
    flooder.socket.close()
