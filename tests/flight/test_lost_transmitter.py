"""A lost transmitter in each of its appearances: flown on with or landed, and never taken for a pilot."""

from __future__ import annotations

import pytest
from stub_flights import fly_short, lockstep_stub

from companion.flight.outcome import Outcome

pytestmark = pytest.mark.flight

HOVER = ["flight.duration_s=8", "flight.procedure.hold_s=1.0"]


def lost(folder, appearance: str, *before: str) -> list[str]:
    scenario = folder / "lost.toml"
    fault = (
        f'[[fault]]\nkind = "transmitter_lost"\nafter = "airborne"\nat_s = 5.0\nappearance = "{appearance}"\n'
    )
    scenario.write_text("\n".join((fault, *before)))
    return ["--scenario", str(scenario)]


@pytest.mark.parametrize("appearance", ["throttle_low", "unhealthy", "preset"])
def test_a_lost_transmitter_lands_the_vehicle_and_is_said(tmp_path, appearance):
    with lockstep_stub(*lost(tmp_path, appearance), firmware="ardupilot") as stub:
        flown = fly_short(stub, tmp_path, settings=HOVER, trajectory="hover", fix=True)
    assert flown.result.outcome is Outcome.ABORTED
    assert flown.result.text.startswith("RC lost: ")
    assert flown.modes[-1] == "LAND" and "BRAKE" not in flown.modes
    assert flown.armed == [True, False]
    assert flown.record.events_of("rc")[0].fields["lost"] is True


@pytest.mark.parametrize("appearance", ["rssi_zero", "frozen"])
def test_a_lost_transmitter_is_flown_on_with_where_set(tmp_path, appearance):
    settings = [*HOVER, "flight.safety.rc_lost=fly_on"]
    with lockstep_stub(*lost(tmp_path, appearance), firmware="ardupilot") as stub:
        flown = fly_short(stub, tmp_path, settings=settings, trajectory="hover", fix=True)
    assert flown.result.outcome is Outcome.COMPLETED
    said = any(line.startswith("RC lost: ") and line.endswith("flying on") for line in flown.reporter.lines)
    assert said is (appearance != "frozen")


@pytest.mark.parametrize(
    ("appearance", "says"),
    [("frozen", "nobody has chosen a mode or moved a stick"), ("rssi_zero", "RC lost since")],
)
def test_sticks_that_nobody_holds_any_more_have_not_got_the_vehicle(tmp_path, appearance, says):
    """The pilot moves a stick, then the transmitter is lost: BRAKE, and nobody there."""
    moved = '[[fault]]\nkind = "pilot_sticks"\nafter = "airborne"\nat_s = 4.5\npitch = 0.4\nthrottle = 0.0\n'
    with lockstep_stub(*lost(tmp_path, appearance, moved), firmware="ardupilot") as stub:
        flown = fly_short(stub, tmp_path, settings=HOVER, trajectory="hover", fix=True)
    assert flown.result.outcome is Outcome.PILOT
    assert says in flown.result.text and "sticks moved: pitch by -20%" in flown.result.text
    assert "BRAKE" in flown.modes and flown.modes[-1] == "LAND"
    assert flown.armed == [True, False]
