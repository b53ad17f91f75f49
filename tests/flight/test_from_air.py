"""`fly --from-air`: engaged without a bump, handed back as asked, and refused in words where nothing may engage."""

from __future__ import annotations

import pytest
from engagements import airborne, jumps, scenario
from stub_flights import Pilot, fly_short, lockstep_stub

from companion.autopilot.adapter import Intent
from companion.flight.outcome import Outcome
from companion.flight.phases import Phase

pytestmark = pytest.mark.flight
HOVER = ["flight.duration_s=1", "flight.procedure.hold_s=0.5"]
FIRMWARES = ["px4", "ardupilot"]
HELD = {"px4": ["AUTO.LOITER", "OFFBOARD"], "ardupilot": ["LOITER", "GUIDED"]}
AFTER = {"px4": "AUTO.LOITER", "ardupilot": "BRAKE"}


def fly_from_air(stub, folder, at=None, then=Intent.HOLD):
    return fly_short(stub, folder, at, HOVER, trajectory="hover", from_air=True, then=then)


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_it_engages_without_a_bump_and_hands_back_to_a_hold(tmp_path, firmware):
    with lockstep_stub(*airborne(firmware), firmware=firmware) as stub:
        flown = fly_from_air(stub, tmp_path)
    assert flown.result.outcome is Outcome.COMPLETED, flown.result.text
    assert flown.modes == [*HELD[firmware], AFTER[firmware]]
    assert flown.armed == [True]
    assert Phase.LIFT_OFF not in flown.reporter.phases and Phase.STOP in flown.reporter.phases
    assert flown.setpoints_after("mode", mode="LOITER" if firmware == "ardupilot" else "AUTO.LOITER") > 0
    ((off_m, turned_deg),) = jumps(flown.record)
    assert off_m < 0.05 and turned_deg < 3.0


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_it_engages_at_two_metres_a_second(tmp_path, firmware):
    moves = 'kind = "pilot_sticks"\nafter = "airborne"\nat_s = 1.0\npitch = 0.16\n'
    takes = 'kind = "pilot_mode"\nafter = "airborne"\nat_s = 0.5\nmode = "position"\n'
    words = airborne(firmware, *scenario(tmp_path, takes, moves))
    with lockstep_stub(*words, firmware=firmware) as stub:
        flown = fly_from_air(stub, tmp_path)
    assert flown.result.outcome is Outcome.COMPLETED, flown.result.text
    engaged_s = flown.record.events_of("engaged")[0].time_s
    reference = flown.record.channel("/reference")
    row = int(reference.time_s.searchsorted(engaged_s))
    assert 1.5 < float((reference["velocity_enu"][row] ** 2).sum() ** 0.5) < 2.5
    ((off_m, turned_deg),) = jumps(flown.record)
    assert off_m < 0.15 and turned_deg < 3.0


def test_it_returns_where_that_was_asked_for(tmp_path):
    with lockstep_stub(*airborne("px4")) as stub:
        flown = fly_from_air(stub, tmp_path, then=Intent.RETURN)
    assert flown.result.text.startswith("flown as planned, handed back in AUTO.RTL")


def test_a_vehicle_on_the_ground_is_refused(tmp_path):
    with lockstep_stub() as stub:
        flown = fly_from_air(stub, tmp_path)
    assert flown.result.outcome.exit_code == 2
    assert flown.result.text == "not engaged: the vehicle is disarmed"
    assert flown.setpoints_after("phase", phase="connect") == 0


def test_a_vehicle_that_lands_is_refused_and_left_alone(tmp_path):
    pilot = Pilot()
    with lockstep_stub(*airborne("px4"), *pilot.options) as stub:
        flown = fly_from_air(stub, tmp_path, {Phase.PROVE: lambda: pilot.mode(4, 6)})
    pilot.close()
    assert flown.result.outcome.exit_code == 2
    assert "the vehicle is landing" in flown.result.text
    assert "OFFBOARD" not in flown.modes
