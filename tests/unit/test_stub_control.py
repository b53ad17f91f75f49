"""The stub's controllers against formulas written a second way, and the mixer against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.attitude_control import attitude_to_rates, filter_gyro, rates_to_torque
from sitl_stub.firmware.px4.mixing import full_torque_newton_metre, mix, mixer_matrix, transposed
from sitl_stub.firmware.px4.parameters import fitted_parameters
from sitl_stub.firmware.px4.position_control import trajectory_to_attitude
from sitl_stub.physics.vehicle import load_vehicle
from sitl_stub.simulation import Simulation

SQRT_HALF = math.sqrt(0.5)
angle = st.floats(-1.2, 1.2)
GAINS = at.gains_from_parameters(fitted_parameters(load_vehicle("px4_sih")), np.ones(3))


def _wxyz(rotation: Rotation) -> np.ndarray:
    x, y, z, w = rotation.as_quat()
    return np.array([w, x, y, z])


@given(angle, angle, st.floats(-3, 3), angle, angle, st.floats(-3, 3))
def test_attitude_law_is_reduced_attitude_with_weighted_yaw(
    r0: float, p0: float, y0: float, r1: float, p1: float, y1: float
) -> None:
    """Rates = P · 2 · vec(q⁻¹ q_wanted), q_wanted from scipy: the shortest tilt, then 0.4 of the yaw left."""
    now, target = Rotation.from_euler("ZYX", [y0, p0, r0]), Rotation.from_euler("ZYX", [y1, p1, r1])
    z_now, z_target = now.apply([0, 0, 1]), target.apply([0, 0, 1])
    cosine = float(np.clip(z_now @ z_target, -1, 1))
    assume(-0.99 < cosine < 1 - 1e-9)
    axis = np.cross(z_now, z_target)
    tilt = Rotation.from_rotvec(axis / np.linalg.norm(axis) * math.acos(cosine)) * now
    left = (tilt.inv() * target).as_rotvec()
    assume(abs(left[2]) < 3.1)
    wanted = tilt * Rotation.from_rotvec([0, 0, 0.4 * left[2]])
    error = (now.inv() * wanted).as_quat()
    error = 2 * error[:3] * (1 if error[3] >= 0 else -1)
    expected = np.clip(
        np.array([4.0, 4.0, 2.8 / 0.4]) * error, -np.radians([220, 220, 200]), np.radians([220, 220, 200])
    )
    memory = np.zeros(at.MEMORY_SIZE)
    attitude_to_rates(_wxyz(now), _wxyz(target), 0.0, GAINS, memory)
    np.testing.assert_allclose(memory[at.OUT_RATES : at.OUT_RATES + 3], expected, atol=1e-6)


def test_yaw_rate_is_fed_forward_about_the_world_axis() -> None:
    q = _wxyz(Rotation.from_euler("ZYX", [0.7, 0.4, -0.3]))
    memory = np.zeros(at.MEMORY_SIZE)
    attitude_to_rates(q, q, 0.5, GAINS, memory)
    expected = Rotation.from_euler("ZYX", [0.7, 0.4, -0.3]).inv().apply([0, 0, 0.5])
    np.testing.assert_allclose(memory[at.OUT_RATES : at.OUT_RATES + 3], expected, atol=1e-12)


def test_mixers_by_hand() -> None:
    x_frame = mixer_matrix(load_vehicle("px4_sih"))
    # front right, rear left, front left, rear right: rolling right needs the left rotors
    np.testing.assert_allclose(x_frame[:, 0] / SQRT_HALF, [-1, 1, 1, -1], atol=1e-12)
    np.testing.assert_allclose(x_frame[:, 1] / SQRT_HALF, [1, -1, 1, -1], atol=1e-12)
    np.testing.assert_allclose(x_frame[:, 2], [1, 1, -1, -1], atol=1e-12)
    np.testing.assert_allclose(x_frame[:, 3], 1, atol=1e-12)
    plus = load_vehicle("qball2")  # front, right, rear, left
    np.testing.assert_allclose(mixer_matrix(plus)[:, 0] / SQRT_HALF, [0, -1, 0, 1], atol=1e-12)
    old = mixer_matrix(plus, count_all_rotors=True)
    np.testing.assert_allclose(old[:, 0], [0, -1, 0, 1], atol=1e-12)
    np.testing.assert_allclose(old[:, 1], [1, 0, -1, 0], atol=1e-12)
    # 1.13, plus frame: two rotors of 12 N at 0.2 m; yaw: four of 0.4 N·m
    np.testing.assert_allclose(full_torque_newton_metre(plus, old), [4.8, 4.8, 1.6], rtol=1e-12)
    # SIH: 4 · 0.1414 m · 8.78 N / √2 and 4 · 0.3 N·m
    expected = [4 * 0.1414 * 8.78 * SQRT_HALF] * 2 + [1.2]
    np.testing.assert_allclose(
        full_torque_newton_metre(load_vehicle("px4_sih"), x_frame), expected, rtol=1e-9
    )


def _mixed(roll: float, pitch: float, yaw: float, thrust: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    mixer = mixer_matrix(load_vehicle("px4_sih"))
    motors, wanted, high, low = np.zeros(8), np.zeros(8), np.zeros(3), np.zeros(3)
    mix(roll, pitch, yaw, thrust, mixer, transposed(mixer), motors, wanted, high, low)
    return motors[:4], high, low


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 1))
def test_motors_stay_in_range_and_never_lift_more_than_asked(
    roll: float, pitch: float, yaw: float, thrust: float
) -> None:
    motors, _, _ = _mixed(roll, pitch, yaw, thrust)
    assert (motors >= 0).all() and (motors <= 1).all()
    # no airmode: thrust may be given up for torque, never added (clipping at the end can move it a little)
    assert motors.mean() <= thrust + 0.08


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(0.35, 0.65))
def test_unsaturated_mix_is_the_matrix(roll: float, pitch: float, yaw: float, thrust: float) -> None:
    motors, high, low = _mixed(roll, pitch, yaw, thrust)
    expected = mixer_matrix(load_vehicle("px4_sih")) @ [roll, pitch, yaw, thrust]
    np.testing.assert_allclose(motors, expected, atol=1e-12)
    assert not high.any() and not low.any()


def test_yaw_gives_way_before_roll() -> None:
    motors, high, low = _mixed(0.5, 0.0, 0.5, 0.4)
    mixer = mixer_matrix(load_vehicle("px4_sih"))
    np.testing.assert_allclose(
        mixer[:, 0] @ motors / 2.0, 0.5, atol=0.02
    )  # columns: Σ m² = 2 for roll, 4 for yaw
    given_yaw = mixer[:, 2] @ motors / 4.0
    assert 0.0 <= given_yaw < 0.4
    assert high[2] == 1.0 and low[2] == 0.0


def test_gyro_filter_passes_slow_and_stops_fast_signals() -> None:
    dt = 0.002
    for frequency, low, high in ((1.0, 0.97, 1.03), (40.0, 0.6, 0.8), (160.0, 0.0, 0.08)):
        memory = np.zeros(at.MEMORY_SIZE)
        out = []
        for k in range(2000):
            filter_gyro(np.array([math.sin(2 * math.pi * frequency * k * dt), 0, 0]), GAINS, memory, dt)
            out.append(memory[at.RATE_FILTERED])
        assert low <= max(out[1000:]) <= high  # second-order Butterworth: 0.707 at its corner


def test_rate_integrator_is_bounded_and_stops_in_saturation() -> None:
    memory = np.zeros(at.MEMORY_SIZE)
    memory[at.OUT_RATES] = 1.0
    for _ in range(10_000):
        rates_to_torque(GAINS, memory, 0.002, True)
    assert memory[at.RATE_INTEGRAL] == pytest.approx(0.3)  # MC_RR_INT_LIM
    memory[at.RATE_INTEGRAL], memory[at.SATURATED_HIGH] = 0.0, 1.0
    rates_to_torque(GAINS, memory, 0.002, True)
    assert memory[at.RATE_INTEGRAL] == 0.0


def test_position_controller_at_rest_asks_for_hover_and_leans_towards_its_target() -> None:
    setpoint, memory = np.full(at.SETPOINT_SIZE, np.nan), np.zeros(at.MEMORY_SIZE)
    setpoint[at.POSITION : at.POSITION + 3] = (0.0, 0.0, -5.0)
    setpoint[at.YAW] = 0.3
    trajectory_to_attitude(np.array([0.0, 0.0, -5.0]), np.zeros(3), 0.0, setpoint, GAINS, memory, 0.01)
    assert memory[at.OUT_THRUST] == pytest.approx(0.5)  # MPC_THR_HOVER
    np.testing.assert_allclose(memory[31:35], [math.cos(0.15), 0, 0, math.sin(0.15)], atol=1e-12)
    # 1 m north of the vehicle: velocity setpoint 0.95 m/s, acceleration 1.8 · 0.95, tilt atan(a/g), nose down
    setpoint[at.POSITION], setpoint[at.YAW] = 1.0, 0.0
    memory[:] = 0.0
    trajectory_to_attitude(np.array([0.0, 0.0, -5.0]), np.zeros(3), 0.0, setpoint, GAINS, memory, 0.01)
    pitch = 2 * math.asin(memory[at.OUT_QUATERNION + 2])
    assert pitch == pytest.approx(-math.atan(1.8 * 0.95 / 9.80665), rel=1e-6)


def test_simulation_repeats_to_the_bit_and_seeds_differ() -> None:
    def flown(seed: int) -> np.ndarray:
        simulation = Simulation(seed=seed)
        simulation.hover_at((1.0, 2.0, -3.0), yaw_rad=0.5)
        q = np.array([math.cos(0.1), math.sin(0.1), 0.0, 0.0])
        simulation.set_attitude_target(q, simulation.vehicle.hover_command)
        simulation.advance(0.5)
        return np.concatenate([simulation.truth.position_ned, simulation.estimate.position_ned])

    assert (flown(4) == flown(4)).all()
    assert (flown(4) != flown(5)).any()


def test_simulation_levels_reach_what_they_are_asked() -> None:
    simulation = Simulation(firmware="px4-1.13", estimator="perfect")
    simulation.hover_at((0, 0, -50.0))
    hover = simulation.vehicle.hover_command
    simulation.set_body_rates(np.array([0.4, 0.0, 0.0]), hover)
    simulation.advance(0.6)
    assert simulation.truth.body_rate_frd[0] == pytest.approx(0.4, abs=0.06)
    simulation.hover_at((0, 0, -50.0))
    simulation.set_actuators(np.array([0.0, 0.0, 0.1, hover]))
    simulation.advance(0.5)
    # yaw torque 0.1 · 1.6 N·m on 0.04 kg·m² through a lag of 1/15 s: 4 rad/s² · (t − τ (1 − e^(−t/τ)))
    tau = 1 / 15
    expected = 0.1 * 1.6 / 0.04 * (0.5 - tau * (1 - math.exp(-0.5 / tau)))
    assert simulation.truth.body_rate_frd[2] == pytest.approx(expected, rel=0.03)  # drag takes 2 %


@pytest.mark.parametrize("vehicle", ["qball2", "px4_sih"])
def test_step_responses_are_alike_whatever_the_vehicle(vehicle: str) -> None:
    """Capture: roll to 63 % in 0.253 s after the client's setpoint, peak 0.98 of it in 0.8 s."""
    simulation = Simulation(vehicle=vehicle, estimator="perfect")
    simulation.hover_at((0, 0, -50.0))
    simulation.set_attitude_target(
        np.array([math.cos(0.1), math.sin(0.1), 0, 0]), simulation.vehicle.hover_command
    )
    rolls = []
    for _ in range(400):
        simulation.advance(0.002)
        rolls.append(2 * math.asin(simulation.truth.quaternion_wxyz[1]) / 0.2)
    assert np.argmax(np.array(rolls) > 0.63) * 0.002 == pytest.approx(0.25, rel=0.1)
    assert max(rolls) == pytest.approx(0.98, abs=0.04)
