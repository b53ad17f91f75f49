"""When a vehicle counts as flying: by what height and speed gained, and at what thrust."""

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.procedure import Procedure
from companion.flight.lift_off import LiftOffDetector

GRAVITY = 9.81
PERIOD_S = 0.01
# PX4's own simulator with GPS, motors turning, on the ground until 2.1 s: estimated height (m) and upward speed (m/s)
# every 0.1 s.
PX4_HEIGHT_M = """0.508 0.510 0.515 0.520 0.527 0.537 0.549 0.565 0.582 0.597 0.612 0.629 0.646 0.663 0.680 0.701
                   0.721 0.741 0.762 0.785 0.810 0.833 0.862 0.903 0.966 1.048 1.160"""
PX4_SPEED_M_S = """0.018 0.040 0.059 0.056 0.083 0.107 0.134 0.172 0.161 0.173 0.162 0.191 0.202 0.181 0.217 0.250
                   0.236 0.248 0.231 0.275 0.290 0.274 0.393 0.557 0.790 0.985 1.131"""
PX4_LEFT_S = 2.1


def ramp(time_s: float) -> float:
    procedure = Procedure()
    return procedure.lift_off_start + procedure.lift_off_rate * time_s


def detected_s(
    times_s: NDArray[np.float64],
    heights_m: NDArray[np.float64],
    speeds_m_s: NDArray[np.float64],
    scale: float,
) -> float:
    """When it is said; the thrust's ramp is `scale` hover thrusts of the vehicle where the parameter says one."""
    detector = LiftOffDetector(Procedure())
    for time_s, height_m, speed_m_s in zip(times_s, heights_m, speeds_m_s, strict=True):
        if detector.has_left(float(time_s), float(height_m), float(speed_m_s), ramp(float(time_s)) / scale):
            return float(time_s)
    return float("nan")


def test_an_estimate_that_climbs_on_the_ground_is_no_lift_off() -> None:
    heights, speeds = (np.array(text.split(), dtype=float) for text in (PX4_HEIGHT_M, PX4_SPEED_M_S))
    times = 0.1 * np.arange(len(heights))
    said_s = detected_s(times, heights, speeds, scale=1.0)
    assert PX4_LEFT_S < said_s <= PX4_LEFT_S + 0.31


@pytest.mark.parametrize("scale", [0.6, 1.0, 1.5])
def test_a_lift_off_is_seen_within_half_a_second(scale: float) -> None:
    """Whatever the hover parameter is wrong by: `scale` is the true hover thrust over it."""
    times = np.arange(0.0, 4.0, PERIOD_S)
    thrust = np.array([ramp(float(t)) for t in times]) / scale  # in true hover thrusts
    speeds = np.cumsum(np.maximum(0.0, thrust - 1.0)) * GRAVITY * PERIOD_S
    heights = np.cumsum(speeds) * PERIOD_S
    left_s = float(times[np.argmax(thrust > 1.0)])
    said_s = detected_s(times, heights, speeds, scale=1.0)
    assert left_s < said_s < left_s + 0.5


def test_no_speed_is_a_lift_off_at_a_thrust_that_carries_nothing() -> None:
    detector = LiftOffDetector(Procedure())
    said = [detector.has_left(0.01 * i, 0.01 * i, 0.02 * i, hovers=0.59) for i in range(200)]
    assert not any(said)
