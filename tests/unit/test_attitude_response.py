"""The attitude loop's response from setpoints and attitudes: found where they moved, as told where they did not."""

import math

import numpy as np
import pytest

from companion.autopilot.attitude_response import AttitudeResponseMeter
from companion.config.profile import SecondOrder

TOLD = (0.07, SecondOrder(natural_frequency_rad_s=12.0, damping=1.0))


def turned(roll, pitch):
    """(4,) quaternion of ZYX roll and pitch, heading 0."""
    a, b, c, d = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return np.array([a * c, b * c, a * d, -b * d])


def seen(dead_s, omega, zeta, amplitude_rad, noise_rad=0.0, offset_rad=0.0, every=20, seconds=8.0):
    """A meter that saw such a vehicle, integrated in steps of 0.5 ms, with 0.1 s halves of a swing and `noise_rad`."""
    meter, draw, h = AttitudeResponseMeter(*TOLD), np.random.default_rng(3), 0.0005
    wanted = [amplitude_rad * math.sin(2.2 * k * h) * math.sin(0.7 * k * h) for k in range(int(seconds / h))]
    x, v, late = 0.0, 0.0, round(dead_s / h)
    for k in range(len(wanted)):
        if k % every == 0:
            noise = noise_rad * draw.standard_normal(2)
            meter.update(k * h, turned(x + offset_rad + noise[0], -x + offset_rad + noise[1]))
            meter.sent(k * h, turned(wanted[k], -wanted[k]))
        held = wanted[(k - late) // every * every] if k >= late else 0.0
        v += h * (omega**2 * (held - x) - 2.0 * zeta * omega * v)
        x += h * v
    return meter.measured()


@pytest.mark.parametrize("dead_s, omega, zeta", [(0.04, 6.0, 0.75), (0.09, 5.0, 1.25), (0.02, 12.0, 1.0)])
@pytest.mark.parametrize("noise_deg, offset_deg", [(0.0, 0.0), (0.3, 1.0)])
def test_a_response_unlike_the_one_told(dead_s, omega, zeta, noise_deg, offset_deg):
    """6° of motion, noise of an estimator, an attitude that is off: dead time and lag together within 10 %."""
    found = seen(dead_s, omega, zeta, math.radians(6.0), math.radians(noise_deg), math.radians(offset_deg))
    assert found.dead_time_s + found.tilt.lag_s == pytest.approx(dead_s + 2.0 * zeta / omega, rel=0.1)
    assert found.sure and found.deviation < 0.15


def test_without_motion_it_is_what_was_told_and_not_sure():
    found = seen(0.04, 5.0, 0.7, 0.0, noise_rad=math.radians(0.3))
    assert found.dead_time_s + found.tilt.lag_s == pytest.approx(0.07 + 2.0 / 12.0, rel=0.25)
    assert not found.sure


def test_a_gap_does_not_count():
    """What happened while nothing was heard is not held against the models."""
    meter = AttitudeResponseMeter(*TOLD)
    for k in range(400):
        meter.update(0.01 * k, turned(0.0, 0.0))
        meter.sent(0.01 * k, turned(0.0, 0.0))
    before = meter.measured()
    meter.update(10.0, turned(0.5, 0.5))
    assert meter.measured() == before


@pytest.mark.parametrize("every", [8, 40])
def test_at_other_rates(every):
    """250 Hz and 50 Hz."""
    found = seen(0.06, 7.0, 0.9, math.radians(6.0), every=every)
    assert found.dead_time_s + found.tilt.lag_s == pytest.approx(0.06 + 1.8 / 7.0, rel=0.1)
