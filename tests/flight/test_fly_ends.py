"""Every way a flight can end before its plan does: who is told what, and where the vehicle is then."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator

import pytest
from stub_flights import (
    Pilot,
    companion_process,
    fly_short,
    interrupt,
    kill,
    lockstep_stub,
    wait_briefly,
)

from companion.config.errors import UserError
from companion.control.law import ControlLaw
from companion.flight.outcome import Outcome
from companion.flight.phases import Phase
from companion.flightlog.reader import read_log
from sitl_stub.stub_process import Stub

pytestmark = pytest.mark.flight
AUTO, LOITER, LAND = 4, 3, 6
FLUSHED_S = 0.5  # on the wall clock; what is older than 0.2 s is in the file


@pytest.fixture
def stub() -> Iterator[Stub]:
    with lockstep_stub() as running:
        yield running


# The autopilot dies -------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", [Phase.READY, Phase.ARM, Phase.LIFT_OFF, Phase.TRACK, Phase.LAND])
def test_the_autopilot_falls_silent(stub, tmp_path, phase):
    flown = fly_short(stub, tmp_path, {phase: lambda: kill(stub)})
    assert flown.result.outcome is Outcome.LINK_LOST
    assert flown.result.outcome.exit_code == 1
    assert "nothing heard from the autopilot for" in flown.result.text
    assert flown.ended == "link lost"
    assert flown.record.cut == ""
    assert flown.reporter.phases[-1] is phase
    state = flown.record.channel("/state")
    assert (state is not None and len(state) > 50) or phase is Phase.READY


def test_the_autopilot_never_speaks(stub, tmp_path):
    kill(stub)
    with pytest.raises(UserError, match="no autopilot within 1 s; nothing arrived"):
        fly_short(stub, tmp_path, settings=["flight.procedure.connect_timeout_s=1"])
    record = read_log(tmp_path / "flight.mcap")
    assert record.events_of("ended")[-1].fields["outcome"] == "refused"


# The user wants to stop ---------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", [Phase.READY, Phase.ARM, Phase.LIFT_OFF, Phase.TRACK, Phase.LAND])
def test_ctrl_c_ends_on_the_ground(stub, tmp_path, phase):
    flown = fly_short(stub, tmp_path, {phase: interrupt})
    assert flown.result.outcome is Outcome.INTERRUPTED
    assert flown.result.outcome.exit_code == 3
    assert flown.ended == "interrupted"
    assert not any(flown.armed[-1:])  # never armed, or disarmed again
    if phase in (Phase.TRACK, Phase.LAND):
        assert flown.armed == [True, False]
        assert "AUTO.LAND" in flown.modes
        assert flown.setpoints_after("mode", mode="AUTO.LAND") == 0
    track = flown.record.events_of("tracking")
    assert bool(track) is (phase in (Phase.TRACK, Phase.LAND))


def test_ctrl_c_just_after_lift_off_comes_down_again(stub, tmp_path):
    flown = fly_short(stub, tmp_path, {Phase.CLIMB: interrupt})
    assert flown.result.outcome is Outcome.INTERRUPTED
    assert flown.armed == [True, False]


def test_a_second_ctrl_c_hands_back_at_once(stub, tmp_path):
    def again():
        wait_briefly()
        interrupt()

    flown = fly_short(stub, tmp_path, {Phase.TRACK: interrupt, Phase.LAND: again})
    assert flown.result.outcome is Outcome.HANDED_BACK
    assert flown.result.outcome.exit_code == 3
    assert "handed back to the autopilot at once" in flown.result.text
    assert flown.ended == "handed back"
    assert flown.armed == [True]  # it is still in the air, and the autopilot's


# The pilot takes over -----------------------------------------------------------------------------------


def test_the_pilot_takes_over_by_mode(tmp_path):
    pilot = Pilot()
    with lockstep_stub(*pilot.options) as stub:
        at = {Phase.TRACK: lambda: pilot.mode(AUTO, LOITER), Phase.WATCH: lambda: pilot.mode(AUTO, LAND)}
        flown = fly_short(stub, tmp_path, at)
    pilot.close()
    assert flown.result.outcome is Outcome.PILOT
    assert flown.result.outcome.exit_code == 3
    assert "AUTO.LOITER" in flown.result.text
    assert flown.modes[flown.modes.index("OFFBOARD") :][1:3] == ["AUTO.LOITER", "AUTO.LAND"]
    assert flown.setpoints_after("safety") == 0
    assert flown.armed == [True, False]
    watched = flown.record.channel("/state").time_s[-1] - flown.record.events_of("safety")[0].time_s
    assert watched > 1.0  # the log went on until the pilot had landed


def test_a_vehicle_disarmed_in_the_air_while_landing_is_not_called_landed(tmp_path):
    pilot = Pilot()
    with lockstep_stub(*pilot.options) as stub:
        kill_motors = {Phase.TRACK: interrupt, Phase.LAND: pilot.stop_motors}
        flown = fly_short(stub, tmp_path, kill_motors, settings=["flight.takeoff_height_m=3.0"])
    pilot.close()
    assert flown.result.outcome is Outcome.PILOT
    assert flown.result.text.startswith("by Ctrl-C or SIGTERM; then disarmed in the air while landing, ")
    assert "landed and disarmed" not in flown.result.text


# The flight is refused, or ends itself ------------------------------------------------------------------


def test_a_trajectory_that_cannot_be_flown_is_refused_on_the_ground(stub, tmp_path):
    with pytest.raises(UserError, match="circle"):
        fly_short(stub, tmp_path, trajectory="circle,radius_m=2,speed_m_s=12")
    record = read_log(tmp_path / "flight.mcap")
    assert record.events_of("ended")[-1].fields["outcome"] == "refused"
    assert not record.events_of("armed")


def test_a_limit_of_the_flight_lands_it(stub, tmp_path):
    """The lemniscate begins 0.3 m above the ground, and the floor is laid at 0.5 m."""
    flown = fly_short(stub, tmp_path, settings=["flight.safety.fence.height_min_m=0.5"])
    assert flown.result.outcome is Outcome.ABORTED
    assert flown.result.outcome.exit_code == 3
    assert "floor_margin_m" in flown.result.text
    assert flown.armed == [True, False]


def test_a_mistake_in_the_law_lands_the_vehicle_and_is_not_hidden(stub, tmp_path, monkeypatch):
    """The 300th step of the law divides by zero."""
    steps, step = [], ControlLaw.step_packed

    def broken(self, *arguments):
        steps.append(1)
        if len(steps) == 300:
            raise ZeroDivisionError("of this test")
        return step(self, *arguments)

    monkeypatch.setattr(ControlLaw, "step_packed", broken)
    flown = fly_short(stub, tmp_path)
    assert flown.result.outcome is Outcome.ABORTED
    assert "ZeroDivisionError('of this test')" in flown.result.text
    assert flown.armed == [True, False]
    [mistake] = read_log(tmp_path / "flight.mcap").events_of("mistake")
    assert "in broken" in mistake.fields["text"]


# We die -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", ["lift-off", "track", "land"])
def test_the_companion_is_killed_and_the_vehicle_comes_down(tmp_path, phase):
    """The stub ends by itself once it has disarmed. The capture's PX4 would not disarm what never took off."""
    with lockstep_stub("--param", "COM_DISARM_PRFLT=5", ends_when_disarmed=True) as stub:
        arguments = ["fly", "--endpoint", stub.endpoint, "--log", "cut.mcap", "--duration", "300"]
        arguments += ["--trajectory", "hover", "--set", "flight.procedure.hold_s=0.2"]
        with companion_process(arguments, tmp_path) as companion:
            companion.until_said(f"[{phase}]" if phase != "land" else "[track]")
            if phase == "land":
                companion.process.send_signal(signal.SIGINT)
                companion.until_said("[land]")
            elif phase == "track":
                time.sleep(FLUSHED_S)  # so that the phase is in what must not be lost
            companion.process.kill()
            companion.process.wait()
        assert stub.wait(120.0) == 0
    record = read_log(tmp_path / "cut.mcap")
    assert record.cut
    assert not record.events_of("ended")
    phases = [event.fields["phase"] for event in record.events_of("phase")]
    assert phases[:3] == ["connect", "check", "ready"]
    if phase == "track":
        assert phases[-1] == "track"
        assert len(record.channel("/state")) > 500  # of 878 that come before tracking
