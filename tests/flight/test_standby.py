"""`companion standby`: the pilot's switch engages and disengages as often as he likes, and what is refused is said."""

from __future__ import annotations

import argparse
import socket
import threading

import pytest
from engagements import READY_TO_BE_FLOWN, airborne, jumps, scenario
from stub_flights import Flown, Watching, interrupt, lockstep_stub

from companion.cli import engage
from companion.config.settings import load_settings
from companion.flight.outcome import Outcome
from companion.flight.session import SessionOptions, stand_by
from companion.flightlog.reader import read_log
from companion.mavlink.connection import Connection
from companion.mavlink.endpoint import parse_endpoint
from companion.mavlink.link import mav

pytestmark = pytest.mark.flight
OURS = {"px4": "OFFBOARD", "ardupilot": "GUIDED"}
HELD = {"px4": "AUTO.LOITER", "ardupilot": "LOITER"}
PROFILES = {"px4": "qball2", "ardupilot": "arducopter_sitl"}
TIMES = 20
EVERY_S, FOR_S = 2.4, 1.3


class Ending(Watching):
    """Ends the program once `enough` lines begin with `words`; `at_line` acts on a line that begins so."""

    def __init__(self, words, enough, at_line=None):
        super().__init__({})
        self._words, self._enough, self._at_line = words, enough, at_line or {}

    def say(self, text):
        super().say(text)
        for words, act in list(self._at_line.items()):
            if text.startswith(words):
                del self._at_line[words]
                act()
        if text.startswith(self._words):
            self._enough -= 1
            if self._enough == 0:
                interrupt()


def stand_by_until(stub, folder, reporter, firmware="px4", settings=(), port=0):
    given = ["flight.procedure.connect_timeout_s=120", "flight.duration_s=30", *settings]
    loaded = load_settings(PROFILES[firmware], {"level": "attitude", "trajectory": "hover"}, given)
    log = folder / "standby.mcap"
    options = SessionOptions(Connection(parse_endpoint(stub.endpoint)), log, from_air=True, engage_port=port)
    result = stand_by(loaded, options, reporter)
    return Flown(result, read_log(log), reporter, log)


def switched(firmware, times, first_s=5.0, every_s=EVERY_S, for_s=FOR_S):
    """The pilot's switch to our mode and back."""
    return [
        f'kind = "pilot_mode"\nafter = "airborne"\nat_s = {first_s + number * every_s}\nfor_s = {for_s}\n'
        f'mode = "{OURS[firmware]}"\n'
        for number in range(times)
    ]


@pytest.mark.parametrize("firmware", OURS)
def test_the_switch_engages_and_disengages_twenty_times(tmp_path, firmware):
    words = airborne(firmware, *scenario(tmp_path, *switched(firmware, TIMES)))
    reporter = Ending("pilot took over", TIMES)
    with lockstep_stub(*words, firmware=firmware) as stub:
        flown = stand_by_until(stub, tmp_path, reporter, firmware)
    assert flown.result.outcome is Outcome.COMPLETED, reporter.lines
    assert flown.result.text == f"stood by, {TIMES} engagements"
    assert len(flown.record.events_of("engaged")) == TIMES
    for off_m, turned_deg in jumps(flown.record):
        assert off_m < 0.05 and turned_deg < 3.0
    assert flown.armed[0] and all(flown.armed)


def said_to_the_ground(record):
    """What STATUSTEXTs of ours said, in order."""
    texts, pieces = [], b""
    codec = mav.MAVLink(None)
    codec.robust_parsing = True
    for frame in record.mavlink["out"][1]:
        message = codec.decode(bytearray(frame))
        if message.get_type() == "STATUSTEXT":
            data = bytes(message._text_raw).rstrip(b"\0")
            pieces = data if message.chunk_seq == 0 else pieces + data
            if len(data) < 50 or message.id == 0:
                texts.append(pieces.decode())
    return texts


