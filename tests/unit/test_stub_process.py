"""The stub as a process: starting, refusing, ending, lockstep over real sockets, clients that come and go."""

from __future__ import annotations

import hashlib
import os
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

import sitl_stub.server as server_module
from sitl_stub import Stub, StubError
from sitl_stub.firmware.px4.build import build_px4
from sitl_stub.mavlink.udp import UdpPort


class LockstepClient:
    """Answers TIMESYNC after everything before it, calls `react` for each message, keeps a digest of all bytes."""

    def __init__(self, stub: Stub) -> None:
        self.stub = stub
        self.connection = mavutil.mavlink_connection(stub.endpoint, source_system=255)
        self.time_s = 0.0
        self.digest = hashlib.sha256()
        self.numbers: list[int] = []
        """Sequence numbers, from the bytes: pymavlink reads none of messages newer than its dialect."""

    @property
    def count(self) -> int:
        return len(self.numbers)

    def run(self, until_s: float, react: object = None, patience_s: float = 30.0) -> None:
        end = time.monotonic() + patience_s
        while self.time_s < until_s:
            message = self.connection.recv_msg()
            if message is None:
                self.connection.select(0.2)
                if not self.stub.running:
                    return
                assert time.monotonic() < end, f"stuck at {self.time_s} s"
                continue
            self.digest.update(bytes(message.get_msgbuf()))
            self.numbers.append(message.get_msgbuf()[4])
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self.time_s = message.ts1 * 1e-9
                self.connection.mav.timesync_send(message.ts1 + 1, message.ts1)
            elif callable(react):
                react(self.connection.mav, message)

    def close(self) -> None:
        self.connection.close()


