"""Every reaction of the supervisor over the wire: what is sent, what is not, where the vehicle ends, how quickly."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator

import numpy as np
import pytest
from stub_flights import Flown, fly_short, interrupt, lockstep_stub
from stub_flights import Pilot as GroundPilot

from companion.analysis.comparison import compare_logs
from companion.analysis.metrics import flight_metrics
from companion.control.law import ControlLaw, StepResult
from companion.control.structs import Setpoint
from companion.flight.flight import Flight
from companion.flight.outcome import Outcome
from companion.flight.phases import Phase
from companion.mavlink.link import Link, mav
from companion.mavlink.state import StateAssembler
from sitl_stub.stub_process import Stub

pytestmark = pytest.mark.flight

ALWAYS = 0.004  # m: a position error that any flight exceeds within a moment
OFF = "flight.safety.position_error_m"


@pytest.fixture
def stub() -> Iterator[Stub]:
    with lockstep_stub() as running:
        yield running


def only(reaction: str, *more: str) -> list[str]:
    """Settings under which the position error has one rung, which is exceeded at once."""
    rungs = dict.fromkeys(("warn", "non_adaptive", "hold", "land"), "off")
    rungs["land"] = "[20.0, 0.0]"  # there has to be an end
    rungs[reaction] = f"[{ALWAYS}, 0.0]"
    if reaction in ("hand_back", "disarm"):
        rungs["land"] = "off"
    return [*(f"{OFF}.{name}={value}" for name, value in rungs.items()), *more]


def safety_events(flown: Flown) -> list[dict]:
    return [event.fields for event in flown.record.events_of("safety")]


def entered(flown: Flown, reaction: str) -> float:
    """When the machine came to a reaction, the autopilot's time."""
    return next(
        event.time_s
        for event in flown.record.events_of("safety")
        if event.fields["reaction"] == reaction and "before" in event.fields
    )


def setpoints(flown: Flown) -> tuple[np.ndarray, list]:
    """Times and decoded SET_ATTITUDE_TARGETs as they went over the wire."""
    codec = mav.MAVLink(None)
    codec.robust_parsing = True
    times_ns, frames = flown.record.mavlink["out"]
    found = [(t, codec.decode(bytearray(f))) for t, f in zip(times_ns, frames, strict=True) if f[7] == 82]
    times = (np.array([t for t, _ in found]) - flown.record.utc_offset_ns) * 1e-9
    return times, [message for _, message in found]


def commands(flown: Flown) -> list:
    """The COMMAND_LONGs we sent, decoded."""
    codec = mav.MAVLink(None)
    _, frames = flown.record.mavlink["out"]
    return [
        codec.decode(bytearray(f)) for f in frames if f[7] == mav.MAVLINK_MSG_ID_COMMAND_LONG and f[8] == 0
    ]


# The reactions -----------------------------------------------------------------------------------------


def test_hold_comes_to_rest_stays_and_is_landed(stub, tmp_path):
    flown = fly_short(stub, tmp_path, settings=["flight.safety.hold_s=4.0", *only("hold")])
    assert flown.result.outcome is Outcome.ABORTED
    assert "position_error_m" in flown.result.text and "held for 4.0 s" in flown.result.text
    began, landed = entered(flown, "hold"), entered(flown, "land")
    assert landed - began == pytest.approx(4.0, abs=0.011)
    reference = flown.record.channel("/reference")
    held = (reference.time_s > began + 2.5) & (reference.time_s < landed)
    assert np.ptp(reference["position_enu"][held], axis=0).max() < 1e-9  # the reference stands
    at_once = np.abs(np.diff(reference["position_enu"], axis=0)).max()
    assert at_once < 0.02  # at 0.8 m/s and 100 Hz it moves 8 mm a step: no jump on the way there
    state = flown.record.channel("/state")
    still = (state.time_s > landed - 1.0) & (state.time_s < landed)
    assert np.ptp(state["position_enu"][still], axis=0).max() < 0.2
    assert flown.armed == [True, False]
    assert "AUTO.LAND" in flown.modes


