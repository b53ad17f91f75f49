"""The wires themselves, on loopback: UDP both ways, TCP both ways, a serial line of two pseudo-terminals."""

from __future__ import annotations

import os
import socket
import threading
import time
import tty

import pytest
from mavlink_wire import Sender, attitude, heartbeat, local_position, mav

from companion.config.errors import UserError
from companion.mavlink.endpoint import parse_endpoint
from companion.mavlink.link import Link
from companion.mavlink.transport import CHUNKS_PER_READ, open_transport

HERE = "127.0.0.1"


def udp_socket():
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind((HERE, 0))
    made.settimeout(5.0)
    return made


def free_port(kind=socket.SOCK_DGRAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((HERE, 0))
        return probe.getsockname()[1]


def opened(transport, patience_s=5.0):
    """Wait until there is a connection."""
    deadline = time.monotonic() + patience_s
    while transport.not_open and time.monotonic() < deadline:
        transport.wait(0.01)
    assert not transport.not_open


def received(transport, bytes_wanted, patience_s=5.0):
    """Bytes until as many as wanted are there."""
    deadline, data = time.monotonic() + patience_s, b""
    while len(data) < bytes_wanted and time.monotonic() < deadline:
        if transport.wait(0.05):
            data += b"".join(transport.receive())
    return data


@pytest.fixture
def udp_in():
    port = free_port()
    transport = open_transport(parse_endpoint(f"udpin:{HERE}:{port}"))
    autopilot = udp_socket()
    yield transport, autopilot, (HERE, port)
    transport.close()
    autopilot.close()


# UDP ----------------------------------------------------------------------------------------------------


def test_udp_in_answers_the_sender_whose_heartbeat_was_believed(udp_in):
    transport, autopilot, address = udp_in
    link, stranger = Link(transport), udp_socket()
    assert not link.send(heartbeat())  # nobody to send to yet
    stranger.sendto(b"\xfd garbage", address)
    stranger.sendto(Sender(255, 190).frame(heartbeat(mav.MAV_AUTOPILOT_INVALID)), address)
    autopilot.sendto(Sender().frame(heartbeat()), address)
    messages = []
    deadline = time.monotonic() + 5.0
    while not messages and time.monotonic() < deadline:
        messages += [m for m in [link.receive(0.05)] if m is not None]
    assert [m.get_type() for m in messages] == ["HEARTBEAT"]
    assert link.send(attitude(1))
    data, sender = autopilot.recvfrom(2048)
    assert sender == address
    assert mav.MAVLink(None).decode(bytearray(data)).get_type() == "ATTITUDE_QUATERNION"

    stranger.sendto(
        Sender().frame(attitude(99_000)), address
    )  # the autopilot's own numbers from another address
    autopilot.sendto(Sender().frame(attitude(20)), address)
    message = None
    while message is None and time.monotonic() < deadline:
        message = link.receive(0.05)
    assert message.time_boot_ms == 20
    stranger.close()


def test_udp_out_speaks_first_and_hears_its_peer_only():
    autopilot, stranger = udp_socket(), udp_socket()
    transport = open_transport(parse_endpoint(f"udpout:{HERE}:{autopilot.getsockname()[1]}"))
    assert transport.send(b"hello")
    data, ours = autopilot.recvfrom(100)
    assert data == b"hello"
    stranger.sendto(b"stranger", ours)
    autopilot.sendto(b"one", ours)
    autopilot.sendto(b"two", ours)
    assert received(transport, 6) == b"onetwo"
    for each in (transport, autopilot, stranger):
        each.close()


def test_udp_peer_that_is_not_there_is_silence_and_no_error():
    transport = open_transport(parse_endpoint(f"udpout:{HERE}:{free_port()}"))
    for _ in range(20):  # refused by ICMP from the second on
        transport.send(b"anybody?")
        transport.wait(0.001)
        assert transport.receive() == []
    transport.close()


def test_udp_reads_are_bounded_and_keep_datagrams_apart(udp_in):
    transport, autopilot, address = udp_in
    autopilot.sendto(b"first", address)
    transport.wait(1.0)
    assert transport.receive() == [b"first"]
    transport.believe_sender()
    sent = [b"%d" % index for index in range(CHUNKS_PER_READ + 20)]
    for data in sent:
        autopilot.sendto(data, address)
    transport.wait(1.0)
    got = transport.receive()
    assert len(got) <= CHUNKS_PER_READ
    deadline = time.monotonic() + 5.0
    while len(got) < len(sent) and time.monotonic() < deadline:
        transport.wait(0.05)
        got += transport.receive()
    assert got == sent


def test_a_strangers_flood_leaves_the_peers_datagrams_their_room(udp_in):
    """More than the socket's queue holds: without the kernel's filter the peer's last datagram would be lost."""
    transport, autopilot, address = udp_in
    autopilot.sendto(b"first", address)
    assert received(transport, 5) == b"first"
    transport.believe_sender()
    with udp_socket() as stranger:
        for _ in range(20_000):
            stranger.sendto(b"stranger" * 16, address)
    autopilot.sendto(b"second", address)
    assert transport.wait(5.0)
    assert transport.receive() == [b"second"]
    assert not transport.wait(0.0)


def test_whoever_is_heard_after_the_peers_silence_may_become_the_peer(udp_in, monkeypatch):
    transport, autopilot, address = udp_in
    autopilot.sendto(b"first", address)
    received(transport, 5)
    transport.believe_sender()
    monkeypatch.setattr("companion.mavlink.transport.PEER_SILENT_S", 0.0)
    assert not transport.wait(0.0)  # notices the silence
    with udp_socket() as moved:
        moved.sendto(b"here now", address)
        assert received(transport, 8) == b"here now"
        transport.believe_sender()
        assert transport.peer == moved.getsockname()
    assert "now speaks from" in transport.notices[-1]


def test_taken_port_is_one_line_with_a_remedy(udp_in):
    with pytest.raises(UserError, match="another program has this port") as caught:
        open_transport(parse_endpoint(f"udpin:{HERE}:{udp_in[2][1]}"))
    assert str(udp_in[2][1]) in str(caught.value)


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("udpin:203.0.113.7:14540", "no such address"),
        ("udpout:no-such-host.invalid:14550", "check the address"),
        ("tcpin:203.0.113.7:5760", "no such address"),
        ("/dev/no-such-tty,57600", "no such device"),
        ("/dev/null,57600", "check the address"),
    ],
)
def test_what_cannot_be_opened_is_one_line(address, says):
    with pytest.raises(UserError, match=says) as caught:
        open_transport(parse_endpoint(address))
    assert "\n" not in str(caught.value)


