"""The stub flown through the PX4 capture's own session over a real socket, held against what the real autopilot did.

Meant differences carry their reason in `compare.MEANT`. Besides:
- TIMESYNC requests come with every instant instead of ten times a second: that is what lockstep is (`timesync_rate.py`
  counts those of a stub that runs free for `scripts/conformance`);
- rate steps begin where the stub's half-second publication of the control mode has the phase that the capture's had.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import compare
import px4_scenario
import wire_figures

from sitl_stub import Stub

pytestmark = pytest.mark.flight

CAPTURED = wire_figures.capture_figures()
OTHER_IN_LOCKSTEP = {"PARAM_VALUE", "COMMAND_ACK", "TIMESYNC"}


@pytest.fixture(scope="module")
def session() -> px4_scenario.Session:
    with Stub(vehicle="px4_sih", estimator="gps", seed=1, lockstep=True) as stub:
        return px4_scenario.fly_scenario(stub.endpoint, alive=lambda: stub.running)


@pytest.fixture(scope="module")
def flown(session: px4_scenario.Session) -> dict[str, object]:
    return wire_figures.figures(session.messages)


@pytest.mark.skipif(
    not (wire_figures.CAPTURES / "px4_sih_qball2.tlog.gz").exists(),
    reason="the captures are not on this machine",
)
def test_fixture_is_what_the_capture_says() -> None:
    path = wire_figures.CAPTURES / "px4_sih_qball2.tlog.gz"
    fresh = wire_figures.figures(list(wire_figures.with_times(wire_figures.read_capture(path))))
    for name, value in fresh.items():
        assert CAPTURED[name] == value, name


def test_at_least_95_percent_agree_and_the_rest_has_a_reason(flown: dict[str, Any]) -> None:
    lines = list(compare.compare(flown, CAPTURED))
    differ = [line for line in lines if not line.agrees]
    assert len(lines) - len(differ) >= compare.LEAST_AGREEMENT * len(lines), differ
    assert {line.what for line in differ} <= {*compare.MEANT, "rate of TIMESYNC"}


def test_same_acknowledgements_in_the_same_order(flown: dict[str, list[list[float]]]) -> None:
    assert [ack[1:] for ack in flown["acks"]] == [ack[1:] for ack in CAPTURED["acks"]]
    late = [(a, b) for a, b in zip(flown["acks"], CAPTURED["acks"], strict=True) if abs(a[0] - b[0]) > 0.3]
    assert not late


def test_same_modes_arming_and_status(flown: dict[str, list[list[float]]]) -> None:
    assert [beat[1:] for beat in flown["heartbeats"]] == [beat[1:] for beat in CAPTURED["heartbeats"]]
    # HEARTBEATs come once a second, each side on its own grid; the last one waits for the landing (a meant difference)
    for ours, theirs in zip(flown["heartbeats"][2:-1], CAPTURED["heartbeats"][2:-1], strict=True):
        assert abs(ours[0] - theirs[0]) <= 1.05


def test_same_landed_states_at_the_same_times(flown: dict[str, list[list[float]]]) -> None:
    assert [state[1] for state in flown["landed"]] == [state[1] for state in CAPTURED["landed"]]
    for ours, theirs in zip(flown["landed"][:-1], CAPTURED["landed"][:-1], strict=True):
        assert abs(ours[0] - theirs[0]) <= 0.3


@pytest.mark.parametrize("which", ["default_rates_hz", "asked_rates_hz"])
def test_stream_rates_within_ten_percent(flown: dict[str, dict[str, float]], which: str) -> None:
    window_s = {"default_rates_hz": 1.5, "asked_rates_hz": 25.0}[which]
    wrong = {}
    for name, rate in CAPTURED[which].items():
        if name in OTHER_IN_LOCKSTEP:
            continue
        # a window cuts off up to one message at each end
        if abs(flown[which].get(name, 0.0) - rate) > 0.1 * rate + 1.0 / window_s:
            wrong[name] = (flown[which].get(name), rate)
    assert not wrong
    known = set(CAPTURED["default_rates_hz"]) | set(CAPTURED["asked_rates_hz"])
    assert not set(flown[which]) - known - OTHER_IN_LOCKSTEP


@pytest.mark.parametrize("step", ["roll", "pitch", "yaw", "roll rate", "yaw rate"])
def test_step_responses_within_twenty_percent(flown: dict[str, dict[str, list[float]]], step: str) -> None:
    for name, ours, theirs in zip(
        ("t10", "t63", "peak"), flown["steps"][step], CAPTURED["steps"][step], strict=True
    ):
        if (step, name) == ("roll rate", "t10"):
            continue  # within the capture's gyro noise
        assert ours == pytest.approx(theirs, rel=0.2), name


def test_rate_setpoint_meets_attitude_loop_until_the_mode_is_published(
    flown: dict[str, dict[str, list[float]]],
) -> None:
    # the pitch rate step of the capture fell into that half second whole: it reached 0.39 of what was asked
    assert flown["steps"]["pitch rate"][2] == pytest.approx(CAPTURED["steps"]["pitch rate"][2], rel=0.2)


def test_same_answers_to_unknown_things_and_same_parameters(flown: dict[str, object]) -> None:
    for name in ("parameter_count", "unknown_parameter_answered", "flight_sw_version"):
        assert flown[name] == CAPTURED[name], name


def test_events_of_the_capture_are_spoken(session: px4_scenario.Session) -> None:
    names = [m.get_type() for _, out, m in session.messages if not out]
    assert names.count("UNKNOWN_410") >= 5  # arming denied, armed, take-off, failsafe, landing
    assert not session.all("STATUSTEXT")  # PX4 1.17 sends none in this session
