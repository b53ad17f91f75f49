"""Files of other programs, places that cannot be written, and two flights in one second."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from synthetic_flight import write as write_flight

from companion.analysis import report as report_module
from companion.analysis.metrics import flight_metrics
from companion.cli.fly import claim
from companion.cli.main import main
from companion.config.errors import UserError
from companion.config.settings import load_profile, load_settings
from companion.flightlog import events
from companion.flightlog.mcap_file import McapFile
from companion.flightlog.reader import read_log, read_raw
from companion.reference.registry import trajectory_from_text


def message_of(call, *arguments):
    with pytest.raises(UserError) as caught:
        call(*arguments)
    return str(caught.value)


@pytest.mark.parametrize(
    ("beginning", "words"),
    [
        (b"ULog\x01\x12\x35\x01", "PX4 log"),
        (b"\xa3\x95\x80\x80", "dataflash"),
        (b"#ROSBAG V2.0\n", "ROS 1 bag"),
        (b"\x1f\x8b\x08", "gzip"),
    ],
)
def test_a_foreign_log_is_called_by_its_name(tmp_path, beginning, words):
    path = tmp_path / "log.bin"
    path.write_bytes(beginning + bytes(50))
    assert words in message_of(read_log, path)


@pytest.mark.parametrize("name", ["quad.params", "copter.parm", "copter.param"])
def test_a_ground_stations_file_is_no_profile_and_no_trajectory(name):
    assert "parameters" in message_of(load_profile, name)
    assert "parameters" in message_of(trajectory_from_text, name)


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("profile.mass_kg=1,5", "mass_kg"),
        ("gains.lead.feedback_s=0,1", "lead.feedback_s"),
        ("flight.duration_s=40,5", ""),
    ],
)
def test_a_wrong_setting_is_blamed_not_the_shipped_file(override, key):
    said = message_of(load_settings, "qball2", {}, [override])
    assert said.startswith(f"--set {override}: {key}") and "decimal point" in said and ".toml" not in said


def test_a_rule_between_values_names_file_and_setting():
    said = message_of(load_settings, "qball2", {}, ["profile.rotors.thrust_max_newton=4.0"])
    assert "qball2.toml with --set profile.rotors.thrust_max_newton=4.0: " in said


def test_an_attachment_without_a_checksum_is_read_on(tmp_path):
    path = tmp_path / "foreign.mcap"
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT)
    file = McapFile(descriptor)
    file.add_attachment("a.txt", "text/plain", b"content")
    end = os.lseek(descriptor, 0, os.SEEK_CUR)
    channel = file.add_channel("/a", "json", file.add_schema("a", "jsonschema", b"{}"))
    for k in range(50):
        file.add_message(channel, k, b"{}")
    file.finish()
    os.pwrite(descriptor, bytes(4), end - 4)  # 0: none given
    os.close(descriptor)
    raw = read_raw(path)
    assert (raw.cut, len(raw.channels[0].messages), raw.attachments[0].data) == ("", 50, b"content")
    with path.open("r+b") as damaged:
        damaged.seek(end - 4)
        damaged.write(b"\1\2\3\4")
    assert "checksum" in read_raw(path).cut


def test_flights_of_one_second_have_a_file_each(tmp_path):
    wish = tmp_path / "flights" / "20261130-120000-dtlannc-attitude.mcap"
    made = [claim(wish, lambda path: path.touch(exist_ok=False)) for _ in range(3)]
    assert [path.name for path in made] == [wish.name, f"{wish.stem}-2.mcap", f"{wish.stem}-3.mcap"]
    folders = [claim(wish.with_suffix(""), Path.mkdir) for _ in range(2)]
    assert folders[0] != folders[1]


@pytest.mark.parametrize(
    ("report", "says"), [("/proc/none/r.html", "cannot write the report"), (".", "it is a folder")]
)
def test_a_report_that_cannot_be_written_is_said_before_anything_flies(
    tmp_path, monkeypatch, capsys, report, says
):
    monkeypatch.chdir(tmp_path)
    assert main(["fly", "--sitl", "px4", "--report", report]) == 2
    assert says in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.mcap"))


def test_without_matplotlib_a_report_is_refused_before_anything_flies(tmp_path):
    code = (
        "import sys; sys.modules['matplotlib'] = None\nfrom companion.cli.main import main\n"
        "sys.exit(main(['fly', '--sitl', 'px4', '--report']))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], check=False, cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 2 and "pip install" in ended.stderr and "starting" not in ended.stderr


def test_a_report_that_fails_does_not_cost_the_table(tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(report_module, "write_flight_report", full)
    log = tmp_path / "a.mcap"
    write_flight(log)
    assert main(["analyze", str(log), "--json", "--report", str(tmp_path / "r.html")]) == 2
    printed = capsys.readouterr()
    assert '"rms"' in printed.out and "no report" in printed.err and "No space" in printed.err


def test_losses_of_a_cut_log_are_those_of_its_last_account(tmp_path):
    path = tmp_path / "a.mcap"
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT)
    file = McapFile(descriptor, profile="companion")
    channel = file.add_channel(events.TOPIC, "json", file.add_schema("e", "jsonschema", b"{}"))
    for k, lost in enumerate((3, 17, 42)):
        fields = {"text": "disk full", "dropped": 1, "rejected": 0, "lost": lost}
        file.add_message(channel, k, events.encode_event("log", float(k), fields))
    file.flush()
    os.close(descriptor)
    metrics, _ = flight_metrics(read_log(path))
    assert any("misses 43 records" in note for note in metrics.notes)
