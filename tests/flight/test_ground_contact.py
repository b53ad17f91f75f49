"""A height estimate that is wrong by more than the plan is high: the vehicle meets the ground while it tracks."""

from __future__ import annotations

import numpy as np
import pytest
from stub_flights import fly_short, lockstep_stub

from companion.autopilot.adapter import VehicleStatus
from companion.flight.outcome import Outcome

pytestmark = pytest.mark.flight


def test_a_vehicle_that_tracks_on_the_ground_is_landed_before_it_tips(tmp_path):
    scenario = tmp_path / "sinks.toml"
    scenario.write_text(
        '[[fault]]\nkind = "estimator_divergence"\nafter = "airborne"\nat_s = 10.0\nfor_s = 9.0\n'
        "north_m_s = 0.0\ndown_m_s = -0.15\nrecovers = false\n"
    )
    with lockstep_stub("--scenario", str(scenario)) as stub:
        flown = fly_short(stub, tmp_path, settings=["flight.duration_s=20"])
    assert flown.result.outcome is Outcome.ABORTED
    assert flown.result.text.startswith("ground_support ") and flown.armed == [True, False]
    truth, until_s = flown.record.channel("/truth"), flown.record.channel("/reference").time_s[-1]
    height, quaternion = truth["position_enu"][:, 2], truth["quaternion_wxyz"]
    grounded = np.median(height[truth.time_s < truth.time_s[0] + 0.5])
    flying = np.flatnonzero(height > grounded + 0.5)[0]
    met = truth.time_s[flying:][height[flying:] < grounded + 0.01][0]
    assert 0.0 < until_s - met < 1.2
    tilt_deg = np.degrees(np.arccos(1.0 - 2.0 * (quaternion[:, 1] ** 2 + quaternion[:, 2] ** 2)))
    assert tilt_deg.max() < 35.0
    assert tilt_deg[-20:].max() < 5.0


def test_a_good_flight_close_to_the_ground_meets_none(tmp_path):
    with lockstep_stub() as stub:
        flown = fly_short(stub, tmp_path, settings=["flight.duration_s=10", "flight.takeoff_height_m=0.4"])
    assert flown.result.outcome is Outcome.COMPLETED
    assert not [e for e in flown.record.events_of("safety") if e.fields.get("quantity") == "ground_support"]


def told(monkeypatch, accuracy_m: float) -> None:
    """ESTIMATOR_STATUS says that the height may be wrong by so much."""
    sound = VehicleStatus.take

    def take(self, message, time_s=0.0):
        sound(self, message, time_s)
        self.height_accuracy_m = accuracy_m

    monkeypatch.setattr(VehicleStatus, "take", take)


def test_a_plan_within_what_the_height_may_be_wrong_is_raised_and_said(tmp_path, monkeypatch):
    told(monkeypatch, 0.7)
    with lockstep_stub() as stub:
        flown = fly_short(stub, tmp_path)
    assert flown.result.outcome is Outcome.COMPLETED
    said = "comes down to 0.30 m, and the height estimate may be wrong by 0.70 m: raised by 0.40 m"
    assert any(said in line for line in flown.reporter.lines)
    reference, state = flown.record.channel("/reference"), flown.record.channel("/state")
    tracked = np.isfinite(reference["tracking_time_s"])
    lowest_m = reference["position_enu"][tracked, 2].min() - np.median(state["position_enu"][:50, 2])
    assert lowest_m == pytest.approx(0.7, abs=0.05)


def test_a_height_that_may_be_wrong_by_metres_is_refused(tmp_path, monkeypatch):
    told(monkeypatch, 2.5)
    with lockstep_stub() as stub:
        flown = fly_short(stub, tmp_path)
    assert flown.result.outcome is Outcome.REFUSED
    assert "the height estimate may be wrong by 2.50 m" in flown.result.text and flown.armed == []
