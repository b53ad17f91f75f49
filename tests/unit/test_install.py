"""`scripts/install` run into a folder: what it shows, what it makes, and that it takes away just that."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from companion.cli.main import main
from companion.config.procedure import Procedure
from companion.flight.realtime import FIFO_PRIORITY

PROJECT = Path(__file__).resolve().parents[2]
SCRIPT = PROJECT / "scripts" / "install"
VENV = Path(sys.prefix)
UNIT = "etc/systemd/system/companion@.service"
STANDBY = "etc/systemd/system/companion-standby@.service"
RULES = "etc/udev/rules.d/60-companion-autopilot.rules"
MADE = {
    UNIT,
    STANDBY,
    RULES,
    "etc/dtlannc-companion/example.env",
    "etc/security/limits.d/60-companion.conf",
    "usr/local/bin/companion",
    "opt/dtlannc-companion/installed.json",
}


def installer(*words: object) -> tuple[int, str, str]:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *map(str, words)],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def files(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def module(monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    loader = importlib.machinery.SourceFileLoader("install_script", str(SCRIPT))
    spec = importlib.util.spec_from_loader("install_script", loader)
    assert spec is not None
    loaded = importlib.util.module_from_spec(spec)
    loader.exec_module(loaded)
    return loaded


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    code, _, errors = installer("--root", tmp_path, "--venv", VENV, "--serial", "ttyAMA0", "--yes")
    assert (code, errors) == (0, "")
    return tmp_path


def unit_settings(root: Path, unit: str = UNIT) -> dict[str, str]:
    return dict(
        line.split("=", 1) for line in (root / unit).read_text().splitlines() if re.match(r"\w+=", line)
    )


# Before anything is done ------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [("--dry-run",), ("--dry-run", "--yes"), ()], ids=" ".join)
def test_it_shows_everything_first_and_does_nothing_unasked(tmp_path: Path, words: tuple[str, ...]) -> None:
    code, shown, errors = installer("--root", tmp_path, *words)
    assert (code, errors) == (0, "")
    assert not list(tmp_path.iterdir())
    for name in MADE - {"opt/dtlannc-companion/installed.json"}:
        assert f"write  {tmp_path / name}" in shown
    assert "| Restart=no" in shown
    assert f"-m venv {tmp_path}/opt/dtlannc-companion/venv" in shown
    assert f"--constraint {PROJECT}/constraints.txt" in shown


def test_help_has_examples() -> None:
    code, shown, _ = installer("--help")
    assert code == 0
    assert "sudo scripts/install --uninstall" in shown.partition("examples:")[2]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--serial", "COM3"), "--serial 'COM3': give auto, usb, usb:VENDOR"),
        (("--serial", 'usb:0403:6001:A"', "--venv", VENV), "--serial 'usb:0403:6001:A\"'"),
        (("--user", "nobody-here", "--venv", VENV), "--user nobody-here: there is no such user"),
        (("--venv", "nowhere"), "--venv nowhere: no Python environment"),
        (("--python", "nowhere"), "no Python 3.11 or newer with venv among nowhere"),
        (("--uninstall",), "nothing was installed by this script"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(
    tmp_path: Path, words: tuple[object, ...], says: str
) -> None:
    code, _, errors = installer("--root", tmp_path, "--yes", *words)
    assert code == 2
    assert says in errors and errors.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.geteuid() == 0, reason="only root may")
def test_without_root_it_says_so() -> None:
    code, _, errors = installer("--venv", VENV, "--yes")
    assert code == 2 and "sudo scripts/install" in errors


# What it makes ----------------------------------------------------------------------------------------------


def test_it_makes_these_files(installed: Path) -> None:
    assert files(installed) == MADE
    assert os.access(installed / "usr/local/bin/companion", os.X_OK)


def test_the_command_it_makes_runs(installed: Path) -> None:
    done = subprocess.run(
        [installed / "usr/local/bin/companion", "--help"], capture_output=True, text=True, check=True
    )
    assert "companion fly --sitl px4" in done.stdout


def test_the_service_is_made_for_one_flight(installed: Path) -> None:
    settings = unit_settings(installed)
    assert settings["Restart"] == "no"
    assert settings["KillSignal"] == "SIGTERM" and settings["KillMode"] == "mixed"
    assert (
        int(settings["TimeoutStopSec"]) >= 2.0 * Procedure().land_timeout_s
    )  # SIGKILL must not meet a landing
    assert int(settings["LimitRTPRIO"]) >= FIFO_PRIORITY
    assert settings["LimitMEMLOCK"] == "infinity"
    assert settings["SupplementaryGroups"] == "dialout"
    limits = (installed / "etc/security/limits.d/60-companion.conf").read_text()
    assert re.search(rf"^\S+ - rtprio {FIFO_PRIORITY}$", limits, re.M)


@pytest.mark.parametrize(("unit", "command"), [(UNIT, "fly"), (STANDBY, "standby")])
def test_its_command_line_is_understood_and_the_pilot_arms(
    installed: Path, module, capsys, unit: str, command: str
) -> None:
    """The service's words, with the example's variables as systemd fills them in, up to a profile that is not there.

    The example names none, and an empty one is none.
    """
    variables = dict(
        line.split("=", 1)
        for line in (installed / "etc/dtlannc-companion/example.env").read_text().splitlines()
        if not line.startswith("#")
    )
    words: list[str] = []
    for word in shlex.split(unit_settings(installed, unit)["ExecStart"]):
        whole = re.fullmatch(r"\$\{(\w+)\}", word)
        split = re.fullmatch(r"\$(\w+)", word)
        words += [variables[whole[1]]] if whole else variables[split[1]].split() if split else [word]
    assert words[:3] == [str(VENV / "bin/python"), "-m", "companion.cli.main"]
    assert words[3] == command and ("--wait-for-offboard" in words) is (command == "fly")
    assert "--arm" not in words
    at = words.index("--profile") + 1
    assert words[at] == ""
    words[at] = str(installed / "my_drone.toml")
    assert main(words[3:]) == 2
    assert "my_drone.toml" in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
@pytest.mark.parametrize("name", [UNIT, STANDBY])
def test_systemd_finds_nothing_wrong_with_the_service(installed: Path, tmp_path: Path, name: str) -> None:
    unit = tmp_path / Path(name).name.replace("@", "@quad")
    unit.write_text((installed / name).read_text())
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True, check=False
    )
    assert [line for line in done.stderr.splitlines() if "companion" in line] == []


@pytest.mark.parametrize(
    ("serial", "model", "matches"),
    [
        ("auto", "Raspberry Pi 5 Model B Rev 1.0", ['KERNEL=="ttyAMA0"']),
        ("auto", "NVIDIA Jetson Orin Nano Developer Kit", ['KERNEL=="ttyTHS1"']),
        ("auto", "", ['ATTRS{idVendor}=="26ac"', 'ATTRS{idVendor}=="1209"']),
        ("ttyS4", "Raspberry Pi 5", ['KERNEL=="ttyS4"']),
        ("usb:26AC:0032", "", ['ATTRS{idVendor}=="26ac", ATTRS{idProduct}=="0032", SYMLINK']),
        ("usb:0403:6001:A5.0-2", "", ['ATTRS{idProduct}=="6001", ATTRS{serial}=="A5.0-2", SYMLINK']),
    ],
)
def test_the_port_has_one_name_and_one_group(module, serial: str, model: str, matches: list[str]) -> None:
    rules = [line for line in module.udev_rule(serial, model).splitlines() if not line.startswith("#")]
    for match in matches:
        assert any(match in rule for rule in rules)
    for rule in rules:
        assert rule.startswith('SUBSYSTEM=="tty", ')
        for part in ('SYMLINK+="autopilot"', 'GROUP="dialout"', 'ENV{ID_MM_DEVICE_IGNORE}="1"'):
            assert part in rule


# And takes away ---------------------------------------------------------------------------------------------


def test_uninstalling_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "etc/udev").mkdir(parents=True)
    (tmp_path / "etc/udev/udev.conf").write_text("mine\n")
    words = ("--root", tmp_path, "--venv", VENV, "--yes")
    assert installer(*words)[0] == installer(*words)[0] == 0  # twice is once
    assert installer("--root", tmp_path, "--uninstall")[0] == 0  # shown only
    assert files(tmp_path) == MADE | {"etc/udev/udev.conf"}
    assert installer("--root", tmp_path, "--uninstall", "--yes")[0] == 0
    assert {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")} == {
        "etc",
        "etc/udev",
        "etc/udev/udev.conf",
    }


def test_what_the_user_made_or_changed_stays(installed: Path) -> None:
    (installed / "etc/dtlannc-companion/quad.env").write_text("COMPANION_ENDPOINT=/dev/autopilot,921600\n")
    with (installed / RULES).open("a") as rules:
        rules.write("# mine\n")
    code, shown, _ = installer("--root", installed, "--uninstall", "--yes")
    assert code == 0
    assert f"keep   {installed / RULES}  (changed since)" in shown
    assert files(installed) == {RULES, "etc/dtlannc-companion/quad.env"}


def test_a_file_of_somebody_else_is_not_written_over(tmp_path: Path) -> None:
    other = tmp_path / "usr/local/bin/companion"
    other.parent.mkdir(parents=True)
    other.write_text("another program\n")
    code, _, errors = installer("--root", tmp_path, "--venv", VENV, "--yes")
    assert code == 2 and f"{other} is there and was not made by this script" in errors
    assert files(tmp_path) == {"usr/local/bin/companion"}


def test_a_step_that_fails_is_named_and_can_be_taken_back(
    tmp_path: Path, module, capsys, monkeypatch
) -> None:
    monkeypatch.setattr(module.Plan, "_venv_commands", lambda self, python: [["false"]])
    assert module.main(["--root", str(tmp_path), "--yes"]) == 2
    assert "false: ended with exit code 1" in capsys.readouterr().err
    assert module.main(["--root", str(tmp_path), "--uninstall", "--yes"]) == 0
    assert not list(tmp_path.iterdir())