def test_the_fall_back_switches_the_networks_off_without_a_bump(stub, tmp_path):
    share = "flight.safety.network_share"
    settings = [f"{share}.warn=off", f"{share}.freeze=off", f"{share}.non_adaptive=[0.02, 0.4]"]
    flown = fly_short(stub, tmp_path, settings=settings)
    assert flown.result.outcome is Outcome.COMPLETED  # it flies on
    began = entered(flown, "non_adaptive")
    changes = [
        (e.time_s, e.fields["reaction"]) for e in flown.record.events_of("safety") if "before" in e.fields
    ]
    until = [*(time_s for time_s, _ in changes[1:]), flown.record.channel("/reference").time_s[-1]]
    off_s = sum(end - at for (at, name), end in zip(changes, until, strict=True) if name == "non_adaptive")
    said = f"networks off for {off_s:.{0 if off_s >= 9.95 else 1}f} s"
    assert said in flown.result.text and flown.result.text.startswith("flown as planned")
    assert flown.record.events_of("ended")[-1].fields["text"] == flown.result.text
    metrics, _ = flight_metrics(flown.record)
    assert any(said in note for note in metrics.notes)
    assert metrics.to_json()["worst_reaction"] == "non_adaptive"
    assert metrics.to_json()["reactions_s"]["non_adaptive"] == pytest.approx(off_s, abs=1e-6)
    assert any(said in note for note in compare_logs([flown.log]).notes)
    terms, steps = flown.record.channel("/terms"), flown.record.channel("/law_input")
    first = int(np.searchsorted(terms.time_s, began - 1e-9))
    before = np.linalg.norm(terms["position_network_term"][first - 1])
    assert before > 0.25  # newtons: there was something to hand over
    assert np.abs(terms["position_network_term"][first]).max() < 1e-12
    force, typical = terms["force"], np.abs(np.diff(terms["force"][first - 30 : first], axis=0)).max()
    assert np.abs(force[first] - force[first - 1]).max() < max(0.1, 2.0 * typical)
    assert steps["gate"][first] == 1.0  # FREEZE_WEIGHTS
    weights = terms["position_weight_norm"][first : first + 50]
    assert weights.max() == 0.0


def tilts_and_thrusts(sent: list) -> tuple[np.ndarray, np.ndarray]:
    """Of decoded SET_ATTITUDE_TARGETs: ° and 0..1."""
    tilts = np.degrees([math.acos(1.0 - 2.0 * (m.q[1] ** 2 + m.q[2] ** 2)) for m in sent])
    return tilts, np.array([m.thrust for m in sent])


def test_hand_back_asks_for_a_hold_and_keeps_level_until_it_has_it(stub, tmp_path):
    flown = fly_short(stub, tmp_path, settings=only("hand_back", "flight.safety.silence_s=2.0"))
    assert flown.result.outcome is Outcome.HANDED_BACK
    assert "position_error_m" in flown.result.text
    taken = flown.record.events_of("mode")[-1]
    assert taken.fields["mode"] == "AUTO.LOITER"
    times, sent = setpoints(flown)
    assert (times > taken.time_s + 1e-6).sum() <= 1
    after = times > entered(flown, "hand_back") + 1e-6
    tilts, thrusts = tilts_and_thrusts(sent)
    assert tilts[after].max(initial=0.0) < 0.1
    assert thrusts[after].max(initial=0.0) < 1.03 * np.median(thrusts[~after][-100:])  # what it hovered with


def test_disarm_stops_the_motors_where_it_is_configured(stub, tmp_path):
    flown = fly_short(stub, tmp_path, settings=["flight.safety.allow_disarm=true", *only("disarm")])
    assert flown.result.outcome is Outcome.ABORTED
    assert "motors stopped" in flown.result.text
    assert flown.armed == [True, False]
    assert "AUTO.LAND" not in flown.modes


