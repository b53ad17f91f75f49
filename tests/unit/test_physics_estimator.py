"""What the autopilot believes: statistics of each preset, smoothness, delay, faults, same bits for the same seed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import welch

from sitl_stub.physics.estimator import ESTIMATE_SIZE, Estimator, advance_estimate
from sitl_stub.physics.noise import next_bits, random_state, second_order_markov, standard_normal, step_markov
from sitl_stub.physics.presets import PRESETS
from sitl_stub.physics.vehicle import (
    BODY_RATE_FRD,
    POSITION_NED,
    QUATERNION_WXYZ,
    ROTOR_SIGNALS,
    VELOCITY_NED,
    VehicleError,
    initial_state,
    load_vehicle,
)

VEHICLE = load_vehicle("qball2")


def hovering(thrusting=True):
    state = initial_state(VEHICLE, (1.0, 2.0, -3.0), yaw_rad=0.6)
    state[ROTOR_SIGNALS][:4] = 0.4 if thrusting else 0.0
    return state


def errors(preset, state, samples=150_000, seed=3, period_s=0.004):
    """Estimate less truth on the grid, (samples, 15): position, velocity, rotation about FRD, gyro, accelerometer."""
    estimator = Estimator(preset, seed, period_s)
    rows = np.empty((samples, ESTIMATE_SIZE))
    for row in rows:
        advance_estimate(*estimator.arguments, state)
        row[:] = estimator.arrays.estimate
    w, _, _, z = state[QUATERNION_WXYZ]
    qw, qx, qy, qz = rows[:, 6:10].T
    # conjugate of the true heading times the estimate
    rotation = 2 * np.column_stack([w * qx + z * qy, w * qy - z * qx, w * qz - z * qw])
    return np.column_stack(
        [rows[:, :3] - state[:3], rows[:, 3:6], rotation, rows[:, 10:13], rows[:, 13:16] - [0, 0, -9.81]]
    )


@pytest.mark.parametrize("name", ["mocap", "gps"])
def test_the_statistics_are_the_presets(name):
    preset = PRESETS[name]
    samples = 400_000
    seen = errors(name, hovering(), samples)
    spans = samples * 0.004
    velocity = np.hypot(np.array(preset.position.sd) * preset.position.corner_rad_s, preset.velocity.sd)
    expected = [
        (preset.position.sd, preset.position.corner_rad_s),
        (velocity, min(preset.velocity.corner_rad_s, preset.position.corner_rad_s)),
        (preset.attitude.sd, preset.attitude.corner_rad_s),
        (np.hypot(preset.gyro_sd_thrusting, preset.gyro_bias_sd), 1.0),
        (np.hypot(preset.accelerometer_sd_thrusting, preset.accelerometer_bias_sd), 1.0),
    ]
    for channel, (sd, corner) in enumerate(expected):
        # the variance of n correlated samples is known to √(2 τ_c / T) with τ_c = 5/(4ω): four of those
        margin = 4 * math.sqrt(2.5 / (corner * spans)) / 2 + 0.02
        np.testing.assert_allclose(seen[:, 3 * channel : 3 * channel + 3].std(axis=0), sd, rtol=margin)


def test_mocap_is_the_reports_laboratory():
    """2 mm, 0.02 m/s, 0.2°, 10 ms, as the project's issue gives them."""
    seen = errors("mocap", hovering())
    assert seen[:, :3].std() == pytest.approx(0.002, rel=0.1)
    assert seen[:, 3:6].std() == pytest.approx(0.02, rel=0.1)
    assert math.degrees(seen[:, 6:9].std()) == pytest.approx(0.2, rel=0.1)
    assert PRESETS["mocap"].delay_s == 0.010


def test_the_velocity_error_is_the_derivative_of_the_position_error():
    seen = errors("mocap", hovering(), 20_000)
    derivative = np.diff(seen[:, :3], axis=0) / 0.004
    middle = 0.5 * (seen[1:, 3:6] + seen[:-1, 3:6])
    # what is left is the bend of a random walk within a step: √(q h / 12) with q = 4 ω³ σ²
    bend = math.sqrt(4 * 10.0**3 * 0.002**2 * 0.004 / 12)
    assert bend < 0.12 * 0.02
    assert (derivative - middle).std() == pytest.approx(bend, rel=0.05)


