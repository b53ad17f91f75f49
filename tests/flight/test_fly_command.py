"""`companion fly` as its user meets it: what it prints, what it writes, how it ends, and what it refuses."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from stub_flights import companion_process, fly_short, lockstep_stub

from companion.analysis.metrics import flight_metrics
from companion.flight.outcome import Outcome
from companion.flightlog.digest import differences, digest
from companion.flightlog.reader import read_log

pytestmark = pytest.mark.flight
REPORTED_RMS_M = (0.0448, 0.0216, 0.0238)  # the report's DTLANNC


def run(*arguments, folder):
    """`companion` with these arguments: exit code, standard output, lines of standard error."""
    done = subprocess.run(  # noqa: PLW1510 the exit code is what is looked at
        [sys.executable, "-m", "companion.cli.main", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=280,
    )
    return done.returncode, done.stdout, done.stderr.splitlines()


# One whole flight ---------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def plain(tmp_path_factory):
    """The report's flight, whole, by the command: exit code, JSON, words, log."""
    folder = tmp_path_factory.mktemp("plain")
    code, output, said = run("fly", "--sitl", "px4", "--json", "--log", "flight.mcap", folder=folder)
    assert code == 0, said
    return json.loads(output), said, folder / "flight.mcap"


def test_the_flight_is_better_than_the_report(plain):
    result, _, _ = plain
    assert result["ended"] == "completed"
    assert np.all(np.array(result["rms"]["position_truth_m"]) < REPORTED_RMS_M)
    assert np.all(np.array(result["rms"]["position_truth_m"]) > 1e-3)  # measured, not made up
    assert result["window_s"][1] - result["window_s"][0] == pytest.approx(40.0, abs=0.1)


def test_the_json_has_what_it_promises(plain):
    result, _, log = plain
    for key in ("position_truth_m", "position_estimate_m", "attitude_deg"):
        assert len(result["rms"][key]) == 3
    assert result["controller"] == "dtlannc"
    assert result["level"] == "attitude"
    assert result["firmware"].startswith("PX4 1.17")
    assert result["mass_ratio"] == pytest.approx(0.7)
    assert str(result["seed"]) == "1"
    assert result["log"] == log.name
    attitude = result["streams"]["ATTITUDE_QUATERNION"]
    assert attitude["rate_hz"] == pytest.approx(100.0, rel=0.05)
    assert attitude["age_s"] is None  # simulated time is not ours


def test_the_json_is_what_the_log_says(plain):
    result, _, log = plain
    metrics, _ = flight_metrics(read_log(log), None, None)
    assert metrics.to_json()["rms"] == result["rms"]


def test_phases_are_told_in_order_and_standard_error_has_no_traceback(plain):
    _, said, _ = plain
    phases = [line.strip("[]") for line in said if line.startswith("[")]
    assert phases == [
        *("connect", "check", "ready", "prove setpoints", "engage", "arm", "lift-off", "climb"),
        *("go to start", "hold", "run-in", "track", "run-out", "return", "land", "done"),
    ]
    assert not any("Traceback" in line for line in said)


def test_the_log_holds_all_of_the_flight(plain):
    record = read_log(plain[2])
    assert record.cut == ""
    for topic in ("/state", "/reference", "/setpoint", "/truth", "/timing"):
        channel = record.channel(topic)
        assert channel is not None and len(channel) > 500, topic
    assert {"in", "out"} <= set(record.mavlink)
    assert record.flight["controller"] == "dtlannc"
    assert [event.fields["armed"] for event in record.events_of("armed")] == [True, False]


# Levels and repeatability -------------------------------------------------------------------------------


