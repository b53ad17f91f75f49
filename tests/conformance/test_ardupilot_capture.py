"""The stub flown through the ArduPilot capture's own session over a real socket, held against what ArduCopter did.

Meant differences, each with its reason:
- steps are timed from the first movement of the autopilot's own target: the capture's simulator, at four times real time,
  took our setpoints some 25 ms of its time late, which is no property of the autopilot;
- TIMESYNC requests come with every instant instead of every 10 s: that is what lockstep is;
- a heading that is not zero at boot, and the second the autopilot had before the capture began.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import ardupilot_figures
import ardupilot_scenario
import compare_ardupilot
from compare import LEAST_AGREEMENT

from sitl_stub import Stub

pytestmark = pytest.mark.flight

CAPTURED = ardupilot_figures.capture_figures()
OTHER_IN_LOCKSTEP = {"TIMESYNC"}
LANDED_STILL_ARMED = [217, 9, 3]
FROM_S = 5.6
"""The capture begins here."""


@pytest.fixture(scope="module")
def flown() -> dict[str, Any]:
    with Stub(firmware="ardupilot", estimator="perfect", seed=1, lockstep=True) as stub:
        session = ardupilot_scenario.fly_scenario(stub.endpoint, alive=lambda: stub.running)
    return ardupilot_figures.figures(session.messages)


@pytest.mark.skipif(not ardupilot_figures.CAPTURE.exists(), reason="the captures are not on this machine")
def test_fixture_is_what_the_capture_says() -> None:
    import json

    fresh = json.loads(json.dumps(ardupilot_figures.figures(ardupilot_figures.read_capture())))
    for name, value in fresh.items():
        assert CAPTURED[name] == value, name


def test_at_least_95_percent_agree_and_the_rest_has_a_reason(flown: dict[str, Any]) -> None:
    lines = list(compare_ardupilot.compare(flown, CAPTURED))
    differ = [line for line in lines if not line.agrees]
    assert len(lines) - len(differ) >= LEAST_AGREEMENT * len(lines), differ
    assert {line.what for line in differ} <= {*compare_ardupilot.MEANT, "rate of TIMESYNC"}


def test_same_acknowledgements_in_the_same_order(flown: dict[str, Any]) -> None:
    assert [ack[1:] for ack in flown["acks"]] == [ack[1:] for ack in CAPTURED["acks"]]
    # the first one asks for the stream that the capture's clock is read from
    for ours, theirs in zip(flown["acks"][1:], CAPTURED["acks"][1:], strict=True):
        assert ours[0] == pytest.approx(theirs[0], abs=0.3)


def test_same_modes_arming_and_status(flown: dict[str, Any]) -> None:
    # landed and not yet disarmed lasts half a second: whether a HEARTBEAT falls into it is a matter of its phase
    ours, theirs = (
        [beat for beat in beats if beat[1:] != LANDED_STILL_ARMED]
        for beats in (flown["heartbeats"], CAPTURED["heartbeats"])
    )
    assert [beat[1:] for beat in ours] == [beat[1:] for beat in theirs]
    # HEARTBEATs come once a second, each side on its own grid
    for beat, captured in zip(ours[1:], theirs[1:], strict=True):
        assert beat[0] == pytest.approx(captured[0], abs=1.05)


def test_same_landed_states_at_the_same_times(flown: dict[str, Any]) -> None:
    assert [state[1] for state in flown["landed"]] == [state[1] for state in CAPTURED["landed"]]
    for ours, theirs in zip(flown["landed"], CAPTURED["landed"], strict=True):
        assert ours[0] == pytest.approx(theirs[0], abs=0.55)  # EXTENDED_SYS_STATE comes twice a second


def test_same_sensor_bits_in_the_same_order(flown: dict[str, Any]) -> None:
    assert [bits[1:] for bits in flown["sensors"]] == [bits[1:] for bits in CAPTURED["sensors"]]
    for ours, theirs in zip(flown["sensors"][1:], CAPTURED["sensors"][1:], strict=True):
        assert ours[0] == pytest.approx(theirs[0], abs=0.75)  # SYS_STATUS comes twice a second


def test_same_texts_in_the_same_order(flown: dict[str, Any]) -> None:
    def words(texts: list[list[Any]]) -> list[tuple[int, str]]:
        # the speed of a touch-down is the simulator's, not the autopilot's
        return [(severity, text.split(" at ")[0]) for t, severity, text in texts if t >= FROM_S]

    assert words(flown["texts"]) == words(CAPTURED["texts"])


def test_stream_rates_within_ten_percent(flown: dict[str, Any]) -> None:
    for name, rate in CAPTURED["rates_hz"].items():
        if name not in OTHER_IN_LOCKSTEP:
            assert flown["rates_hz"].get(name, 0.0) == pytest.approx(rate, rel=0.1, abs=0.02), name
    assert not set(flown["rates_hz"]) - set(CAPTURED["rates_hz"])


@pytest.mark.parametrize("step", ["roll", "pitch", "yaw", "roll rate", "pitch rate", "yaw rate"])
def test_step_responses_within_fifteen_percent(flown: dict[str, Any], step: str) -> None:
    names = ("t10", "t63", "peak")
    for name, ours, theirs in zip(names, flown["steps"][step], CAPTURED["steps"][step], strict=True):
        assert ours == pytest.approx(theirs, rel=0.15), name


def test_readiness_take_off_hover_and_what_follows_the_timeout(flown: dict[str, Any]) -> None:
    assert flown["first_position_s"] == pytest.approx(CAPTURED["first_position_s"], abs=0.1)
    ours, theirs = flown["off_the_ground_after_target_s"], CAPTURED["off_the_ground_after_target_s"]
    assert ours == pytest.approx(theirs, abs=0.15)
    assert flown["hover_thrust"] == pytest.approx(CAPTURED["hover_thrust"], rel=0.01)
    assert flown["height_after_timeout_m"] == pytest.approx(CAPTURED["height_after_timeout_m"], abs=0.1)


def test_same_answers_to_unknown_things_and_same_parameters(flown: dict[str, Any]) -> None:
    for name in ("parameter_count", "unknown_parameter_answered", "flight_sw_version"):
        assert flown[name] == CAPTURED[name], name
    assert [list(pair) for pair in flown["parameter_types"]] == CAPTURED["parameter_types"]