def test_the_attitude_noise_is_band_limited():
    """No jump from one sample to the next (rms step σ ω dt), a thousandth of the power above ten times the corner."""
    sd, corner = math.radians(0.2), 5.0
    rotation = errors("mocap", hovering())[:, 6:9]
    assert np.diff(rotation, axis=0).std() == pytest.approx(sd * corner * 0.004, rel=0.05)
    frequency, power = welch(rotation, fs=250.0, nperseg=16384, axis=0)
    omega, power = 2 * np.pi * frequency, power.mean(axis=1)
    assert power[omega > 10 * corner].sum() < 1e-3 * power.sum()
    # and the shape: 1/(1 + (ω/ω₀)²)²
    for low, high in ((0.3, 1.5), (4.5, 5.5), (9.0, 11.0), (40.0, 60.0)):
        band = (omega > low) & (omega < high)
        shape = (
            4 * sd**2 / corner * 2 / (1 + (omega[band] / corner) ** 2) ** 2
        )  # one-sided, per Hz; integrates to σ²
        assert power[band].mean() == pytest.approx(shape.mean(), rel=0.2)


def test_rotors_turning_shake_the_sensors():
    seen = errors("gps", hovering(thrusting=False), 50_000)
    assert seen[:, 12:15].std(axis=0) == pytest.approx(
        np.hypot(PRESETS["gps"].accelerometer.sd, PRESETS["gps"].accelerometer_bias_sd), rel=0.8
    )
    assert errors("gps", hovering(), 50_000)[:, 13].std() > 10 * seen[:, 13].std()


def test_perfect_is_the_truth():
    state = hovering()
    state[VELOCITY_NED], state[BODY_RATE_FRD] = (1, 2, 3), (0.1, 0.2, 0.3)
    estimate = Estimator("perfect", seed=9).update(0.0, state)
    np.testing.assert_array_equal(estimate.array[:13], state[:13])
    np.testing.assert_array_equal(estimate.acceleration_frd, [0, 0, -9.81])
    assert estimate.position_valid and estimate.attitude_valid and estimate.age_s == 0.0


def test_position_is_late_by_the_delay_and_the_gyro_is_not():
    """At 250 Hz 10 ms lie between two grid points: a ramp must come out 10 ms old all the same."""
    from dataclasses import replace

    estimator = Estimator(replace(PRESETS["perfect"], name="late", delay_s=0.010))
    state = hovering()
    for k in range(100):
        t = k * 0.004
        state[POSITION_NED] = 2.0 * t, -t, 3.0
        state[BODY_RATE_FRD] = t, 0.0, 0.0
        half = 0.5 * t
        state[QUATERNION_WXYZ] = math.cos(half), 0.0, 0.0, math.sin(half)
        estimate = estimator.update(t, state)
    np.testing.assert_allclose(estimate.position_ned, [2.0 * (t - 0.01), -(t - 0.01), 3.0], atol=1e-12)
    assert 2 * math.atan2(estimate.quaternion_wxyz[3], estimate.quaternion_wxyz[0]) == pytest.approx(
        t - 0.01, abs=1e-6
    )
    assert estimate.body_rate_frd[0] == t
    assert estimate.age_s == pytest.approx(0.010)


@settings(max_examples=20, deadline=None)
@given(cuts=st.lists(st.floats(0.0005, 0.05), min_size=3, max_size=20), seed=st.integers(0, 2**31))
def test_the_noise_depends_on_the_time_and_not_on_how_often_one_asks(cuts, seed):
    state = hovering()
    end = sum(cuts)
    once = Estimator("mocap", seed)
    once.update(end, state)
    often = Estimator("mocap", seed)
    time = 0.0
    for cut in cuts:
        time += cut
        often.update(time, state)
    np.testing.assert_array_equal(once.arrays.estimate, often.arrays.estimate)


def test_another_seed_is_another_noise_and_faults_do_not_shift_it():
    state = hovering()
    one, two, faulty = Estimator("mocap", 1), Estimator("mocap", 2), Estimator("mocap", 1)
    faulty.set_aided(False)
    faulty.set_frozen(True)
    for estimator in (one, two, faulty):
        estimator.update(1.0, state)
    assert (one.estimate.position_ned != two.estimate.position_ned).all()
    faulty.set_aided(True)
    faulty.set_frozen(False)
    for estimator in (one, faulty):
        estimator.update(1.2, state)
    np.testing.assert_allclose(one.estimate.position_ned, faulty.estimate.position_ned, atol=1e-12)
    assert faulty.estimate.position_resets == 1


