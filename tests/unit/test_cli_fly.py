"""`companion` as its user meets it before anything flies: help, and one line for whatever is wrong."""

from __future__ import annotations

import socket

import pytest

from companion.cli.main import COMMANDS, main


@pytest.fixture
def companion(tmp_path, monkeypatch, capsys):
    """Run the command in an empty folder: exit code, standard output, lines of standard error."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        try:
            code = main(arguments)
        except SystemExit as left:
            code = left.code
        printed = capsys.readouterr()
        return code, printed.out, printed.err.splitlines()

    return run


STUB = ("--sitl", "px4")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--sitl", "px5"), "px4-1.13"),
        (("--endpoint", "nonsense"), "not an address I know"),
        (("--endpoint", "udpin:127.0.0.1:99999"), "is not a number from 1 to 65535"),
        (("--endpoint", "tcp:127.0.0.1:x"), "is not a number"),
        ((*STUB, "--controller", "pid"), "dtlannc"),
        ((*STUB, "--profile", "no_such_profile"), "no_such_profile"),
        ((*STUB, "--trajectory", "lemniscat"), "did you mean 'lemniscate'"),
        ((*STUB, "--trajectory", "no_such_file.csv"), "no_such_file.csv"),
        ((*STUB, "--set", "flight.hold_s=3"), "hold_s"),
        ((*STUB, "--set", "profile.mass_ratio=heavy"), "mass_ratio"),
        ((*STUB, "--set", "mass_ratio"), "mass_ratio"),
        ((*STUB, "--duration", "-1"), "duration_s"),
        ((*STUB, "--duration", "nan"), "duration_s"),
        ((*STUB, "--seed", "-1"), "seed"),
        ((*STUB, "--from-air", "--fix"), "companion check --fix"),
        ((*STUB, "--sitl-options=--airborne 0.1"), "--airborne"),
        ((*STUB, "--sitl-options=--no-such-option"), "--no-such-option"),
        ((*STUB, "--sitl-options=--wind gale"), "--wind"),
        ((*STUB, "--log", "."), "."),
        ((*STUB, "--signing-key", "no_such_key"), "no_such_key"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_wrong_input_is_one_error_and_exit_code_2(companion, tmp_path, arguments, says):
    code, output, said = companion("fly", *arguments)
    assert (code, output) == (2, "")
    assert len([line for line in said if line.startswith("error:")]) == 1
    assert says in "\n".join(said)
    assert not list(tmp_path.rglob("*.mcap"))


def test_a_log_that_exists_is_not_overwritten(companion, tmp_path):
    log = tmp_path / "flight.mcap"
    log.write_bytes(b"a flight that matters")
    code, _, said = companion("fly", *STUB, "--log", "flight.mcap")
    assert code == 2
    assert "exists already" in said[-1]
    assert log.read_bytes() == b"a flight that matters"


def test_a_taken_port_is_one_line(companion):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        endpoint = f"udpin:127.0.0.1:{other.getsockname()[1]}"
        code, _, said = companion("fly", "--endpoint", endpoint, "--log", "flight.mcap")
    assert code == 2
    assert "another program has this port" in said[-1]


def test_nobody_there_is_one_line(companion):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"udpin:127.0.0.1:{probe.getsockname()[1]}"
    wish = ("--set", "flight.procedure.connect_timeout_s=0.5", "--log", "flight.mcap")
    code, _, said = companion("fly", "--endpoint", endpoint, *wish)
    assert code == 2
    assert said[-1].startswith("error: no autopilot within")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example(companion, command):
    code, output, said = companion(command, "--help")
    assert (code, said) == (0, [])
    assert f"companion {command}" in output.partition("example")[2]


def test_help_of_all(companion):
    code, output, _ = companion("--help")
    assert code == 0
    for command in COMMANDS:
        assert f"\n    {command}" in output
    assert "companion fly --sitl px4" in output.partition("examples:")[2]


@pytest.mark.parametrize(
    "arguments", [(), ("hover",), ("fly",), ("fly", "--level", "torque", *STUB)], ids=" ".join
)
def test_wrong_usage_is_exit_code_2(companion, arguments):
    code, output, said = companion(*arguments)
    assert (code, output) == (2, "")
    assert said[-1].startswith("companion")
