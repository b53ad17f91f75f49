"""What the campaign draws, reads and tallies."""

from __future__ import annotations

import tomllib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from campaign.__main__ import main
from campaign.draw import FIRMWARES, planned
from campaign.faults import KINDS, scenario
from campaign.flying import _look_on
from campaign.planted import DEFECTS, candidates
from campaign.result import Result
from campaign.tally import BLOCKS, Tally, put_between_markers, read_results
from campaign.tape import ARMED, BOX_WIDTH, POSITION, QUATERNION, TIME, Tape
from campaign.wire import ARM_DISARM, armed_of, command_of, is_ours, mode_of, read_wire, setpoint_numbers
from campaign_evidence import OFFBOARD, command, heartbeat, setpoint

from companion.flightlog.writer import FlightLog
from sitl_stub.faults.scenario import Target, scenario_from
from sitl_stub.physics.vehicle import load_vehicle

RESULT = Result("px4", 3, ("gust", "link_loss"), "aborted", "a limit", 31.5, 0.4, 14, {}, 5.0, 4.0)


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_a_seed_is_always_the_same_flight(firmware: str) -> None:
    assert planned(firmware, 7) == planned(firmware, 7)
    assert len({planned(firmware, seed) for seed in range(50)}) == 50


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_the_stub_takes_every_fault_and_vehicle_that_is_drawn(firmware: str, tmp_path: Path) -> None:
    seen: Counter[str] = Counter()
    for seed in range(400):
        flight = planned(firmware, seed)
        seen.update(flight.kinds)
        file = tmp_path / "vehicle.toml"
        file.write_text(flight.vehicle_file())
        vehicle = load_vehicle(str(file))
        table = tomllib.loads(scenario(seed, flight.faults))
        drawn = scenario_from(table, "drawn", Target(flight.stub_firmware, vehicle))
        assert len(drawn.entries) == len(flight.faults)
    assert set(KINDS) <= set(seen) and min(seen[kind] for kind in KINDS) >= 5
    assert {"none", "companion_killed", "ctrl_c", "ctrl_c_twice", "autopilot_gone"} <= set(seen)


def test_faults_come_alone_and_in_pairs() -> None:
    counts = Counter(len(planned("px4", seed).faults) for seed in range(300))
    assert counts[1] > 60 and counts[2] > 60


@pytest.mark.parametrize("name", DEFECTS)
@pytest.mark.parametrize("firmware", FIRMWARES)
def test_there_are_flights_that_could_show_each_defect(name: str, firmware: str) -> None:
    assert next(candidates(DEFECTS[name], firmware, 1)).seed < 1000


def test_the_log_is_read_as_it_was_written(tmp_path: Path) -> None:
    from pymavlink.dialects.v20 import all as mav

    codec = mav.MAVLink(None, srcSystem=1, srcComponent=1)
    beat = mav.MAVLink_heartbeat_message(2, 12, 129, OFFBOARD, 4, 3).pack(codec)
    target = mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, (1, 0, 0, 0), 0.1, 0, 0, 0.4).pack(codec)
    with FlightLog(tmp_path / "f.mcap", utc_offset_ns=10**18) as log:
        log.mavlink("in", 1.0, bytes(beat))
        log.mavlink("out", 1.0, bytes(target))
        log.mavlink("in", 1.5, bytes(beat))
    wire = read_wire(tmp_path / "f.mcap", 10**18)
    assert [(frame.outgoing, frame.time_s) for frame in wire.frames] == [
        (False, 1.0),
        (True, 1.0),
        (False, 1.5),
    ]
    assert wire.whole and wire.last_time_s == pytest.approx(1.5)
    whole = (tmp_path / "f.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[:-200])
    assert not read_wire(tmp_path / "cut.mcap", 10**18).whole
    assert armed_of(wire.frames[0]) and is_ours("px4", mode_of(wire.frames[0]) or 0)
    assert setpoint_numbers(wire.frames[1])[4] == pytest.approx(0.1)


def test_frames_are_taken_apart_as_the_library_puts_them_together() -> None:
    assert command_of(command(1.0, ARM_DISARM, 1)).arms
    assert not command_of(command(1.0, ARM_DISARM, 0)).arms
    assert mode_of(heartbeat(1.0, OFFBOARD, True)) == OFFBOARD
    assert armed_of(heartbeat(1.0, OFFBOARD, False)) is False
    assert setpoint_numbers(setpoint(1.0, 0.25))[7] == 0.25
    assert is_ours("ardupilot", 4) and not is_ours("ardupilot", 9) and not is_ours("px4", 4)


def test_the_tape_remembers_and_knows_when_it_was_armed() -> None:
    tape = Tape()
    row = np.zeros(BOX_WIDTH)
    tape.note_vehicle(row)
    assert np.isnan(tape.armed_at_s)
    row[0], row[1] = 2.0, 1.0
    tape.note_vehicle(row)
    tape.note_tick(1.5, 100.0, 3.0)
    assert tape.armed_at_s == tape.now_s == 2.0
    assert tape.box.shape == (2, BOX_WIDTH) and tape.ticks.tolist() == [[1.5, 100.0, 3.0]]


def test_a_flight_with_two_faults_counts_in_both_rows() -> None:
    rows = Tally([RESULT]).rows("px4")
    assert [row[0] for row in rows] == ["gust", "link_loss", "**all**"]
    assert all(row[1] == "1" and row[3] == "1" for row in rows)  # flights, landed early


def test_results_are_read_back_and_written_into_a_page(tmp_path: Path) -> None:
    file, page = tmp_path / "results.jsonl", tmp_path / "page.md"
    file.write_text(RESULT.to_line() + "\n")
    assert read_results(file) == [RESULT]
    page.write_text(f"before\n{BLOCKS['campaign']}\nold\n<!-- end of campaign -->\nafter\n")
    put_between_markers(page, "campaign", Tally([RESULT]).page("scripts/campaign"))
    written = page.read_text()
    assert "old" not in written and "| gust | 1 |" in written and written.endswith("after\n")
    file.write_text("no result\n")
    with pytest.raises(ValueError, match="line 1"):
        read_results(file)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--seed", "3"], "--firmware"),
        (["--resume"], "--out"),
        (["--flights", "0"], "at least 1"),
        (["--write", "nowhere.md"], "no such page"),
    ],
)
def test_wrong_input_is_one_line(words: list[str], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1 and reason in told[0]


class StubFlyingOn:
    """Stands in for the stub's process: goes on by a second each time it is looked at, and disarms 25 s after the end."""

    def __init__(self, tape: Tape, height_m: float) -> None:
        self.tape, self.height_m, self.time_s = tape, height_m, 0.0

    def poll(self) -> None:
        for _ in range(10):
            row = np.zeros(BOX_WIDTH)
            row[TIME], row[ARMED] = self.time_s, self.time_s < 30.0
            row[POSITION] = 0.0, 0.0, -self.height_m * (self.time_s > 0.0)
            row[QUATERNION] = 1.0, 0.0, 0.0, 0.0
            self.tape.note_vehicle(row)
            self.time_s += 0.1


@pytest.mark.parametrize(("height_m", "armed", "until_s"), [(0.0, 0.0, 30.0), (1.0, 1.0, 17.0)])
def test_a_vehicle_that_stands_is_looked_at_until_it_disarms_one_that_hangs_is_not(
    height_m: float, armed: float, until_s: float
) -> None:
    tape = Tape()
    _look_on(StubFlyingOn(tape, height_m), tape, 5.0)  # type: ignore[arg-type]
    assert tape.box[-1, ARMED] == armed
    assert tape.now_s == pytest.approx(until_s, abs=1.0)
