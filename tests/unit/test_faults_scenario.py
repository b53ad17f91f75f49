"""Scenario files and the control channel: what is taken, what is refused, and when faults happen."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import pytest
from fault_client import inject, px4
from test_stub_process import LockstepClient, _take_off_script

from sitl_stub import Stub, StubError
from sitl_stub.cli import main
from sitl_stub.faults.fault import FaultError
from sitl_stub.faults.registry import KINDS, markdown_table
from sitl_stub.faults.scenario import entry_from, read_scenario
from sitl_stub.firmware.px4.modes import Mode

WRONG = """
sed = 3
announce = "yes"

[[fault]]
kind = "link_dely"

[[fault]]
kind = "link_delay"
after = "landing"
at_s = -1
for_s = "long"
delay = 0.3
direction = "up"

[[fault]]
at_s = nan

[[fault]]
kind = "link_loss"
probability = true
"""

REFUSALS = [
    "'sed' is not known at the top; there are seed, announce, fault",
    "announce is 'yes': give true or false",
    "[[fault]] 1: kind 'link_dely' is not known: did you mean link_delay",
    "[[fault]] 2 (link_delay): after is 'landing': give one of start, armed, airborne, offboard",
    "[[fault]] 2 (link_delay): at_s is -1: give seconds from 0",
    "[[fault]] 2 (link_delay): for_s is 'long': give seconds",
    "[[fault]] 2 (link_delay): 'delay' is no parameter of link_delay: did you mean delay_s?",
    "[[fault]] 2 (link_delay): direction is 'up': give one of both, to_client, from_client",
    "[[fault]] 3: kind is missing: name the fault",
    "[[fault]] 4 (link_loss): probability is True: give a number from 0 to 1",
]


def test_every_error_of_a_file_is_told_at_once(tmp_path: Path) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(WRONG)
    done = subprocess.run(
        [sys.executable, "-m", "sitl_stub", "--port", "0", "--scenario", str(file)],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 2 and done.stdout == ""
    lines = done.stderr.strip().splitlines()
    assert len(lines) == len(REFUSALS)
    for line, expected in zip(lines, REFUSALS, strict=True):
        assert line.startswith(f"sitl-stub: {file}: {expected}"), line


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("[[fault]", "not TOML"),
        ("fault = 3", "[[fault]]"),
        ("seed = -1", "not negative"),
        ("seed = 1.5", "whole"),
    ],
)
def test_files_that_are_no_scenario(tmp_path: Path, text: str, part: str) -> None:
    file = tmp_path / "scenario.toml"
    file.write_text(text)
    with pytest.raises(FaultError, match=part.replace("[", r"\[")):
        read_scenario(file)


def test_a_file_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--scenario", str(tmp_path / "none.toml"), "--port", "0"]) == 2
    assert "none.toml: cannot be read (No such file or directory)" in capsys.readouterr().err


def test_every_kind_is_had_with_its_defaults_and_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list-faults"]) == 0
    listed = capsys.readouterr().out
    for name, kind in KINDS.items():
        assert entry_from({"kind": name}).fault == kind()
        assert f"{name}: {kind.summary()}" in listed
        assert all(f"    {parameter} = " in listed for parameter in kind.parameters())


def test_scenarios_are_read_before_numba_is_loaded() -> None:
    """The stub's ready line comes first."""
    code = "import sys, sitl_stub.faults.scenario, sitl_stub.faults.control; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0


def test_the_page_has_the_table_of_the_registry() -> None:
    page = Path(__file__).resolve().parents[2] / "docs" / "faults.md"
    assert markdown_table() in page.read_text()


def test_the_scenario_of_the_page_is_one(tmp_path: Path) -> None:
    page = Path(__file__).resolve().parents[2] / "docs" / "faults.md"
    file = tmp_path / "faults.toml"
    file.write_text(page.read_text().partition("```toml\n")[2].partition("```")[0])
    kinds = [entry.fault.kind for entry in read_scenario(file).entries]
    assert kinds == ["link_delay", "gust"]


def test_times_count_from_what_they_come_after() -> None:
    client = px4(
        {"kind": "link_jitter", "at_s": 0.5, "for_s": 0.1},
        {"kind": "link_delay", "delay_s": 0, "after": "offboard", "at_s": 0.2, "for_s": 0.1},
        {"kind": "link_loss", "probability": 0, "after": "armed", "at_s": 1.0, "for_s": 0.1},
        {"kind": "link_corrupt", "probability": 0, "after": "airborne", "for_s": 0.1},
    )
    said: list[tuple[float, str]] = []
    autopilot = client.autopilot
    autopilot.voice.on_text = lambda text: said.append((autopilot.time_us * 1e-6, text))
    held: dict[str, float] = {}

    def look() -> None:
        client.position(0, 0, -2)
        for name, holds in (
            ("armed", autopilot.armed),
            ("airborne", autopilot.airborne),
            ("offboard", autopilot.takes_setpoints),
        ):
            if holds:
                held.setdefault(name, autopilot.time_us * 1e-6)

    client.advance(1.5, every=look)
    client.set_mode(Mode.OFFBOARD)
    client.advance(1.0, every=look)
    client.command("COMPONENT_ARM_DISARM", 1)
    client.advance(4.0, every=look, period_s=0.002)
    begun = {text.split()[1]: at for at, text in said if text.endswith(" on")}
    ended = {text.split()[1]: at for at, text in said if text.endswith(" off")}
    assert begun["link_jitter"] == pytest.approx(0.5, abs=1e-9)
    assert begun["link_delay"] == pytest.approx(held["offboard"] + 0.2, abs=0.011)
    assert begun["link_loss"] == pytest.approx(held["armed"] + 1.0, abs=0.011)
    assert begun["link_corrupt"] == pytest.approx(held["airborne"], abs=0.013)
    assert all(ended[kind] - begun[kind] == pytest.approx(0.1, abs=1e-9) for kind in begun)


