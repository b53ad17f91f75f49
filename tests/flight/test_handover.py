"""A part of the hand-over matrix, drawn so that every kind of end is among it: each cell keeps its bounds, by the truth."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from stub_flights import fly_short, lockstep_stub

from companion.flight.outcome import Outcome
from companion.mavlink.link import Link, mav

PROJECT = Path(__file__).parents[2]
pytestmark = [pytest.mark.flight, pytest.mark.timeout(600)]


def matrix(*words: str) -> list[dict]:
    done = subprocess.run(
        [sys.executable, "-m", "handover", "--json", *words],
        cwd=PROJECT,
        env={**os.environ, "PYTHONPATH": str(PROJECT / "tests")},
        capture_output=True,
        text=True,
        check=False,
    )
    cells = [json.loads(line) for line in done.stdout.splitlines()]
    assert cells, done.stderr
    assert [cell for cell in cells if cell["broken"]] == [], done.stderr
    assert done.returncode == 0
    return cells


@pytest.mark.parametrize("level", ["attitude", "body_rate"])
@pytest.mark.parametrize(
    ("silent", "least_hz"),
    [(["LOCAL_POSITION_NED"], 60.0), (["LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"], 15.0)],
    ids=["no position", "no attitude"],
)
def test_a_vehicle_without_a_state_is_kept_level_until_land_shows(
    tmp_path, monkeypatch, silent, least_hz, level
):
    """Both streams end in flight, and ten commands for LAND are lost: a second in which only we can keep it level."""
    sound, lost = Link.send, []

    def send(self, message):
        ask = message.get_msgId() == mav.MAVLINK_MSG_ID_COMMAND_LONG
        if ask and message.command == mav.MAV_CMD_DO_SET_MODE and message.param2 == 4.0 and len(lost) < 10:
            lost.append(self.autopilot_time_s)
            return True
        return sound(self, message)

    monkeypatch.setattr(Link, "send", send)
    scenario = tmp_path / "silent.toml"
    fault = f'[[fault]]\nkind = "stream_stop"\nafter = "airborne"\nat_s = 2.0\nmessages = {silent}\n'
    scenario.write_text(fault)
    with lockstep_stub("--scenario", str(scenario)) as stub:
        flown = fly_short(stub, tmp_path, trajectory="hover", level=level)
    assert flown.result.outcome is Outcome.ABORTED
    assert flown.armed == [True, False]
    codec = mav.MAVLink(None)
    times_ns, frames = flown.record.mavlink["out"]
    times = (np.array(times_ns) - flown.record.utc_offset_ns) * 1e-9
    during = (times > lost[0] + 0.02) & (times < lost[-1])
    kinds = np.array([frame[7] for frame in frames])
    sent = [codec.decode(bytearray(frames[i])) for i in np.flatnonzero(during & (kinds == 82))]
    assert lost[-1] - lost[0] == pytest.approx(0.9, abs=0.1)
    assert len(sent) > least_hz * (lost[-1] - lost[0])
    if level == "attitude":
        assert max(math.hypot(m.q[1], m.q[2]) for m in sent) < 1e-3
    elif "ATTITUDE_QUATERNION" in silent:
        assert max(math.hypot(m.body_roll_rate, m.body_pitch_rate) for m in sent[5:]) < 1e-6
    assert max(m.thrust for m in sent) < 1.02 * 0.3658  # MPC_THR_HOVER


def test_ctrl_c_at_lift_off_comes_down_from_where_it_is() -> None:
    """It climbed to 9.95 m on a real ArduCopter: rising thrust stood for 2.5 s while DISARM was refused."""
    words = ["--phase", "lift-off", "--end", "ctrl-c", "--end", "ctrl-c twice", "--heading", "0"]
    for cell in matrix(*words, "--firmware", "ardupilot", "--level", "body_rate"):
        assert cell["rise_m"] < 0.2


def test_frames_that_are_lost_are_asked_for_again() -> None:
    words = [
        "--end",
        "mode frame lost three times",
        "--end",
        "hold frame lost three times",
        "--heading",
        "90",
    ]
    for cell in matrix(*words, "--phase", "track", "--level", "body_rate", "--cells", "4"):
        assert 0.25 < cell["taken_s"] < 0.6  # three tenths of a second were lost, and no more


def test_a_companion_that_starts_while_the_first_landing_comes_down_lets_it_come_down() -> None:
    """It was dropped from 0.67 m (PX4), and from 5.4 m (ArduPilot)."""
    for cell in matrix(
        "--end",
        "killed and started again",
        "--phase",
        "land",
        "--heading",
        "180",
        "--cells",
        "2",
        "--seed",
        "2",
    ):
        assert cell["sink_m_s"] < 1.2


def test_a_draw_of_the_rest_keeps_its_bounds() -> None:
    ends = [
        "sigterm",
        "supervisor lands",
        "law refuses",
        "exception in the law",
        "pilot by sticks",
        "link lost",
    ]
    matrix(*(word for end in ends for word in ("--end", end)), "--cells", "6", "--seed", "5")