def _take_off_script() -> object:
    """Arm in offboard at 2 s and climb with position setpoints."""
    state = {"asked": 0}

    def react(mav: mavlink.MAVLink, message: object) -> None:
        if message.get_type() != "ATTITUDE_QUATERNION":  # type: ignore[attr-defined]
            return
        now = message.time_boot_ms  # type: ignore[attr-defined]
        mav.set_position_target_local_ned_send(now, 1, 1, 1, 0b100111111000, 0, 0, -2, 0, 0, 0, 0, 0, 0, 0, 0)
        if now >= 2000 and state["asked"] == 0:
            mav.command_long_send(1, 1, 176, 0, 1, 6, 0, 0, 0, 0, 0)
            mav.command_long_send(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
            state["asked"] = 1

    return react


def test_lockstep_gives_the_same_bytes_twice() -> None:
    digests = []
    for _ in range(2):
        with Stub(seed=5, lockstep=True, wind="1,1") as stub:
            client = LockstepClient(stub)
            client.run(5.0, _take_off_script())
            digests.append((client.count, client.digest.hexdigest()))
            client.close()
    assert digests[0] == digests[1]
    assert digests[0][0] > 1500


def test_in_lockstep_motion_comes_with_the_question_and_the_rest_behind_it() -> None:
    """Read from the bare socket: what lies in which datagram. In real time each frame has its own, as PX4 sends them."""
    reader = mavlink.MAVLink(None)
    for lockstep in (True, False):
        with Stub(lockstep=lockstep, speed=5.0) as stub:
            port = int(stub.endpoint.rpartition(":")[2])
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
                client.bind(("127.0.0.1", port))
                client.settimeout(10.0)
                behind: set[str] = set()
                asking = shared = 0
                for _ in range(600):
                    data, stub_address = client.recvfrom(65535)
                    messages = reader.parse_buffer(bytearray(data)) or []
                    names = [message.get_type() for message in messages]
                    shared += len(names) > 1
                    if "TIMESYNC" not in names or messages[-1].tc1 != 0:
                        behind.update(names)
                        continue
                    asking += len(names) > 1
                    if len(names) > 1 and asking > 1:  # not the very first, with its HEARTBEAT
                        assert names.index("TIMESYNC") == len(names) - 1
                    client.sendto(
                        mavlink.MAVLink(None).timesync_encode(1, messages[-1].ts1).pack(reader), stub_address
                    )
        assert (shared > 100) is lockstep and (asking > 100) is lockstep
        assert ("ATTITUDE" in behind) is not lockstep
        assert {"HIGHRES_IMU", "HEARTBEAT"} <= behind


def test_ready_line_comes_fast_and_port_is_free() -> None:
    started = time.monotonic()
    with Stub() as first, Stub() as second:
        assert time.monotonic() - started < 10.0  # 0.15 s each on an idle machine
        assert first.endpoint != second.endpoint
        assert first.ready["firmware"] == "px4"
        assert first.mavsdk_address.startswith("udpin://127.0.0.1:")


@pytest.mark.parametrize("transport", ["tcp", "udp-server"])
def test_other_transports_serve_a_client(transport: str) -> None:
    with Stub(transport=transport, speed=5.0) as stub:
        connection = mavutil.mavlink_connection(stub.endpoint, source_system=255)
        heartbeat = None
        for _ in range(50):
            connection.mav.heartbeat_send(6, 8, 0, 0, 4)
            heartbeat = connection.recv_match(type="HEARTBEAT", blocking=True, timeout=0.2)
            if heartbeat is not None:
                break
        assert heartbeat is not None and heartbeat.autopilot == mavlink.MAV_AUTOPILOT_PX4
        connection.close()


def test_lockstep_over_tcp() -> None:
    with Stub(transport="tcp", lockstep=True) as stub:
        client = LockstepClient(stub)
        client.run(3.0)
        assert client.time_s >= 3.0
        client.close()


def test_client_killed_in_lockstep_flight_is_landed_by_failsafe() -> None:
    with Stub(lockstep=True, speed=5.0, exit_on_disarm=True) as stub:
        client = LockstepClient(stub)
        client.run(6.0, _take_off_script())
        client.close()
        # nobody answers: the refused datagrams say so at once, time runs by the clock, offboard loss lands it
        assert stub.wait(30.0) == 0
    assert stub.summary is not None
    assert 7.0 < stub.summary["simulated_s"] < 25.0


def test_client_comes_back_and_lockstep_resumes() -> None:
    with Stub(lockstep=True) as stub:
        client = LockstepClient(stub)
        client.run(2.0)
        client.close()
        time.sleep(0.3)
        again = LockstepClient(stub)
        again.time_s = 0.0
        again.run(6.0)
        again.run(again.time_s + 0.5)  # the first answer only ends the real time it came in
        before = again.time_s
        time.sleep(0.4)
        # unanswered, simulated time must not have gone on: lockstep, not the clock
        waiting = iter(again.connection.recv_msg, None)
        later = [m.ts1 * 1e-9 for m in waiting if m.get_type() == "TIMESYNC" and m.tc1 == 0]
        assert later[-1] - before < 0.03
        again.close()


def test_client_that_never_answers_timesync_gets_real_time_after_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server_module, "SILENCE_TO_REAL_TIME_S", 0.3)
    port = UdpPort(("127.0.0.1", 0), None, "onboard")
    server = server_module.Server([port], speed=50.0, lockstep=True)
    server.duration_us = 3_000_000
    autopilot = build_px4()
    runner = threading.Thread(target=server.run, args=(autopilot,), daemon=True)
    runner.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        frame = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mavlink.MAVLink(None, 255, 190))
        time.sleep(0.2)
        assert autopilot.time_us == 0  # nobody has spoken: time stands
        sender.sendto(bytes(frame), port.local)
        runner.join(20.0)
    server.close()
    assert autopilot.time_us >= 3_000_000


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--vehicle", "nope"], "choose from"),
        (["--param", "NOPE=3"], "unknown parameter"),
        (["--param", "MC_ROLL_P"], "NAME=NUMBER"),
        (["--estimator", "nope"], "mocap"),
        (["--udp", "127.0.0.1:99999"], "0 to 65535"),
        (["--wind", "strong"], "--wind"),
        (["--mass", "-1"], "mass"),
        (["--speed", "0"], "--speed"),
        (["--seed", "-1"], "--seed"),
    ],
)
def test_wrong_arguments_are_one_line_and_exit_two(arguments: list[str], part: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sitl_stub", *arguments],
        check=False,
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1 and part in done.stderr


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_taken_port_is_refused(kind: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM if kind == "udp" else socket.SOCK_STREAM) as holder:
        holder.bind(("127.0.0.1", 0))
        if kind == "tcp":
            holder.listen()
        port = holder.getsockname()[1]
        option = ["--udp-server", f"127.0.0.1:{port}"] if kind == "udp" else ["--tcp", f"127.0.0.1:{port}"]
        with pytest.raises(StubError, match=f"port {port} .* cannot be used"):
            Stub(arguments=option).start()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_cleanly_with_a_summary(number: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "sitl_stub", "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert "ready" in process.stdout.readline()
    process.send_signal(number)
    output, errors = process.communicate(timeout=20)
    assert process.returncode == 0
    assert "s simulated" in output.splitlines()[-1]
    assert errors == ""


def _is_zombie(pid: int) -> bool:
    """Ended, and only waiting for somebody to look."""
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().split()[2] == "Z"


def test_no_orphan_when_the_parent_is_killed() -> None:
    code = "import time; from sitl_stub import Stub; s = Stub(); s.start(); print(s.process.pid, flush=True)"
    code += "; time.sleep(60)"
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    end = time.monotonic() + 15.0
    while time.monotonic() < end:
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        if _is_zombie(child):
            return
        time.sleep(0.1)
    os.kill(child, signal.SIGKILL)
    pytest.fail("the stub outlived its parent")


def test_hostile_datagrams_do_not_stop_it() -> None:
    with Stub(speed=2.0) as stub:
        sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        own = tuple(stub.ready["links"][0]["local"])
        for size in range(300):
            sender.sendto(bytes([0xFD, size % 256]) + os.urandom(size), own)
        connection = mavutil.mavlink_connection(stub.endpoint, source_system=255)
        assert connection.recv_match(type="HEARTBEAT", blocking=True, timeout=10) is not None
        connection.close()
        sender.close()
        assert stub.running


def test_a_client_that_is_gone_leaves_nothing_to_spin_on() -> None:
    """Refused datagrams stand in the socket's error queue; read, the selector waits again."""
    gone = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    gone.bind(("127.0.0.1", 0))
    port = UdpPort(("127.0.0.1", 0), gone.getsockname(), "onboard")
    gone.close()
    with selectors.DefaultSelector() as selector:
        selector.register(port.socket, selectors.EVENT_READ)
        for _ in range(3):
            port.links[0].send_bytes(b"x")
            assert selector.select(1.0)
            port.receive(port.socket)
            assert not selector.select(0.0)
    port.close()