# TCP ----------------------------------------------------------------------------------------------------


@pytest.fixture(params=["client", "server"])
def tcp(request):
    """Our transport and the other side's socket, whoever connected."""
    if request.param == "client":
        listener = socket.create_server((HERE, 0))
        transport = open_transport(parse_endpoint(f"tcp:{HERE}:{listener.getsockname()[1]}"))
        other, _ = listener.accept()
        listener.close()
    else:
        port, others = free_port(socket.SOCK_STREAM), []

        def connect():
            deadline = time.monotonic() + 5.0
            while not others and time.monotonic() < deadline:
                try:
                    others.append(socket.create_connection((HERE, port), timeout=1.0))
                except ConnectionRefusedError:
                    time.sleep(0.005)

        caller = threading.Thread(target=connect)
        caller.start()
        transport = open_transport(parse_endpoint(f"tcpin:{HERE}:{port}"))
        opened(transport)
        transport.notices.clear()
        caller.join()
        other = others[0]
    other.settimeout(5.0)
    yield transport, other
    transport.close()
    other.close()


def test_tcp_both_ways(tcp):
    transport, other = tcp
    assert transport.send(b"ping")
    assert other.recv(10) == b"ping"
    other.sendall(b"pong")
    assert received(transport, 4) == b"pong"


def test_tcp_that_ends_is_told(tcp):
    transport, other = tcp
    other.close()
    assert transport.wait(5.0)
    assert transport.receive() == []
    assert "the other side is gone; trying to connect again" in transport.notices.popleft()
    assert not transport.send(b"anybody?")


def test_tcp_that_is_torn_down_is_told_when_sending(tcp):
    transport, other = tcp
    other.setsockopt(
        socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0"
    )  # reset instead of an orderly end
    other.close()
    assert not all(transport.send(b"x" * 100) for _ in range(100))
    assert len(transport.notices) == 1


