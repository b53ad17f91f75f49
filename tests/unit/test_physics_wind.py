"""Wind: steady part, Dryden variances and spectra as MIL-F-8785C gives them, the same bits for the same seed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import welch

from sitl_stub.physics.vehicle import VELOCITY_NED, WIND_NED, calm_environment, initial_state, load_vehicle
from sitl_stub.physics.wind import Wind

VEHICLE = load_vehicle("qball2")


def gusts(wind, height_m=10.0, dt_s=0.02, samples=200_000, velocity=(0.0, 0.0, 0.0)):
    state, environment = initial_state(VEHICLE, (0.0, 0.0, 0.25 - height_m)), calm_environment(VEHICLE)
    state[VELOCITY_NED] = velocity
    out = np.empty((samples, 3))
    for row in out:
        wind.update(state, environment, dt_s)
        row[:] = environment[WIND_NED]
    return out


def figures(height_m, speed_20):
    """σ_u, σ_w in m/s and L_u, L_w in m, worked out here in feet from the standard's formulas."""
    feet = height_m / 0.3048
    sd_w = 0.1 * speed_20
    factor = 0.177 + 0.000823 * feet
    return sd_w / factor**0.4, sd_w, feet / factor**1.2 * 0.3048, height_m


def test_the_standard_deviations_are_the_standards():
    """At 100 ft with 20 m/s at 20 ft: σ_w 2 m/s, σ_u = 2 / 0.2593^0.4 = 3.43 m/s."""
    sd_u, sd_w, length_u, _ = figures(30.48, 20.0)
    assert (sd_u, sd_w) == (pytest.approx(3.432, abs=0.002), 2.0)
    seen = gusts(Wind((10.0, 0.0, 0.0), 20.0, seed=1), 30.48, dt_s=0.5)
    assert (length_u / 10.0) < 0.5 * 200_000 / 1000  # a thousand correlation times and more
    np.testing.assert_allclose(seen.std(axis=0), [sd_u, sd_u, sd_w], rtol=0.04)
    np.testing.assert_allclose(seen.mean(axis=0), [10.0, 0.0, 0.0], atol=0.15)


def test_the_spectra_are_drydens():
    """One-sided, per Hz: u: 4 σ² τ / (1 + (τω)²); v and w: 2 σ² τ (1 + 3(τω)²) / (1 + (τω)²)², τ = L/V."""
    sd_u, sd_w, length_u, length_w = figures(10.0, 10.0)
    seen = gusts(Wind((8.0, 0.0, 0.0), 10.0, seed=2), 10.0, dt_s=0.02)
    frequency, power = welch(seen - seen.mean(axis=0), fs=50.0, nperseg=8192, axis=0)
    for axis, (sd, tau) in enumerate(
        [(sd_u, length_u / 8.0), (sd_u, length_u / 8.0), (sd_w, length_w / 8.0)]
    ):
        for low, high in ((0.02, 0.06), (0.1, 0.2), (0.5, 1.0), (3.0, 5.0)):
            band = (frequency > low) & (frequency < high)
            x = (2 * np.pi * frequency[band] * tau) ** 2
            shape = 4 / (1 + x) if axis == 0 else 2 * (1 + 3 * x) / (1 + x) ** 2
            assert power[band, axis].mean() == pytest.approx((sd**2 * tau * shape).mean(), rel=0.2)


def test_gusts_along_follow_the_direction_of_the_wind():
    """Blowing east, u is the east component: below 10 m it is longer-lived than w and uncorrelated with v."""
    seen = gusts(Wind((0.0, 6.0, 0.0), 8.0, seed=3), 10.0, dt_s=0.2, samples=100_000)
    along, across = seen[:, 1] - 6.0, -seen[:, 0]
    north = gusts(Wind((6.0, 0.0, 0.0), 8.0, seed=3), 10.0, dt_s=0.2, samples=100_000)
    np.testing.assert_allclose(along, north[:, 0] - 6.0, atol=1e-12)
    np.testing.assert_allclose(across, north[:, 1], atol=1e-12)
    assert abs(np.corrcoef(along, across)[0, 1]) < 0.05


def test_faster_flight_meets_the_gusts_faster():
    slow = gusts(Wind((3.0, 0.0, 0.0), 8.0, seed=4), samples=50_000)
    fast = gusts(Wind((3.0, 0.0, 0.0), 8.0, seed=4), samples=50_000, velocity=(-9.0, 0.0, 0.0))
    # airspeed 3 and 12 m/s: steps of an exponentially correlated process grow with √V
    ratio = np.diff(fast[:, 0]).std() / np.diff(slow[:, 0]).std()
    assert ratio == pytest.approx(2.0, rel=0.03)


def test_without_gusts_the_wind_is_steady_and_a_seed_repeats():
    assert (gusts(Wind((1.0, -2.0, 0.5)), samples=10) == [1.0, -2.0, 0.5]).all()
    one, two, other = (gusts(Wind((2.0, 0.0, 0.0), 5.0, seed), samples=500) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one, two)
    assert (one != other).all()


@pytest.mark.parametrize(
    "arguments", [((math.nan, 0.0, 0.0), 1.0), ((0.0, 0.0, 0.0), -1.0), ((0.0, 0.0, 0.0), math.inf)]
)
def test_wind_that_cannot_be_is_refused(arguments):
    with pytest.raises(ValueError, match="finite numbers"):
        Wind(*arguments)
