"""Without a profile the attitude loop's response is measured before tracking, flown by, said and logged; and replayed."""

import numpy as np
import pytest
from stub_flights import fly_short

from companion.analysis.adoption import adopted
from companion.analysis.identify import identify
from companion.analysis.metrics import flight_metrics
from companion.analysis.replay import laws_of, replay
from companion.config.settings import load_profile
from companion.flight.outcome import Outcome
from companion.flight.phases import Phase
from sitl_stub.stub_process import Stub

VEHICLE = "random:1001"
"""Its PX4 has MC_ROLL_P 2.82, and its attitude loop has not much more lag than that tells."""

MASS_KG = 0.63
DRAG_1_S = 0.2
"""Of the body and of its rotors, per mass, as the stub drew them."""


def test_a_slow_vehicle_is_measured_and_flown_by_it(tmp_path):
    with Stub("px4", VEHICLE, seed=1, lockstep=True) as stub:
        flown = fly_short(stub, tmp_path, profile=None, real_time=False, settings=["flight.duration_s=8"])
    assert flown.result.outcome is Outcome.COMPLETED
    last = flown.record.events_of("response")[-1].fields
    (pitch,) = (axis for axis in identify(flown.record) if axis.axis == "pitch")
    total_s = last["dead_time_s"] + 2.0 * last["damping"] / last["natural_frequency_rad_s"]
    assert total_s == pytest.approx(pitch.lag_s, rel=0.15)
    assert any(line.startswith("measured: attitude answers within") for line in flown.reporter.lines)
    drag = flown.record.events_of("drag")[-1].fields
    assert drag["drag_1_s"] == pytest.approx(DRAG_1_S, abs=2.5 * drag["deviation"])
    assert "measured in flight; within" in flown.record.metadata["vehicle"]["responses.px4.dead_time_s"]
    found = adopted(flown.record)
    assert found.tilt is not None and found.hover is not None
    assert found.tilt[0] + 2.0 * found.tilt[2] / found.tilt[1] == pytest.approx(total_s, rel=0.15)
    assert found.hover[0] == pytest.approx(
        0.35, abs=0.01
    )  # told 0.387, and 0.35 in the mean of the climb and after
    assert found.drag is not None and found.drag[0] == pytest.approx(DRAG_1_S, abs=0.06)
    assert any(line.startswith("yaw did not move") for line in found.unknown)
    path = tmp_path / "adopted.toml"
    path.write_text(found.profile_text(1.2, "flight.mcap"))
    profile = load_profile(str(path))
    assert profile.lag_margin == 1.2 and profile.response("px4").dead_time_s == pytest.approx(
        found.tilt[0], abs=6e-4
    )
    before, *_, after = laws_of(flown.record)
    assert tuple(before[1].parameters.attitude_lead) != tuple(after[1].parameters.attitude_lead)
    assert replay(flown.record).exact
    x, y, z = flight_metrics(flown.record)[0].get("rms", "position_estimate_m")
    assert x < 0.06 and y < 0.06 and z < 0.06


def test_a_response_that_was_written_is_flown_as_it_is(tmp_path):
    with Stub("px4", seed=1, lockstep=True) as stub:
        flown = fly_short(stub, tmp_path, real_time=False)
    assert flown.record.events_of("response") == flown.record.events_of("drag") == []
    assert len(laws_of(flown.record)) == 1


def test_a_fifth_of_the_mass_dropped_in_flight(tmp_path):
    """z stays within 0.15 m (it was 0.13), and the supervisor has nothing to say."""
    with Stub("px4", VEHICLE, seed=1, lockstep=True) as stub:
        drop = {Phase.TRACK: lambda: stub.inject("payload_drop", mass_kg=0.2 * MASS_KG)}
        flown = fly_short(
            stub, tmp_path, drop, profile=None, real_time=False, settings=["flight.duration_s=6"]
        )
    assert flown.result.outcome is Outcome.COMPLETED and flown.record.events_of("safety") == []
    reference, state = flown.record.channel("/reference"), flown.record.channel("/state")
    tracking = np.isfinite(reference["tracking_time_s"])
    height = np.interp(reference.time_s[tracking], state.time_s, state["position_enu"][:, 2])
    assert np.max(np.abs(reference["position_enu"][tracking, 2] - height)) < 0.15
