"""Clients that come, go, are killed and come back, and many stubs side by side; pymavlink's own conveniences."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavparm, mavutil

from sitl_stub import Stub

pytestmark = pytest.mark.flight
mavlink = mavutil.mavlink
PATIENCE_S = 240.0  # a new machine compiles first
FIRMWARES = ("px4", "ardupilot")


def connected(stub: Stub, system: int = 255) -> Any:
    """A mavutil connection that has heard a HEARTBEAT and spoken."""
    link = mavutil.mavlink_connection(stub.endpoint, source_system=system)
    assert link.wait_heartbeat(timeout=PATIENCE_S) is not None
    link.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)
    return link


def answer(link: Any, number: int, *params: float) -> int | None:
    """Result of a command, asked again when the answer is late."""
    filled = [*params, *[0.0] * (7 - len(params))]
    wanted = f"COMMAND_ACK.command=={number}"
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        link.mav.command_long_send(1, 1, number, 0, *filled)
        ack = link.recv_match(type="COMMAND_ACK", condition=wanted, blocking=True, timeout=10)
        if ack is not None:
            return int(ack.result)
    return None


def until(condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> bool:
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


@pytest.fixture(params=FIRMWARES)
def flown(request: pytest.FixtureRequest) -> Iterator[tuple[Stub, Any]]:
    with Stub(request.param, speed=5.0, ready_after_s=1.0, estimator="perfect") as stub:
        link = connected(stub)
        yield stub, link
        link.close()


def test_mavutils_conveniences_fly_it(flown: tuple[Stub, Any]) -> None:
    """wait_heartbeat, mode_mapping, set_mode, arducopter_arm, motors_armed_wait, recv_match, location, flightmode."""
    _, link = flown
    px4 = link.field("HEARTBEAT", "autopilot") == mavlink.MAV_AUTOPILOT_PX4
    link.mav.request_data_stream_send(1, 1, mavlink.MAV_DATA_STREAM_ALL, 10, 1)
    ready = f"SYS_STATUS.onboard_control_sensors_health & {mavlink.MAV_SYS_STATUS_PREARM_CHECK}"
    assert link.recv_match(type="SYS_STATUS", condition=ready, blocking=True, timeout=PATIENCE_S) is not None
    start = link.location(relative_alt=True)
    if not px4:
        link.set_mode("GUIDED")
        assert until(lambda: link.wait_heartbeat(timeout=5) is not None and link.flightmode == "GUIDED")
    link.arducopter_arm()
    link.motors_armed_wait()
    assert link.motors_armed()
    nan = float("nan")
    height = link.location().alt + 3.0 if px4 else 3.0
    assert (
        answer(
            link, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, nan if px4 else 0, *[nan if px4 else 0] * 2, height
        )
        == 0
    )
    climbed = "GLOBAL_POSITION_INT.relative_alt > 2600"
    assert (
        link.recv_match(type="GLOBAL_POSITION_INT", condition=climbed, blocking=True, timeout=PATIENCE_S)
        is not None
    )
    assert link.location(relative_alt=True).alt - start.alt == pytest.approx(3.0, abs=0.6)
    link.set_mode("LAND")
    assert until(lambda: link.wait_heartbeat(timeout=5) is not None and link.flightmode == "LAND")
    link.motors_disarmed_wait()


def test_pymavlinks_parameter_list_and_settings(flown: tuple[Stub, Any], tmp_path: Path) -> None:
    """param_fetch_all, re-requests of what is missing, MAVParmDict's mavset (waits for the echo), save and load."""
    stub, link = flown
    px4 = stub.ready["firmware"] == "px4"
    link.param_fetch_all()
    count, found = 0, mavparm.MAVParmDict()
    asked: set[int] = set()
    indices: set[int] = set()
    dropped = 0
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end and (not count or len(indices) < count):
        value = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=1)
        if value is None:
            missing = [i for i in range(count) if i not in indices]
            asked.update(missing)
            for index in missing[:50]:
                link.mav.param_request_read_send(1, 1, b"", index)
            continue
        if value.param_id == "_HASH_CHECK":
            continue
        count = value.param_count
        if dropped < 20 and value.param_index not in asked:
            dropped += 1  # as if they had been lost
            continue
        indices.add(value.param_index)
        found[value.param_id] = value.param_value
    assert len(indices) == count > 400
    assert dropped == 20 and asked
    name, number = ("MPC_XY_P" if px4 else "ATC_ANG_RLL_P"), 0.9
    assert found.mavset(link, name, number, retries=5)
    link.mav.param_request_read_send(1, 1, name.encode(), -1)
    wanted = f"PARAM_VALUE.param_id=='{name}'"
    read = link.recv_match(type="PARAM_VALUE", condition=wanted, blocking=True, timeout=10)
    assert read.param_value == pytest.approx(number)
    found.save(str(tmp_path / "all.parm"))
    again = mavparm.MAVParmDict()
    assert again.load(str(tmp_path / "all.parm"))
    assert again[name] == pytest.approx(number, abs=1e-4)