def test_land_is_asked_for_within_a_state_and_taken_within_a_tenth_of_a_second(stub, tmp_path):
    flown = fly_short(stub, tmp_path, settings=only("land"))
    assert flown.result.outcome is Outcome.ABORTED
    began = entered(flown, "land")
    taken = next(e.time_s for e in flown.record.events_of("mode") if e.fields["mode"] == "AUTO.LAND")
    assert taken - began < 0.1
    assert flown.setpoints_after("mode", mode="AUTO.LAND") <= 1
    times, sent = setpoints(flown)
    assert tilts_and_thrusts(sent)[0][times > began + 1e-6].max(initial=0.0) < 0.1


def test_landing_without_an_answer_to_the_command_stops_the_setpoints_too(tmp_path):
    """Found by the campaign: 77 setpoints after the mode was LAND, while a lost COMMAND_ACK was waited for."""
    scenario = tmp_path / "silent.toml"
    scenario.write_text('[[fault]]\nkind = "ack_loss"\nafter = "airborne"\nat_s = 1.0\n')
    with lockstep_stub("--scenario", str(scenario)) as stub:
        flown = fly_short(stub, tmp_path, trajectory="hover")
    assert flown.result.outcome is Outcome.COMPLETED
    assert flown.setpoints_after("mode", mode="AUTO.LAND") <= 1


def test_each_reaction_is_logged_once_with_its_numbers(stub, tmp_path):
    flown = fly_short(stub, tmp_path, settings=[f"{OFF}.warn=[{ALWAYS}, 0.0]"])
    assert flown.result.outcome is Outcome.COMPLETED
    began = [e for e in safety_events(flown) if e.get("quantity") == "position_error_m" and e["active"]]
    ended = [e for e in safety_events(flown) if e.get("quantity") == "position_error_m" and not e["active"]]
    assert 1 <= len(began) <= 3 and len(ended) in (len(began), len(began) - 1)
    assert began[0]["limit"] == ALWAYS and began[0]["value"] > ALWAYS and began[0]["unit"] == "m"
    assert sum(line.startswith("warn: position_error_m") for line in flown.reporter.lines) == len(began)


# Bad numbers -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", ["attitude", "body_rate"])
def test_a_law_that_returns_nan_never_reaches_the_wire(stub, tmp_path, monkeypatch, level):
    broken: list[int] = []
    sound = ControlLaw.step_packed

    def step(self, memory, inputs):
        result = sound(self, memory, inputs)
        if not broken:
            return result
        broken.append(1)
        nan = np.full(3, math.nan)
        setpoint = result.setpoint
        bad = Setpoint(setpoint.level, setpoint.thrust_newton, np.append(nan, 1.0), nan, setpoint.torque_flu)
        return StepResult(result.memory, bad, result.terms)

    monkeypatch.setattr(ControlLaw, "step_packed", step)
    flown = fly_short(stub, tmp_path, {Phase.TRACK: lambda: broken.append(1)}, level=level)
    assert flown.result.outcome is Outcome.ABORTED
    assert "refused_setpoints 3 in a row" in flown.result.text
    assert len(broken) == 1 + 3  # the fourth state finds three refusals
    assert flown.armed == [True, False]
    _, sent = setpoints(flown)
    numbers = [[*m.q, m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate, m.thrust] for m in sent]
    assert np.isfinite(numbers).all()
    refused = [e for e in safety_events(flown) if e["reaction"] == "setpoint refused"]
    assert len(refused) == 1 and refused[0]["reason"]


def spoiled_positions(monkeypatch, spoil) -> list[int]:
    """From when the returned list is not empty, `spoil` changes every LOCAL_POSITION_NED before it is taken."""
    on: list[int] = []
    sound = StateAssembler.take

    def take(self, message):
        if on and message.get_msgId() == mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            assert math.isfinite(
                message.x
            )  # a message reads all its fields at once: after that they may be changed
            spoil(message)
        return sound(self, message)

    monkeypatch.setattr(StateAssembler, "take", take)
    return on


