"""Each message that a flight rests on is dropped, before and during a flight: what follows is what the table says."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
from stub_flights import Flown, fly_short, lockstep_stub

from companion.autopilot.adapter import Verdict
from companion.config.safety import Reaction, SafetyLimits
from companion.config.settings import load_settings
from companion.flight.outcome import Outcome
from companion.flight.reporter import Reporter
from companion.flight.session import check
from companion.flight.sources import SOURCES, Source
from companion.mavlink.connection import Connection
from companion.mavlink.endpoint import parse_endpoint
from companion.mavlink.link import Link, mav
from companion.mavlink.timesync import TimeSync

pytestmark = pytest.mark.flight

LIMITS = SafetyLimits()
BY_FAULT = [source for source in SOURCES if source.message != "TIMESYNC"]  # lockstep waits for its answers
LONGER = "flight.duration_s=12"  # an SYS_STATUS that falls silent counts after 10 s


def firmware_of(source: Source) -> str:
    return "ardupilot" if source.only == "ArduPilot" else "px4"


def muted(folder: Path, message: str, after: str = "start") -> list[str]:
    scenario = folder / "muted.toml"
    scenario.write_text(
        f'[[fault]]\nkind = "stream_stop"\nafter = "{after}"\nat_s = 0.5\nmessages = ["{message}"]\n'
        if after != "start"
        else f'[[fault]]\nkind = "stream_stop"\nmessages = ["{message}"]\n'
    )
    return ["--scenario", str(scenario)]


def blind_said(flown: Flown, message: str) -> bool:
    return any(
        e.fields["active"] and str(e.fields["text"]).startswith(message)
        for e in flown.record.events_of("blind")
    )


@pytest.mark.parametrize("source", BY_FAULT[3:], ids=lambda source: source.message)
def test_what_was_never_heard_is_said_by_check(tmp_path, source):
    """Without the first three there is nothing to look at: the next test."""
    firmware = firmware_of(source)
    settings = load_settings("qball2", {}, ["flight.procedure.connect_timeout_s=120"])
    with lockstep_stub(*muted(tmp_path, source.message), firmware=firmware) as stub:
        findings, _, _ = check(settings, Connection(parse_endpoint(stub.endpoint)), Reporter())
    found = next(f for f in findings if f.subject == source.message)
    assert found.verdict is source.verdict(LIMITS)
    assert found.found == "not heard" and "blind: " in found.why
    assert all(name in found.why for name in source.quantities if LIMITS.ladder(name).rungs())


@pytest.mark.parametrize(
    "message", ["ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "ESTIMATOR_STATUS", "SYS_STATUS"]
)
def test_a_flight_does_not_begin_without_what_it_needs(tmp_path, message):
    with lockstep_stub(*muted(tmp_path, message)) as stub:
        flown = fly_short(
            stub, tmp_path, settings=["flight.procedure.ready_timeout_s=12"], trajectory="hover"
        )
    assert flown.result.outcome is Outcome.REFUSED
    assert flown.armed == []


def test_what_is_only_good_to_have_is_said_as_blind_at_take_off(tmp_path):
    with lockstep_stub(*muted(tmp_path, "EKF_STATUS_REPORT"), firmware="ardupilot") as stub:
        flown = fly_short(
            stub, tmp_path, settings=["flight.procedure.hold_s=0.5"], trajectory="hover", fix=True
        )
    assert flown.result.outcome is Outcome.COMPLETED
    assert blind_said(flown, "EKF_STATUS_REPORT is not heard: blind for estimator_lost, innovation_ratio")
    assert any(line.startswith("blind: EKF_STATUS_REPORT") for line in flown.reporter.lines)


@pytest.mark.parametrize("source", BY_FAULT, ids=lambda source: source.message)
def test_what_falls_silent_in_flight_does_as_the_table_says(tmp_path, source):
    with lockstep_stub(*muted(tmp_path, source.message, "airborne"), firmware=firmware_of(source)) as stub:
        flown = fly_short(stub, tmp_path, settings=[LONGER], trajectory="hover", fix=True)
    ends = source.reaction(LIMITS) >= Reaction.LAND and not source.instead
    if ends:
        assert flown.result.outcome is Outcome.ABORTED
        assert source.age in flown.result.text
        assert flown.armed == [True, False]
    else:
        assert blind_said(flown, source.message)
        assert source.message == "HEARTBEAT" or flown.result.outcome is Outcome.COMPLETED


def test_a_mode_that_nobody_tells_any_more_lands(tmp_path):
    scenario = muted(tmp_path, "HEARTBEAT", "airborne")
    Path(scenario[1]).write_text(
        Path(scenario[1]).read_text().replace('["HEARTBEAT"]', '["HEARTBEAT", "CURRENT_MODE"]')
    )
    with lockstep_stub(*scenario) as stub:
        flown = fly_short(stub, tmp_path, settings=[LONGER], trajectory="hover")
    assert "mode_age_s 5" in flown.result.text
    assert flown.result.outcome is not Outcome.COMPLETED


def test_a_round_trip_that_is_not_measured_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(TimeSync, "add", lambda *_: None)
    with lockstep_stub() as stub:
        flown = fly_short(stub, tmp_path, settings=["flight.procedure.hold_s=0.5"], trajectory="hover")
    assert flown.result.outcome is Outcome.COMPLETED
    assert blind_said(flown, "TIMESYNC is not heard: blind for round_trip_s")


def test_an_end_that_is_switched_off_lets_a_blind_flight_begin(tmp_path):
    off = ["flight.safety.estimator_age_s.land=off", "flight.procedure.hold_s=0.5"]
    with lockstep_stub(*muted(tmp_path, "ESTIMATOR_STATUS")) as stub:
        flown = fly_short(stub, tmp_path, settings=off, trajectory="hover")
    assert flown.result.outcome is Outcome.COMPLETED
    assert blind_said(flown, "ESTIMATOR_STATUS")


@pytest.mark.parametrize("told", [True, False])
def test_a_version_of_0_0_0_or_none_is_unknown_and_refused_for_actuator_controls(tmp_path, monkeypatch, told):
    sound = Link.receive

    def receive(self, timeout_s):
        message = sound(self, timeout_s)
        if message is None or message.get_msgId() != mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            return message
        nothing = [0] * 8
        zero = mav.MAVLink_autopilot_version_message(0, 0, 0, 0, 0, nothing, nothing, nothing, 0, 0, 0)
        return zero if told else None

    monkeypatch.setattr(Link, "receive", receive)
    with lockstep_stub(firmware="px4-1.13") as stub:
        flown = fly_short(stub, tmp_path, level="actuator", trajectory="hover")
    assert flown.result.outcome is Outcome.REFUSED
    assert "actuator controls firmware of unknown version" in flown.result.text
    assert any(line.startswith("PX4 of unknown version") for line in flown.reporter.lines)
    assert flown.armed == []


def test_every_row_says_something_the_ladder_knows():
    names = set(SafetyLimits.model_fields)
    for source in SOURCES:
        assert {*source.quantities, *filter(None, [source.age])} <= names, source.message
        assert source.verdict(LIMITS) in (Verdict.REFUSAL, Verdict.WARNING)
        assert math.isfinite(dataclasses.astuple(source)[1])