def test_our_mode_on_the_ground_is_refused_and_said(tmp_path):
    """ArduCopter takes GUIDED there; when it flies later, in GUIDED still, nothing engages by itself."""
    switch = 'kind = "pilot_mode"\nat_s = 12.0\nmode = "GUIDED"\n'
    words = ["--ready-after", "3", *READY_TO_BE_FLOWN, *scenario(tmp_path, switch)]
    reporter = Ending("not engaged", 1)
    with lockstep_stub(*words, firmware="ardupilot") as stub:
        flown = stand_by_until(stub, tmp_path, reporter, "ardupilot")
    assert flown.result.text == "stood by, 0 engagements"
    assert flown.result.outcome.exit_code == 0
    assert reporter.lines[-1] == "not engaged: the vehicle is disarmed"
    assert said_to_the_ground(flown.record) == ["companion: not engaged: the vehicle is disarmed"]
    assert flown.setpoints_after("phase", phase="connect") == 0


def test_px4_gets_no_setpoints_while_it_may_not_engage_and_the_pilot_is_told_why(tmp_path):
    faults = [
        'kind = "pilot_mode"\nafter = "airborne"\nat_s = 5.0\nmode = "position"\n',
        'kind = "pilot_sticks"\nafter = "airborne"\nat_s = 5.5\nfor_s = 4.5\npitch = 0.5\n',
        'kind = "pilot_mode"\nafter = "airborne"\nat_s = 9.5\nmode = "OFFBOARD"\n',
    ]
    reporter = Ending("ready to engage", 2)
    with lockstep_stub(*airborne("px4", *scenario(tmp_path, *faults))) as stub:
        flown = stand_by_until(stub, tmp_path, reporter)
    assert "OFFBOARD" not in flown.modes
    hindered = next(line for line in reporter.lines if line.startswith("cannot engage"))
    assert "limit 3 m/s" in hindered
    ready = "companion: ready to engage"
    assert said_to_the_ground(flown.record) == [ready, f"companion: {hindered}", ready]


def test_companion_engage_engages_with_the_law_it_names_and_changes_it_in_flight(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    asked = []

    def ask(controller):
        arguments = argparse.Namespace(controller=controller, engage_port=port)
        asked.append(threading.Thread(target=lambda: codes.append(engage.run(arguments))))
        asked[-1].start()

    codes = []
    at_line = {
        "ready to engage": lambda: ask("tlmbc"),
        "engaged": lambda: ask("dtlannc"),
        "flying on": interrupt,
    }
    reporter = Ending("completed", 1, at_line)
    with lockstep_stub(*airborne("px4")) as stub:
        flown = stand_by_until(stub, tmp_path, reporter, port=port)
    for each in asked:
        each.join()
    assert codes == [0, 0]
    laws = [event.fields["controller"] for event in flown.record.events_of("law")]
    assert laws == ["tlmbc", "dtlannc"]
    assert flown.result.outcome is Outcome.INTERRUPTED  # in flight Ctrl-C lands as ever
    assert flown.armed == [True, False] and "AUTO.LAND" in flown.modes


def test_moved_sticks_hand_over_and_the_switch_engages_again(tmp_path):
    faults = [
        *switched("ardupilot", 1, first_s=5.0, for_s=4.0),
        'kind = "pilot_sticks"\nafter = "airborne"\nat_s = 7.0\nfor_s = 0.5\nroll = 0.5\n',
        *switched("ardupilot", 1, first_s=12.0, for_s=2.0),
    ]
    reporter = Ending("pilot took over", 3)  # said once on the way, too
    with lockstep_stub(*airborne("ardupilot", *scenario(tmp_path, *faults)), firmware="ardupilot") as stub:
        flown = stand_by_until(stub, tmp_path, reporter, "ardupilot")
    assert flown.result.text == "stood by, 2 engagements", reporter.lines
    assert any("sticks moved" in line for line in reporter.lines)
