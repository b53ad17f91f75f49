"""Programs as they are, through `companion serve`: they track better, and whatever ends that ends as without us."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from served_client import LOITER, OFFBOARD, Client, Served, Setpoint, mavlink, served, stub_for

from companion.flightlog.reader import read_log

pytestmark = pytest.mark.flight
TAKEN_OVER = "flying the client's setpoints"


def lemniscate(time_s: float) -> Setpoint:
    """2 m to the north in 8 s, 1 m to the east in 4 s, at 3 m; from rest within 4 s."""
    long, short = math.tau / 8.0, math.tau / 4.0
    share = min(1.0, time_s / 4.0)
    share = share * share * (3.0 - 2.0 * share)
    return (
        2.0 * share * math.sin(long * time_s),
        share * math.sin(short * time_s),
        -3.0,
        2.0 * share * long * math.cos(long * time_s),
        share * short * math.cos(short * time_s),
        0.0,
    )


def flown(client: Client, settled_s: float = 8.0, measured_s: float = 8.0) -> float:
    """Enter offboard and fly the figure; RMS of the last 8 s, m."""
    client.fly(1.0)
    client.mode(*OFFBOARD)
    client.fly(2.0)
    client.fly(settled_s + measured_s, lemniscate)
    client.errors = client.errors[-round(len(client.errors) * measured_s / (3.0 + settled_s + measured_s)) :]
    return client.rms_m()


def test_positions_and_velocities_are_tracked_three_times_better(tmp_path: Path) -> None:
    """The same program, on the stub's own port and on ours."""
    with stub_for("px4") as stub:
        client = Client(stub.endpoint, answers=True)
        straight_m = flown(client)
        client.close()
    with served("px4", tmp_path) as (_, serve, client):
        through_m = flown(client)
        assert serve.heard(TAKEN_OVER)
    assert through_m < straight_m / 3.0, (through_m, straight_m, serve.said)
    (log,) = (tmp_path / "flights").glob("*.mcap")
    assert len(read_log(log).events_of("engaged")) == 1


def test_whatever_ends_it_the_client_has_the_vehicle_again(tmp_path: Path) -> None:
    """One flight: attitude setpoints of the client's own, the pilot's switch, a setpoint beyond the fence, silence."""
    with served("px4", tmp_path) as (_, serve, client):

        def flown(times: int) -> Callable[[], bool]:
            return lambda: sum(TAKEN_OVER in text for text in client.texts) == times

        client.fly(0.5)
        client.mode(*OFFBOARD)
        assert client.fly(10.0, until=flown(1))
        client.link.mav.set_attitude_target_send(0, 1, 1, 7, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0.37)
        assert client.fly(5.0, until=lambda: serve.heard("the client flies the attitude itself"))
        assert client.fly(10.0, until=flown(2))

        client.mode(*LOITER)
        assert client.fly(5.0, until=lambda: "stopped flying" in client.texts[-1])
        client.fly(1.0)
        assert "stopped flying" in client.texts[-1]  # it waits for the mode
        client.mode(*OFFBOARD)
        assert client.fly(10.0, until=flown(3))

        beyond = (0.0, 40.0, -3.0, 0.0, 0.0, 0.0)
        assert client.fly(5.0, lambda _: beyond, until=lambda: serve.heard("passed on: outside the fence"))
        assert client.modes[-1] == OFFBOARD
        assert client.fly(20.0, until=flown(4))

        silent_s = client.now_s
        assert client.fly(10.0, lambda _: None, until=lambda: client.modes[-1] != OFFBOARD), client.modes
        assert 1.0 < client.now_s - silent_s < 3.0  # COM_OF_LOSS_T is 1 s
        assert serve.stop() == 0
    (log,) = (tmp_path / "flights").glob("*.mcap")
    assert len(read_log(log).events_of("engaged")) == 4


def test_a_law_that_is_killed_is_replaced_and_the_client_flies_on(tmp_path: Path) -> None:
    with served("px4", tmp_path) as (_, serve, client):
        client.fly(0.5)
        client.mode(*OFFBOARD)
        assert client.fly(10.0, until=lambda: serve.heard(TAKEN_OVER))
        os.kill(serve.law, signal.SIGKILL)
        assert client.fly(60.0, until=lambda: serve.heard("our law is gone"))
        assert client.fly(600.0, until=lambda: sum(TAKEN_OVER in line for line in serve.said) == 2)
        assert client.modes[-1] == OFFBOARD and abs(client.position[2] + 3.0) < 0.3


def test_serve_that_is_killed_leaves_the_vehicle_to_its_failsafe(tmp_path: Path) -> None:
    """As a client that is killed: offboard loss, land, disarm."""
    with stub_for("px4", exit_on_disarm=True) as stub:
        serve = Served(stub.endpoint, tmp_path)
        client = Client(f"udpin:127.0.0.1:{serve.port}", answers=False)
        assert client.fly(60.0, until=lambda: serve.heard("standing by"))
        client.mode(*OFFBOARD)
        assert client.fly(10.0, until=lambda: serve.heard(TAKEN_OVER))
        serve.kill()
        client.close()
        assert stub.wait(60.0) == 0


def test_ardupilot_from_the_ground_and_by_one_setpoint(tmp_path: Path) -> None:
    """GUIDED on the ground and up by NAV_TAKEOFF; a stream is flown by the law, a single setpoint by the autopilot."""
    with served("ardupilot", tmp_path, airborne=False) as (_, serve, client):
        assert client.fly(30.0, lambda _: None, until=lambda: serve.heard("ready after"))
        client.mode(4)
        client.fly(1.0, lambda _: None)
        client.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        client.fly(1.0, lambda _: None)
        client.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3)
        assert client.fly(20.0, lambda _: None, until=lambda: client.position[2] < -2.8)
        client.fly(2.0, lambda _: None)
        assert not serve.heard(TAKEN_OVER)
        north, east = client.position[:2]
        assert client.fly(
            10.0, lambda _: (north, east, -3.0, 0.0, 0.0, 0.0), until=lambda: serve.heard(TAKEN_OVER)
        )
        client.fly(3.0, lambda t: (north + min(t, 2.0), east, -3.0, 1.0 if t < 2.0 else 0.0, 0.0, 0.0))
        assert client.fly(5.0, lambda _: None, until=lambda: serve.heard("the client has sent no setpoint"))
        there = (north + 2.0, east, -3.0)  # held by the autopilot
        assert client.fly(20.0, lambda _: None, until=lambda: math.dist(client.position, there) < 0.3)
        client.mode(9)
        assert client.fly(40.0, lambda _: None, until=lambda: not client.armed)
        assert client.fly(
            5.0, lambda _: None, until=lambda: serve.heard("disarmed; flown for clients 1 times")
        )
