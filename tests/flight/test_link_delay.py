"""A slow link: measured, and flown with what is known of it."""

from __future__ import annotations

import numpy as np
import pytest
from stub_flights import fly_short, lockstep_stub

from companion.config.settings import load_profile
from companion.flight.control_loop import LINK_INCLUDED_S
from companion.flight.outcome import Outcome

pytestmark = pytest.mark.flight


def test_a_link_of_40_ms_each_way_is_predicted_across(tmp_path) -> None:
    """The profile's dead time knows nothing of the delay; without prediction across it the position errs by 12 cm."""
    with lockstep_stub() as stub:
        stub.inject("link_delay", delay_s=0.04)
        flown = fly_short(stub, tmp_path, settings=["flight.procedure.hold_s=0.5"])
    assert flown.result.outcome is Outcome.COMPLETED, flown.result.text
    estimates, reference, truth = (
        flown.record.channel(topic) for topic in ("/estimates", "/reference", "/truth")
    )
    assert estimates is not None and reference is not None and truth is not None
    grown_s = estimates["state_delay_s"][-1] - load_profile("qball2").response("px4").dead_time_s
    assert grown_s == pytest.approx(0.08 - LINK_INCLUDED_S, abs=0.015)  # its clock is told in steps of 10 ms
    tracking = np.isfinite(reference["tracking_time_s"])
    desired, times = reference["position_enu"][tracking], reference.time_s[tracking]
    was = np.column_stack([np.interp(times, truth.time_s, truth["position_enu"][:, i]) for i in range(3)])
    assert np.sqrt(np.mean((desired - was) ** 2, axis=0)).max() < 0.04
