"""Programs as they are, through `companion serve`: they track better, and whatever ends that ends as without us."""

from __future__ import annotations

import math
import os
import signal
from pathlib import Path

import pytest
from served_client import HOVER, LOITER, OFFBOARD, Client, Setpoint, mavlink, served, stub_for

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