def test_positions_that_are_no_numbers_never_reach_the_law(stub, tmp_path, monkeypatch):
    def spoil(message):
        message.x = math.nan

    on = spoiled_positions(monkeypatch, spoil)
    flown = fly_short(stub, tmp_path, {Phase.TRACK: lambda: on.append(1)})
    assert flown.result.outcome is Outcome.ABORTED
    assert "position_age_s 0.4" in flown.result.text
    inputs = flown.record.channel("/law_input")
    assert np.isfinite(inputs.values).all()
    began = flown.record.events_of("tracking")[0].time_s
    reactions = {
        e.fields["reaction"]: e.time_s - began
        for e in flown.record.events_of("safety")
        if "before" in e.fields
    }
    assert reactions["freeze"] == pytest.approx(0.21, abs=0.025)
    assert reactions["land"] == pytest.approx(0.41, abs=0.025)
    gates = inputs["gate"][inputs.time_s > began + 0.25]
    assert gates.size and (gates == 2.0).all()  # FREEZE
    assert flown.armed == [True, False]


def test_a_position_that_is_stuck_is_not_believed_for_long(stub, tmp_path, monkeypatch):
    last: list[tuple[float, float, float]] = []

    def spoil(message):
        last.append((message.x, message.y, message.z))
        message.x, message.y, message.z = last[0]

    on = spoiled_positions(monkeypatch, spoil)
    flown = fly_short(stub, tmp_path, {Phase.TRACK: lambda: on.append(1)})
    assert flown.result.outcome is Outcome.ABORTED
    stuck = [e for e in safety_events(flown) if e.get("quantity") == "position_stuck_s"]
    assert stuck and stuck[0]["reaction"] == "warn"
    assert flown.result.text.startswith("position_stuck_s 1.0")


def test_an_estimator_reset_moves_the_plan_and_does_not_kick_the_vehicle(stub, tmp_path, monkeypatch):
    def spoil(message):
        message.x += 1.0  # m north, from one message to the next

    on = spoiled_positions(monkeypatch, spoil)
    flown = fly_short(stub, tmp_path, {Phase.TRACK: lambda: on.append(1)})
    assert flown.result.outcome is Outcome.COMPLETED
    jump = next(e for e in safety_events(flown) if e.get("quantity") == "position_jump_m")
    assert jump["reaction"] == "warn" and jump["value"] == pytest.approx(1.0, abs=0.02)
    began = flown.record.events_of("tracking")[0].time_s
    reference, state = flown.record.channel("/reference"), flown.record.channel("/state")
    near = (reference.time_s > began) & (reference.time_s < began + 1.0)
    at = np.searchsorted(state.time_s, reference.time_s[near])
    error = np.linalg.norm(reference["position_enu"][near] - state["position_enu"][at], axis=1)
    assert error.max() < 0.15  # a plan that stayed would be 1 m away
    times, sent = setpoints(flown)
    tilts = np.degrees([math.acos(1.0 - 2.0 * (m.q[1] ** 2 + m.q[2] ** 2)) for m in sent])
    after = (times > began) & (times < began + 1.0)
    before = (times > began - 2.0) & (times < began)
    assert tilts[after].max() < max(
        12.0, 2.0 * tilts[before].max()
    )  # 1 m of error would ask for the full 35°