def flown_with(folder, firmware="px4", level="attitude", seed=7):
    folder.mkdir(exist_ok=True)
    with lockstep_stub(firmware=firmware, seed=seed) as stub:
        return fly_short(stub, folder, level=level)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A short flight at the attitude level with seed 7."""
    return flown_with(tmp_path_factory.mktemp("short"))


def test_the_same_seed_gives_the_same_log(tmp_path, short):
    """At every level with both libraries: test_one_command.py."""
    again = flown_with(tmp_path)
    assert short.result.outcome is again.result.outcome is Outcome.COMPLETED
    assert differences(short.log, again.log) == []
    assert digest(short.log) == digest(again.log)


@pytest.mark.parametrize(("firmware", "level"), [("px4", "body_rate"), ("px4-1.13", "actuator")])
def test_the_other_levels_track_as_well(tmp_path, firmware, level, short):
    for flown in (short, flown_with(tmp_path, firmware, level)):
        assert flown.result.outcome is Outcome.COMPLETED
        metrics, _ = flight_metrics(flown.record, None, None)
        assert max(metrics.to_json()["rms"]["position_truth_m"]) < 0.1


def test_another_seed_of_the_stub_gives_another_log(tmp_path, short):
    assert digest(short.log) != digest(flown_with(tmp_path, seed=8).log)


def test_an_exported_flight_is_read_by_mavlogdump(tmp_path, short):
    """pymavlink's own tool finds every message of the flight, of both sides."""
    log, exported = short.log, tmp_path / "flight.tlog"
    code, said, errors = run("export", str(log), "-o", str(exported), folder=tmp_path)
    assert code == 0, errors
    record = read_log(log)
    frames = [frame for direction in ("in", "out") for frame in record.mavlink[direction][1]]
    assert str(len(frames)) in said
    numbers = Counter(int.from_bytes(frame[7:10], "little") for frame in frames)
    names = ["HEARTBEAT", "COMMAND_LONG", "COMMAND_ACK", "SET_ATTITUDE_TARGET", "ATTITUDE_TARGET"]
    ids = {cls.msgname: number for number, cls in dialect.mavlink_map.items()}
    types = ("--format", "json", "--types", ",".join(names))
    dump = subprocess.run(
        [sys.executable, "-m", "pymavlink.tools.mavlogdump", *types, exported],
        capture_output=True,
        text=True,
        timeout=280,
        check=True,
        env={**os.environ, "MAVLINK20": "1"},
    )
    found = Counter(json.loads(line)["meta"]["type"] for line in dump.stdout.splitlines())
    assert found == {name: numbers[ids[name]] for name in names}
    assert min(found.values()) > 0


def test_actuator_controls_on_new_firmware_are_refused_on_the_ground(tmp_path):
    with lockstep_stub() as stub:
        flown = fly_short(stub, tmp_path, level="actuator")
    assert flown.result.outcome is Outcome.REFUSED
    assert flown.result.outcome.exit_code == 2
    assert "takes SET_ACTUATOR_CONTROL_TARGET up to 1.13 only" in flown.result.text
    assert "fly at --level body_rate" in flown.result.text
    assert flown.armed in ([], [False])


# Signals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_a_signal_lands_and_the_result_is_printed(tmp_path, number):
    arguments = ["fly", "--sitl", "px4", "--duration", "200", "--log", "flight.mcap", "--json"]
    arguments += ["--trajectory", "hover", "--set", "flight.procedure.hold_s=0.2"]
    with companion_process(arguments, tmp_path) as companion:
        companion.until_said("[track]")
        companion.process.send_signal(number)
        code, output = companion.end()
    assert code == 3, companion.lines
    assert json.loads(output)["ended"] == "interrupted"
    record = read_log(tmp_path / "flight.mcap")
    assert record.cut == ""
    assert [event.fields["armed"] for event in record.events_of("armed")] == [True, False]
    assert not any("Traceback" in line for line in companion.lines)


# The stub's life ---------------------------------------------------------------------------------------


def test_the_stub_goes_when_the_companion_is_killed(tmp_path):
    with companion_process(["fly", "--sitl", "px4", "--log", "cut.mcap"], tmp_path) as companion:
        companion.until_said("[connect]")
        pid = companion.process.pid
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        assert children
        companion.process.kill()
        companion.process.wait()
    for _ in range(100):
        left = [pid for pid in children if _is_running(pid)]
        if not left:
            return
        time.sleep(0.1)
    raise AssertionError(f"still running: {left}")


def _is_running(pid):
    try:
        with open(f"/proc/{pid}/stat") as status:
            return status.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