def test_announcements_can_be_left_out() -> None:
    from fault_client import with_faults
    from stub_client import MemoryClient

    client = with_faults(MemoryClient(), {"kind": "link_jitter", "at_s": 0.1}, announce=False)
    client.advance(0.5)
    assert client.take("STATUSTEXT") == []
    assert client.autopilot.faults is not None and client.autopilot.faults.running == ["link_jitter"]


def test_clearing_ends_what_runs_and_forgets_what_is_to_come() -> None:
    client = px4({"kind": "link_loss"}, {"kind": "link_loss", "at_s": 1.0})
    client.advance(0.2)
    client.take()
    assert client.autopilot.faults is not None
    client.autopilot.faults.clear()
    client.advance(2.0)
    assert len(client.take("ATTITUDE")) == 200
    inject(client, "link_loss", for_s=0.1)
    client.advance(0.05)
    assert [m.text for m in client.take("STATUSTEXT")] == ["fault: link_loss on"]


# --- as a process -------------------------------------------------------------------------------------------------
def test_the_same_scenario_and_seed_give_the_same_bytes(tmp_path: Path) -> None:
    file = tmp_path / "scenario.toml"
    file.write_text(
        '[[fault]]\nkind = "link_loss"\nafter = "airborne"\nprobability = 0.3\n'
        '[[fault]]\nkind = "link_jitter"\nat_s = 1.0\n'
    )

    def digest(seed: int) -> tuple[int, str]:
        with Stub(seed=seed, lockstep=True, scenario=file) as stub:
            client = LockstepClient(stub)
            client.run(3.5, _take_off_script())
            client.close()
            return client.count, client.digest.hexdigest()

    first = digest(3)
    assert digest(3) == first


def test_faults_injected_in_lockstep_begin_at_the_same_instant() -> None:
    digests = []
    for _ in range(2):
        with Stub(lockstep=True) as stub:
            client = LockstepClient(stub)
            client.run(1.0)
            begun = [
                stub.inject("link_loss", for_s=0.5, direction="to_client"),
                stub.inject("link_jitter", at_s=2.0, for_s=0.5),
                stub.inject("link_delay", after="armed"),
            ]
            client.run(2.2)
            stub.clear()
            client.run(3.0)
            client.close()
            digests.append((begun, client.digest.hexdigest()))
    assert digests[0] == digests[1]
    begun = digests[0][0]
    assert begun[1:] == [2.0, None]
    assert begun[0] is not None and 1.0 < begun[0] < 1.02


def test_late_frames_in_lockstep_keep_their_numbers_whole(tmp_path: Path) -> None:
    """The questions of lockstep overtake what is late: a client must not take that for lost frames."""
    file = tmp_path / "late.toml"
    kinds = ("link_delay", "link_jitter")
    file.write_text("".join(f'[[fault]]\nkind = "{kind}"\nat_s = 0.5\nfor_s = 1.0\n' for kind in kinds))
    with Stub(lockstep=True, scenario=file) as stub:
        client = LockstepClient(stub)
        client.run(0.4)  # probes before it had its socket open are lost
        client.numbers.clear()
        client.run(2.5)
        client.close()
    numbers = client.numbers
    assert len(numbers) > 500
    # not mavutil's own count, in which messages newer than its dialect are missing
    assert sum((after - before - 1) & 0xFF for before, after in itertools.pairwise(numbers)) == 0


def test_wrong_injections_are_value_errors_and_the_stub_lives_on() -> None:
    with Stub(speed=2.0) as stub:
        with pytest.raises(ValueError, match="did you mean link_loss"):
            stub.inject("link_los")
        with pytest.raises(ValueError, match="did you mean delay_s") as wrong:
            stub.inject("link_delay", delay=1, for_s=-3)
        assert "for_s is -3: give seconds" in str(wrong.value)
        with pytest.raises(ValueError, match="cannot be"):
            stub.inject("link_delay", delay_s=object())
        assert stub.inject("link_delay", delay_s=0.1) is not None
        assert stub.process is not None and stub.process.stdin is not None
        stub.process.stdin.write("[1, 2\n\n{}\n" + "[" * 5000 + "\n")
        stub.process.stdin.flush()
        assert stub.process.stdout is not None
        assert all("one line of JSON" in stub.process.stdout.readline() for _ in range(3))
        stub.clear()
    with pytest.raises(StubError, match="does not run"):
        stub.inject("link_loss")