def test_a_reset_of_the_estimate_is_no_error_against_the_truth(tmp_path):
    """A reset of 1.08 m made 0.74 m of RMS out of a flight that was 1 to 3 cm off."""
    scenario = tmp_path / "reset.toml"
    fault = '[[fault]]\nkind = "estimator_reset"\nafter = "airborne"\n'
    first = "at_s = 14.0\nnorth_m = 1.08\neast_m = -0.2\n"
    second = "at_s = 16.0\nnorth_m = 0.0\ndown_m = -0.3\nyaw_deg = 12.0\n"
    scenario.write_text(fault + first + fault + second)
    with lockstep_stub("--scenario", str(scenario)) as stub:
        flown = fly_short(stub, tmp_path, settings=["flight.duration_s=8"])
    assert flown.result.outcome is Outcome.COMPLETED
    jumps = [event.fields for event in flown.record.events_of("estimator_reset")]
    assert [sum(axis) for axis in zip(*(jump["jump_enu"] for jump in jumps), strict=True)] == pytest.approx(
        [-0.2, 1.08, 0.3], abs=0.05
    )
    assert math.degrees(sum(jump["yaw_jump_rad"] for jump in jumps)) == pytest.approx(-12.0, abs=1.0)
    metrics, tracking = flight_metrics(flown.record)
    since = flown.record.events_of("estimator_reset")[0].time_s - tracking.start_s
    assert 0.0 < since < 7.0  # while it tracked
    truth, estimate = metrics.get("rms", "position_truth_m"), metrics.get("rms", "position_estimate_m")
    assert truth == pytest.approx(estimate, abs=0.05)
    assert max(truth) < 0.2
    assert metrics.get("rms", "yaw_truth_deg") == pytest.approx(
        metrics.get("rms", "yaw_estimate_deg"), abs=1.0
    )


# The pilot, and what cannot be sent ----------------------------------------------------------------------


def test_moving_a_stick_takes_the_vehicle_away_from_us(stub, tmp_path, monkeypatch):
    sticks = [1500, 1500, 1500, 1500]
    sound, calls, moved = Link.receive, itertools.count(), []

    def receive(self, timeout_s):
        if moved and len(moved) < 2000:  # then nobody watches any more
            moved.append(1)
            if len(moved) == 2000:
                interrupt()
        if next(calls) % 20 == 0 and self.target_system is not None:
            rest = [1500] * 14
            return mav.MAVLink_rc_channels_message(0, 8, *sticks, *rest, 100)
        return sound(self, timeout_s)

    def move():
        sticks[1] = 1750
        moved.append(1)

    monkeypatch.setattr(Link, "receive", receive)
    flown = fly_short(stub, tmp_path, {Phase.TRACK: move}, ["flight.safety.silence_s=2.0"])
    assert flown.result.outcome is Outcome.PILOT
    assert "pitch by +25%" in flown.result.text
    began = flown.record.events_of("tracking")[0].time_s
    times, _ = setpoints(flown)
    assert times[-1] - began < 0.2
    assert "AUTO.LOITER" in flown.modes  # this pilot's sticks do not change PX4's mode by themselves


def test_setpoints_that_cannot_be_sent_hand_the_vehicle_back(stub, tmp_path, monkeypatch):
    sound, deaf = Link.send, []

    def send(self, message):
        if deaf and message.get_msgId() == mav.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET:
            return False
        return sound(self, message)

    monkeypatch.setattr(Link, "send", send)
    flown = fly_short(stub, tmp_path, {Phase.TRACK: lambda: deaf.append(1)}, ["flight.safety.silence_s=2.0"])
    began = flown.record.events_of("tracking")[0].time_s
    assert entered(flown, "warn") - began < 0.13
    assert flown.result.outcome is Outcome.HANDED_BACK, flown.result.text
    assert entered(flown, "hand_back") - began == pytest.approx(0.51, abs=0.03)


# Our own thread, and a vehicle that flies already ----------------------------------------------------------