def test_without_aiding_the_position_drifts_is_flagged_and_jumps_back():
    state = hovering()
    estimator = Estimator("mocap", 4)
    estimator.update(1.0, state)
    estimator.set_aided(False)
    estimator.update(5.9, state)
    assert estimator.estimate.position_valid
    estimator.update(6.1, state)
    assert not estimator.estimate.position_valid
    # acceleration noise of 0.02 m/s²/√Hz for 5.1 s: position sd 0.02 √(5.1³/3) = 0.13 m
    drift = np.abs(estimator.estimate.position_ned - state[POSITION_NED]).max()
    assert 0.02 < drift < 0.6
    estimator.set_aided(True)
    estimator.update(6.2, state)
    assert estimator.estimate.position_valid
    assert np.abs(estimator.estimate.position_ned - state[POSITION_NED]).max() < 0.02


def test_a_frozen_estimate_grows_old_and_resets_are_counted():
    state = hovering()
    estimator = Estimator("perfect")
    estimator.update(0.0, state)
    estimator.set_frozen(True)
    state[POSITION_NED] = 9.0, 9.0, 9.0
    estimate = estimator.update(0.4, state)
    np.testing.assert_array_equal(estimate.position_ned, [1, 2, -3])
    assert estimate.age_s == pytest.approx(0.4)
    estimator.set_frozen(False)
    estimator.reset_position((0.5, 0.0, -0.1))
    estimator.reset_heading(0.2)
    estimator.set_position_invalid(True)
    estimate = estimator.update(0.5, state)
    np.testing.assert_allclose(estimate.position_ned, [9.5, 9.0, 8.9])
    assert 2 * math.atan2(estimate.quaternion_wxyz[3], estimate.quaternion_wxyz[0]) == pytest.approx(0.8)
    assert (estimate.position_resets, estimate.heading_resets, estimate.position_valid) == (1, 1, False)


def test_an_unknown_preset_lists_the_presets():
    with pytest.raises(VehicleError, match="choose from gps, mocap, perfect"):
        Estimator("lidar")


def test_the_generator_is_xoshiro256_plus_plus():
    """First outputs for the state 1, 2, 3, 4, as the reference implementation gives them."""
    state = np.array([1, 2, 3, 4], dtype=np.uint64)
    assert [int(next_bits(state)) for _ in range(4)] == [
        41943041,
        58720359,
        3588806011781223,
        3591011842654386,
    ]


def test_normal_numbers_are_normal():
    random = random_state(7)
    draws = np.array([standard_normal(random) for _ in range(200_000)])
    assert abs(draws.mean()) < 4 / math.sqrt(draws.size)
    assert draws.std() == pytest.approx(1.0, abs=0.007)
    assert (draws**4).mean() == pytest.approx(3.0, abs=0.1)
    assert (np.abs(draws) < 1.0).mean() == pytest.approx(0.68269, abs=0.005)
    assert random_state(7, 1).tolist() != random_state(7, 2).tolist()
    with pytest.raises(ValueError, match="must not be negative"):
        random_state(-1)


@settings(max_examples=30, deadline=None)
@given(corner=st.floats(0.05, 300.0), period=st.floats(1e-3, 0.1))
def test_the_exact_step_keeps_the_stationary_covariance(corner, period):
    """P = Φ P Φᵀ + L Lᵀ with P = I, and two steps of h are one of 2h."""
    packed = second_order_markov(corner, period)
    transition = packed[:4].reshape(2, 2)
    factor = np.array([[packed[4], 0.0], [packed[5], packed[6]]])
    np.testing.assert_allclose(transition @ transition.T + factor @ factor.T, np.eye(2), atol=1e-7)
    twice = second_order_markov(corner, 2 * period)[:4].reshape(2, 2)
    np.testing.assert_allclose(transition @ transition, twice, atol=1e-9)


def test_the_autocorrelation_is_that_of_a_critically_damped_process():
    """(1 + ω t) e^{−ω t} at lag t."""
    noise, packed, random = np.zeros(2), second_order_markov(8.0, 0.01), random_state(11)
    series = np.empty(300_000)
    for i in range(series.size):
        step_markov(noise, 0, packed, 0, random)
        series[i] = noise[0]
    for lag in (5, 20, 50):
        expected = (1 + 8.0 * lag * 0.01) * math.exp(-8.0 * lag * 0.01)
        assert np.mean(series[:-lag] * series[lag:]) == pytest.approx(expected, abs=0.04)
