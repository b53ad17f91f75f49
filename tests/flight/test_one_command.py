"""One `companion fly` command, only --endpoint changed: both firmwares, every level they offer, both link libraries."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from link_flights import stub_behind

from companion.cli.main import main
from companion.flight import realtime
from companion.flightlog.digest import differences, digest
from companion.flightlog.reader import read_log
from companion.mavlink.connection import LinkLibrary

pytestmark = pytest.mark.flight
SHORT = (
    "flight.procedure.connect_timeout_s=120",  # the stub may be compiling
    "flight.procedure.hold_s=0.2",
    "flight.control_rate_hz=100",
    "flight.takeoff_height_m=0.6",
)
OFFERED = [
    ("px4", "attitude"),
    ("px4", "body_rate"),
    ("px4-1.13", "actuator"),
    ("ardupilot", "attitude"),
    ("ardupilot", "body_rate"),
]


def command(endpoint: str, level: str, library: LinkLibrary, log: Path) -> list[str]:
    words = ["fly", "--endpoint", endpoint, "--level", level, "--link", library.value, "--log", str(log)]
    words += ["--trajectory", "hover", "--duration", "1", "--fix"]
    words += ["--profile", "qball2"] if level == "actuator" else []  # torques take a mass and an inertia
    return words + [word for setting in SHORT for word in ("--set", setting)]


@pytest.mark.parametrize(("firmware", "level"), OFFERED)
def test_the_same_command_flies_with_the_same_log(tmp_path, monkeypatch, firmware: str, level: str) -> None:
    monkeypatch.setattr(realtime, "prepare", list)  # not for the process that tests
    libraries = [LinkLibrary.PYMAVLINK]
    if importlib.util.find_spec("mavsdk") is not None:
        libraries.append(LinkLibrary.MAVSDK)
    logs = []
    for library in libraries:
        log = tmp_path / f"{library.value}.mcap"
        options = ("--ready-after", "2") if firmware == "ardupilot" else ()
        with stub_behind("--firmware", firmware, *options) as port:
            assert main(command(f"udpin:127.0.0.1:{port}", level, library, log)) == 0
        record = read_log(log)
        assert record.events_of("ended")[-1].fields["outcome"] == "completed"
        assert record.flight["level"] == level
        assert record.flight["firmware"].startswith("ArduPilot" if firmware == "ardupilot" else "PX4")
        logs.append(log)
    # Frames and the event of an acknowledgement differ: MAVSDK asks for AUTOPILOT_VERSION, too.
    topics = ("/mavlink/in", "/mavlink/out", "/events")
    assert digest(logs[0], without=topics) == digest(logs[-1], without=topics), differences(*logs)
    if len(libraries) == 1:
        pytest.skip("flown with pymavlink; MAVSDK is not installed")


def test_without_gps_it_flies_in_guided_nogps(tmp_path, monkeypatch, capfd) -> None:
    monkeypatch.setattr(realtime, "prepare", list)
    log = tmp_path / "flight.mcap"
    with stub_behind("--firmware", "ardupilot", "--ready-after", "2", "--param", "GPS1_TYPE=0") as port:
        assert main(command(f"udpin:127.0.0.1:{port}", "attitude", LinkLibrary.PYMAVLINK, log)) == 0
    modes = [event.fields["mode"] for event in read_log(log).events_of("mode")]
    assert "GUIDED_NOGPS" in modes and "GUIDED" not in modes
    said = capfd.readouterr().err
    assert "ok      mode = GUIDED_NOGPS; this vehicle has no GPS" in said
    assert "tilt up to 30°" in said
    changes = ("set GUID_OPTIONS from 0 to 8", "put GUID_OPTIONS back to 0", "put ATC_ANGLE_BOOST back to 1")
    assert all(change in said for change in changes)