def test_a_loop_that_hangs_sends_nothing_and_lands_when_it_wakes(stub, tmp_path, monkeypatch):
    """The watchdog runs in real time only; here it is started by hand, so that a busy machine does not fly badly."""
    sound = Flight._watch_over

    def watch_over(self, ground):
        watching = sound(self, ground)
        watching.watchdog.start()
        return watching

    monkeypatch.setattr(Flight, "_watch_over", watch_over)
    settings = ["flight.safety.stall_s=1.0"]
    flown = fly_short(stub, tmp_path, {Phase.TRACK: lambda: time.sleep(2.5)}, settings)
    assert flown.result.outcome is Outcome.ABORTED
    assert "the control loop stood still for 2." in flown.result.text
    stalled = next(e for e in safety_events(flown) if e["reaction"] == "loop stalled")
    assert 1.0 < stalled["value"] < 2.0  # told while it hung, by the thread that watches
    tracking = flown.record.events_of("tracking")[0].time_s
    times, sent = setpoints(flown)
    late = (
        times > tracking + 0.011
    )  # nothing while it hung, nor what was begun before; then level until LAND shows
    assert late.sum() < 30
    assert tilts_and_thrusts(sent)[0][late].max(initial=0.0) < 0.1
    assert "AUTO.LAND" in flown.modes
    assert flown.armed == [True, False]


def test_a_vehicle_that_flies_already_is_never_given_idle_setpoints(tmp_path):
    """Armed and taken off by its pilot while we wait for the switch to offboard."""
    pilot = GroundPilot()

    def take_off():
        pilot.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
        pilot.command(mav.MAV_CMD_NAV_TAKEOFF, -1.0, 0.0, 0.0, math.nan, math.nan, math.nan, 10.0)

    with lockstep_stub(*pilot.options) as stub:
        flown = fly_short(stub, tmp_path, {Phase.ENGAGE: take_off}, wait_for_offboard=True)
    pilot.close()
    assert flown.result.outcome is Outcome.REFUSED
    assert "the vehicle is flying" in flown.result.text
    assert "OFFBOARD" not in flown.modes
    assert flown.armed == [True]


@pytest.mark.parametrize("begins_s", [0.0, 3.0], ids=["from the start", "just before arming"])
def test_a_vehicle_that_does_not_say_whether_it_stands_is_refused(tmp_path, begins_s):
    scenario = tmp_path / "silent.toml"
    scenario.write_text(
        f'[[fault]]\nkind = "stream_stop"\nat_s = {begins_s}\nmessages = ["EXTENDED_SYS_STATE"]\n'
    )
    settings = ["flight.procedure.prove_s=6"]
    with lockstep_stub("--scenario", str(scenario)) as stub:
        flown = fly_short(stub, tmp_path, settings=settings)
    assert flown.result.outcome is Outcome.REFUSED
    assert "EXTENDED_SYS_STATE" in flown.result.text
    assert flown.armed == []


def test_the_switch_to_offboard_can_be_the_pilots(tmp_path):
    pilot = GroundPilot()
    with lockstep_stub(*pilot.options) as stub:
        at = {Phase.ENGAGE: lambda: pilot.mode(6, 0)}
        flown = fly_short(stub, tmp_path, at, wait_for_offboard=True)
    pilot.close()
    assert flown.result.outcome is Outcome.COMPLETED
    modes = [m.param2 for m in commands(flown) if m.command == mav.MAV_CMD_DO_SET_MODE]
    assert 6.0 not in modes  # never asked for by us


@pytest.mark.parametrize("phase", [Phase.LIFT_OFF, Phase.TRACK])
def test_a_pilot_who_disarms_is_not_armed_again(tmp_path, phase):
    """21196 kills the motors in the air too."""
    pilot = GroundPilot()
    with lockstep_stub(*pilot.options) as stub:
        kill = {phase: lambda: pilot.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 21196.0)}
        flown = fly_short(stub, tmp_path, kill)
    pilot.close()
    assert flown.result.outcome is Outcome.PILOT
    assert "disarmed" in flown.result.text
    assert flown.armed == [True, False]
    assert flown.setpoints_after("armed", armed=False) <= 1  # the one that was under way
