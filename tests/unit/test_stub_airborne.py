"""The stub that begins in the air: armed, holding, at the height asked for, and it stays there."""

from __future__ import annotations

import numpy as np
import pytest

from sitl_stub.firmware.ardupilot.build import build_ardupilot
from sitl_stub.firmware.px4.build import build_px4


@pytest.mark.parametrize(("build", "mode"), [(build_px4, "LOITER"), (build_ardupilot, "LOITER")])
def test_it_begins_in_the_air_and_holds(build, mode):
    autopilot = build()
    autopilot.take_off_alone(2.0)
    assert autopilot.armed and autopilot.airborne
    assert autopilot.mode_name == mode
    before = np.array(autopilot.core.position_ned)
    autopilot.advance_to(autopilot.time_us + 5_000_000)
    assert autopilot.mode_name == mode
    assert autopilot.core.clearance_m == pytest.approx(2.0, abs=0.2)
    assert np.linalg.norm(autopilot.core.position_ned - before) < 0.2


def test_it_says_why_it_cannot_begin_in_the_air():
    autopilot = build_px4()
    autopilot.pilot_kill(True)
    with pytest.raises(ValueError, match="--airborne: not ready to arm after 120 s"):
        autopilot.take_off_alone(2.0)