KILLED_CLIENT = """
import sys
from pymavlink import mavutil
link = mavutil.mavlink_connection(sys.argv[1], source_system=254)
link.wait_heartbeat()
link.mav.command_long_send(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0)
link.recv_match(type="COMMAND_ACK", blocking=True)
print("talking", flush=True)
while True:
    link.recv_match(blocking=True)
"""


@pytest.mark.parametrize("transport", ["udp", "tcp"])
@pytest.mark.parametrize("firmware", FIRMWARES)
def test_a_killed_client_is_replaced_by_the_next(firmware: str, transport: str) -> None:
    with Stub(firmware, transport=transport, speed=2.0) as stub:
        for round_ in range(2):
            client = subprocess.Popen(
                [sys.executable, "-c", KILLED_CLIENT, stub.endpoint], stdout=subprocess.PIPE, text=True
            )
            assert client.stdout is not None
            assert client.stdout.readline() == "talking\n", f"client {round_}"
            client.kill()
            client.wait()
        link = connected(stub)
        assert answer(link, 512, 148) == 0
        link.close()
        assert stub.running


def test_a_restarted_stub_is_found_again_at_its_address() -> None:
    """The client stays, the autopilot goes and comes back on the same ports."""
    with Stub() as first:
        link = connected(first)
        local = first.ready["links"][0]["local"][1]
        remote = first.endpoint.rpartition(":")[2]
    with Stub(arguments=["--udp", f"127.0.0.1:{remote}@{local}"]):
        while link.recv_msg() is not None:
            pass
        assert link.wait_heartbeat(timeout=PATIENCE_S) is not None
        assert answer(link, 512, 148) == 0
    link.close()


SIDE_BY_SIDE = int(os.environ.get("STUBS_SIDE_BY_SIDE", "6"))
"""How many stubs are started together; each costs a second of processor time, so 20 are for who asks for them."""


@pytest.mark.timeout(900)
def test_many_stubs_side_by_side() -> None:
    """Each answers a HEARTBEAT and a command on ports of its own; none is left. In lockstep they idle meanwhile."""
    with ExitStack() as stack:
        stubs = [
            stack.enter_context(Stub(FIRMWARES[i % 2], seed=i, lockstep=True, ready_timeout_s=PATIENCE_S))
            for i in range(SIDE_BY_SIDE)
        ]
        assert len({stub.endpoint for stub in stubs}) == SIDE_BY_SIDE
        for stub in stubs:
            link = connected(stub)
            expected = (
                mavlink.MAV_AUTOPILOT_PX4
                if stub.ready["firmware"] == "px4"
                else mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
            )
            assert link.field("HEARTBEAT", "autopilot") == expected
            assert answer(link, 512, 148) == 0, (stub.ready, stub.running)
            link.close()
        assert all(stub.running for stub in stubs)
    assert not any(stub.running for stub in stubs)