def test_tcp_drops_whole_frames_when_nobody_reads(tcp):
    """What arrives in the end is whole frames in order: none is cut, none is sent twice."""
    transport, other = tcp
    sent = []
    for index in range(100_000):
        frame = b"%07d\n" % index + b"." * 492
        if transport.send(frame):
            sent.append(frame)
        elif index > len(sent) + 5:
            break
    assert 10 < len(sent) < 100_000
    reader, data = threading.Event(), bytearray()

    def read():
        while len(data) < 500 * len(sent):
            data.extend(other.recv(1 << 16))
        reader.set()

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    deadline = time.monotonic() + 10.0
    while not reader.wait(0.01) and time.monotonic() < deadline:
        if transport.send(b"e" * 500):  # what was begun is finished first
            sent.append(b"e" * 500)
    thread.join(5.0)
    assert bytes(data) == b"".join(sent)[: len(data)]
    assert len(data) >= 500 * (len(sent) - 1)


@pytest.mark.parametrize("kind", ["tcp", "tcpin"])
def test_tcp_waits_for_the_other_side_without_blocking(kind):
    port = free_port(socket.SOCK_STREAM)
    began_s = time.monotonic()
    transport = open_transport(parse_endpoint(f"{kind}:{HERE}:{port}"))
    assert time.monotonic() - began_s < 1.0
    says = {"tcp": "nobody listens there", "tcpin": "nobody has connected"}[kind]
    assert transport.not_open.startswith(says)
    assert transport.notices.popleft() == f"endpoint {kind}:{HERE}:{port}: {says} yet; waiting"
    assert not transport.wait(0.0) and transport.receive() == [] and not transport.send(b"anybody?")
    if kind == "tcp":
        listener = socket.create_server((HERE, port))
        opened(transport)
        other = listener.accept()[0]
        listener.close()
    else:
        other = socket.create_connection((HERE, port), timeout=5.0)
        opened(transport)
    assert transport.send(b"here")
    other.settimeout(5.0)
    assert other.recv(10) == b"here"
    assert ": connected after 0." in transport.notices.popleft() and not transport.notices
    transport.close()
    other.close()


# Serial -------------------------------------------------------------------------------------------------


@pytest.fixture
def serial_line():
    """Our serial transport at 921,600 baud, and the file descriptor of the other end."""
    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    transport = open_transport(parse_endpoint(f"{os.ttyname(slave)},921600"))
    yield transport, master, os.ttyname(slave)
    transport.close()
    os.close(slave)
    os.close(master)


def test_serial_carries_a_second_of_real_traffic_with_noise(serial_line):
    """100 Hz of attitude, 50 Hz of position and heartbeats in 16-byte reads, with line noise: nothing is lost."""
    transport, master, _ = serial_line
    link, autopilot = Link(transport), Sender()
    frames = [autopilot.frame(heartbeat())]
    for tick in range(100):
        frames.append(autopilot.frame(attitude(10 * tick + 10)))
        if tick % 2:
            frames.append(autopilot.frame(local_position(10 * tick + 10)))
        if tick % 10 == 0:
            frames.append(b"\x00\xff\x7f\n")  # noise
    data = b"".join(frames)

    def write():
        for at in range(0, len(data), 16):
            os.write(master, data[at : at + 16])

    writer = threading.Thread(target=write)
    writer.start()
    messages = []
    deadline = time.monotonic() + 10.0
    while len(messages) < 151 and time.monotonic() < deadline:
        message = link.receive(0.05)
        if message is not None:
            messages.append(message.get_type())
    writer.join()
    assert messages.count("ATTITUDE_QUATERNION") == 100
    assert messages.count("LOCAL_POSITION_NED") == 50
    assert link.counters["lost"] == 0
    assert link.receive(0.0) is None
    assert link.counters["stray bytes"] == 40
    assert link.send(heartbeat())
    assert mav.MAVLink(None).decode(bytearray(os.read(master, 300))).get_type() == "HEARTBEAT"


def test_serial_port_is_ours_alone(serial_line):
    with pytest.raises(UserError):
        open_transport(parse_endpoint(f"{serial_line[2]},921600"))


def test_serial_that_is_pulled_out_is_told():
    master, slave = os.openpty()
    transport = open_transport(parse_endpoint(f"{os.ttyname(slave)},57600"))
    os.close(slave)
    os.close(master)
    assert transport.wait(5.0)
    assert transport.receive() == []
    assert "trying to connect again" in transport.notices.popleft()
    assert not transport.send(b"still there?")
    transport.close()
