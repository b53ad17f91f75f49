"""A real vehicle is armed by its pilot, with the sticks: before our mode, in which neither autopilot takes that."""

from __future__ import annotations

import pytest
from engagements import READY_TO_BE_FLOWN, scenario
from stub_flights import fly_short, interrupt, lockstep_stub

from companion.flight.flight import Flight
from companion.flight.outcome import Outcome
from companion.flight.phases import Phase

pytestmark = pytest.mark.flight
HOVER = ["flight.duration_s=1", "flight.procedure.hold_s=0.5"]
BY_HAND = {"px4": "POSCTL", "ardupilot": "STABILIZE"}
OURS = {"px4": "OFFBOARD", "ardupilot": "GUIDED"}


@pytest.fixture(autouse=True)
def as_a_real_vehicle(monkeypatch):
    """The stub tells its true state, so that it would be armed by us."""
    monkeypatch.setattr(Flight, "_pilot_arms", property(lambda self: not self._request.may_arm))


def takes(mode, at_s):
    return f'kind = "pilot_mode"\nat_s = {at_s}\nmode = "{mode}"\n'


def gesture(at_s, for_s=3.0):
    """Throttle down and yaw to the right; let go of, the sticks stand as before: throttle down."""
    return (
        f'kind = "pilot_sticks"\nat_s = {at_s - 1.0}\npitch = 0.0\nthrottle = 0.0\n',
        f'kind = "pilot_sticks"\nat_s = {at_s}\nfor_s = {for_s}\npitch = 0.0\nyaw = 1.0\nthrottle = 0.0\n',
    )


def stub_of(firmware, folder, *faults):
    own = READY_TO_BE_FLOWN if firmware == "ardupilot" else ("--param", "COM_DISARM_PRFLT=10")
    words = ["--ready-after", "2", *own]
    return lockstep_stub(*words, *scenario(folder, *faults), firmware=firmware)


@pytest.mark.parametrize("firmware", OURS)
def test_the_pilot_arms_by_the_sticks_and_then_our_mode_begins(tmp_path, firmware):
    with stub_of(firmware, tmp_path, takes(BY_HAND[firmware], 1.0), *gesture(12.0)) as stub:
        flown = fly_short(stub, tmp_path, settings=HOVER, trajectory="hover")
    assert flown.result.outcome is Outcome.COMPLETED, flown.result.text
    phases = flown.reporter.phases
    assert phases.index(Phase.ARM) < phases.index(Phase.PROVE) < phases.index(Phase.ENGAGE)
    armed_s = flown.record.events_of("armed")[0].time_s
    ours_s = next(e.time_s for e in flown.record.events_of("mode") if e.fields["mode"] == OURS[firmware])
    assert ours_s > armed_s


def test_a_vehicle_that_disarms_by_itself_before_the_switch_is_waited_for_again(tmp_path):
    """COM_DISARM_PRFLT disarms after 10 s; the pilot's switch comes after the second arming only."""
    faults = (takes("POSCTL", 1.0), *gesture(8.0, 1.5), *gesture(24.0, 1.5), takes("OFFBOARD", 29.0))
    with stub_of("px4", tmp_path, *faults) as stub:
        flown = fly_short(stub, tmp_path, settings=HOVER, trajectory="hover", wait_for_offboard=True)
    assert "disarmed before our mode began" in flown.reporter.lines
    assert [event.fields["armed"] for event in flown.record.events_of("armed")][:3] == [True, False, True]
    assert flown.reporter.lines.count("waiting for the pilot to arm (--arm lets the companion do it)") == 2


def test_ctrl_c_while_the_pilot_has_not_armed_just_ends(tmp_path):
    with stub_of("px4", tmp_path, takes("POSCTL", 1.0)) as stub:
        flown = fly_short(stub, tmp_path, {Phase.ARM: interrupt}, HOVER, trajectory="hover")
    assert flown.result.outcome is Outcome.INTERRUPTED
    assert flown.setpoints_after("phase", phase="connect") == 0
