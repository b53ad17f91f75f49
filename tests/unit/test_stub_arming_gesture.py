"""Throttle down and yaw to the right arms both firmwares of the stub, in modes that are flown by hand only."""

from __future__ import annotations

import pytest

from sitl_stub.firmware.ardupilot.build import build_ardupilot
from sitl_stub.firmware.px4.build import build_px4

CASES = [(build_px4, "POSCTL", 1.0, True), (build_px4, "LOITER", 1.0, False)]
CASES += [(build_ardupilot, "STABILIZE", 2.0, True), (build_ardupilot, "GUIDED", 2.0, False)]


@pytest.mark.parametrize(("build", "mode", "held_s", "arms"), CASES)
def test_the_gesture_arms_after_its_time_in_modes_flown_by_hand(build, mode, held_s, arms):
    autopilot = build(ready_after_s=1.0)
    autopilot.advance_to(12_000_000)
    autopilot.pilot_mode(mode)
    autopilot.pilot_sticks(0.0, 0.0, 1.0, 0.0)
    autopilot.advance_to(autopilot.time_us + round((held_s - 0.1) * 1e6))
    assert not autopilot.armed
    autopilot.advance_to(autopilot.time_us + 300_000)
    assert autopilot.armed is arms


def test_a_throttle_that_is_up_does_not_arm():
    autopilot = build_px4(ready_after_s=1.0)
    autopilot.advance_to(12_000_000)
    autopilot.pilot_mode("POSCTL")
    autopilot.pilot_sticks(0.0, 0.0, 1.0, 0.2)
    autopilot.advance_to(autopilot.time_us + 3_000_000)
    assert not autopilot.armed
