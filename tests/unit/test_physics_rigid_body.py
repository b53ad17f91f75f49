"""The stub's rigid body against mechanics: conservation laws, closed forms, order of the integrator, signs by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl_stub.physics.rigid_body import advance, advance_batch
from sitl_stub.physics.vehicle import (
    BATTERY_VOLTAGE,
    BODY_RATE_FRD,
    CHARGE_USED,
    EXTERNAL_FORCE_NED,
    GRAVITY,
    INFORMATION,
    POSITION_NED,
    QUATERNION_WXYZ,
    RIGID,
    ROTOR_SIGNALS,
    ROTOR_THRUSTS,
    SPECIFIC_FORCE_FRD,
    VELOCITY_NED,
    WIND_NED,
    VehicleParameters,
    calm_environment,
    initial_state,
    load_vehicle,
    set_mass,
    set_rotor_effectiveness,
)

HIGH = (0.0, 0.0, -1000.0)
STOPPED = np.zeros(4)


def free_body(**changes):
    """QBall2 without drag or ground effect, high above the ground."""
    plain = {"linear_drag_kg_s": np.zeros(3), "angular_drag_kg_m2_s": np.zeros(3), "ground_effect": 0.0}
    vehicle = load_vehicle("qball2", **(plain | changes))
    return vehicle, initial_state(vehicle, HIGH), vehicle.packed(), calm_environment(vehicle)


def rotation(quaternion):
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@settings(max_examples=30, deadline=None)
@given(
    rate=st.tuples(*[st.floats(-8, 8)] * 3),
    quaternion=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    velocity=st.tuples(*[st.floats(-10, 10)] * 3),
)
def test_a_free_body_keeps_energy_and_angular_momentum(rate, quaternion, velocity):
    vehicle, state, p, environment = free_body(inertia_kg_m2=np.array([0.02, 0.03, 0.04]))
    state[QUATERNION_WXYZ] = np.array(quaternion) / np.linalg.norm(quaternion)
    state[BODY_RATE_FRD], state[VELOCITY_NED] = rate, velocity
    inertia = vehicle.inertia_kg_m2

    def energy():
        kinetic = 0.5 * vehicle.mass_kg * state[VELOCITY_NED] @ state[VELOCITY_NED]
        return kinetic + 0.5 * inertia @ state[BODY_RATE_FRD] ** 2 - vehicle.mass_kg * 9.81 * state[2]

    def momentum_ned():
        return rotation(state[QUATERNION_WXYZ]) @ (inertia * state[BODY_RATE_FRD])

    energy_before, momentum_before = energy(), momentum_ned()
    advance(state, STOPPED, p, environment, 1e-3, 2000)
    assert energy() == pytest.approx(energy_before, rel=1e-9)
    # the error of fourth order over 2000 steps at 8 rad/s stays far below a millionth of the spin
    np.testing.assert_allclose(momentum_ned(), momentum_before, atol=1e-7)
    assert np.linalg.norm(state[QUATERNION_WXYZ]) == pytest.approx(1.0, abs=1e-12)


def test_free_fall_is_half_g_t_squared_and_weightless():
    _, state, p, environment = free_body()
    state[VELOCITY_NED] = 3.0, -2.0, -5.0
    advance(state, STOPPED, p, environment, 1e-3, 3000)
    np.testing.assert_allclose(state[POSITION_NED], [9.0, -6.0, -1000.0 - 15.0 + 0.5 * 9.81 * 9.0], atol=1e-9)
    np.testing.assert_allclose(state[VELOCITY_NED], [3.0, -2.0, -5.0 + 9.81 * 3.0], atol=1e-9)
    np.testing.assert_allclose(state[SPECIFIC_FORCE_FRD], 0.0, atol=1e-9)


def test_the_error_falls_with_the_fourth_power_of_the_step():
    """A tumbling body with drag, thrust and rotors spinning up, against a step of 0.1 ms."""
    _vehicle, start, p, environment = free_body(
        linear_drag_kg_s=np.array([0.3, 0.4, 0.5]), angular_drag_kg_m2_s=np.array([0.01, 0.02, 0.03])
    )
    start[BODY_RATE_FRD] = 3.0, -4.0, 2.0
    start[VELOCITY_NED] = 5.0, 1.0, -2.0
    environment[WIND_NED] = -3.0, 4.0, 1.0
    commands = np.array([0.5, 0.3, 0.45, 0.35])

    def after_one_second(dt):
        state = start.copy()
        advance(state, commands, p, environment, dt, round(1.0 / dt))
        return state[RIGID]

    exact = after_one_second(1e-4)
    steps = np.array([0.02, 0.01, 0.005])
    errors = [np.abs(after_one_second(dt) - exact).max() for dt in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 3.7 < slope < 4.5
    assert np.abs(after_one_second(1e-3) - exact).max() < 1e-8


def test_it_hovers_where_thrust_equals_weight():
    for name in ("qball2", "px4_sih", "arducopter"):
        vehicle = load_vehicle(name, ground_effect=0.0)
        state, p, environment = initial_state(vehicle, HIGH), vehicle.packed(), calm_environment(vehicle)
        commands = np.full(4, vehicle.hover_command)
        state[ROTOR_SIGNALS][:4] = commands
        advance(state, commands, p, environment, 1e-3, 10000)
        np.testing.assert_allclose(state[POSITION_NED], HIGH, atol=1e-9)
        assert state[ROTOR_THRUSTS].sum() == pytest.approx(vehicle.mass_kg * vehicle.gravity_m_s2)


def test_hover_throttles_are_those_of_the_captures():
    assert load_vehicle("px4_sih").hover_command == pytest.approx(0.5, abs=0.001)  # capture's README
    copter = load_vehicle("arducopter")
    assert copter.mass_kg * copter.gravity_m_s2 / copter.max_thrust_newton.sum() == pytest.approx(
        0.369, abs=0.001
    )
    assert load_vehicle("qball2").hover_command == pytest.approx(1.79 * 9.81 / 48.0)


def test_terminal_velocity_is_weight_over_drag():
    _vehicle, state, p, environment = free_body(linear_drag_kg_s=np.array([0.0, 0.0, 2.0]))
    environment[WIND_NED] = 0.0, 0.0, -1.5
    state[2] = -1e5
    advance(state, STOPPED, p, environment, 1e-3, 20000)
    assert state[5] == pytest.approx(1.79 * 9.81 / 2.0 - 1.5, rel=1e-6)


def test_drag_decays_speed_exponentially_towards_the_wind():
    _, state, p, environment = free_body(linear_drag_kg_s=np.full(3, 0.5), gravity_m_s2=1e-12)
    environment[WIND_NED] = 2.0, -1.0, 0.0
    state[VELOCITY_NED] = 10.0, 0.0, 0.0
    advance(state, STOPPED, p, environment, 1e-3, 1500)
    expected = np.array([2.0, -1.0]) + np.array([8.0, 1.0]) * math.exp(-0.5 / 1.79 * 1.5)
    np.testing.assert_allclose(state[VELOCITY_NED][:2], expected, atol=1e-10)


@pytest.mark.parametrize("command", [0.2, 1.0])
def test_the_rotor_lag_is_first_order(command):
    vehicle, state, p, environment = free_body()
    commands = np.array([command, 0.0, 0.0, 0.0])
    for milliseconds in (20, 40, 100, 200):
        state = initial_state(vehicle, HIGH)
        advance(state, commands, p, environment, 1e-3, milliseconds)
        expected = 12.0 * command * (1.0 - math.exp(-15.0 * milliseconds * 1e-3))
        assert state[ROTOR_THRUSTS][0] == pytest.approx(expected, rel=1e-12)
        assert (state[ROTOR_THRUSTS][1:] == 0.0).all()


@pytest.mark.parametrize("command", [-0.5, math.nan, -math.inf])
def test_a_command_below_zero_or_no_number_stops_the_rotor(command):
    _, state, p, environment = free_body()
    advance(state, np.array([command, 5.0, math.inf, 1.0]), p, environment, 1e-3, 2000)
    np.testing.assert_allclose(state[ROTOR_THRUSTS][:4], [0.0, 12.0, 12.0, 12.0], rtol=1e-9)
    assert np.isfinite(state[RIGID]).all()


def test_the_thrust_curve_is_the_autopilots():
    """THR_MDL_FAC 0.6 at signal 0.5: 0.4 · 0.5 + 0.6 · 0.25 = 0.35 of 12 N."""
    _, state, p, environment = free_body(thrust_curve=0.6)
    advance(state, np.full(4, 0.5), p, environment, 1e-3, 5000)
    np.testing.assert_allclose(state[ROTOR_THRUSTS][:4], 0.35 * 12.0)


# By hand, FRD (x forward, y right, z down): lift at the front tips the nose up (+pitch), at the right the right side up
# (−roll), at the rear −pitch, at the left +roll. A propeller anticlockwise from above turns the body clockwise, +yaw.
PLUS = {0: (0, +1, +1), 1: (-1, 0, -1), 2: (0, -1, +1), 3: (+1, 0, -1)}
PX4_X = {0: (-1, +1, +1), 1: (+1, -1, +1), 2: (+1, +1, -1), 3: (-1, -1, -1)}
ARDUPILOT_PLUS = {0: (-1, 0, +1), 1: (+1, 0, +1), 2: (0, +1, -1), 3: (0, -1, -1)}
HAND = [("qball2", PLUS), ("px4_sih", PX4_X), ("arducopter", ARDUPILOT_PLUS)]


@pytest.mark.parametrize(
    ("name", "rotor", "signs"),
    [(name, rotor, signs) for name, table in HAND for rotor, signs in table.items()],
)
def test_each_rotor_turns_the_body_the_way_worked_out_by_hand(name, rotor, signs):
    vehicle = load_vehicle(name, ground_effect=0.0)
    state, p, environment = initial_state(vehicle, HIGH), vehicle.packed(), calm_environment(vehicle)
    commands = np.zeros(4)
    commands[rotor] = 0.5
    advance(state, commands, p, environment, 1e-4, 10)
    rate = state[BODY_RATE_FRD]
    assert np.abs(rate).max() > 1e-5
    np.testing.assert_array_equal(np.sign(np.where(np.abs(rate) > 1e-8, rate, 0.0)), signs)


def test_torques_are_those_of_the_allocation_matrix():
    """Initial angular acceleration · inertia = B T, with B of the control laws turned into FRD by hand."""
    vehicle, state, p, environment = free_body(rotor_lag_rad_s=0.0)
    command = np.array([0.9, 0.1, 0.3, 0.6])
    state[ROTOR_SIGNALS][:4] = command
    dt = 1e-6
    advance(state, command, p, environment, dt, 1)
    t1, t2, t3, t4 = 12.0 * command
    torque = np.array([0.2 * (t4 - t2), 0.2 * (t1 - t3), (t1 - t2 + t3 - t4) / 30.0])
    np.testing.assert_allclose(state[BODY_RATE_FRD] / dt * [0.03, 0.03, 0.04], torque, rtol=1e-5)
    np.testing.assert_allclose(vehicle.allocation_frd() @ (12.0 * command), [t1 + t2 + t3 + t4, *torque])
    np.testing.assert_allclose(state[SPECIFIC_FORCE_FRD], [0, 0, -(t1 + t2 + t3 + t4) / 1.79], atol=1e-4)


def test_a_tilted_thrust_pulls_to_the_side_it_leans():
    """Rolled right by 0.3 rad the lift pulls east; pitched up it pulls south (NED)."""
    for axis, (north, east) in {1: (0, 1), 2: (-1, 0)}.items():
        _, state, p, environment = free_body()
        state[QUATERNION_WXYZ] = [math.cos(0.15), 0.0, 0.0, 0.0]
        state[QUATERNION_WXYZ][axis] = math.sin(0.15)
        commands = np.full(4, 0.4)
        state[ROTOR_SIGNALS][:4] = commands
        advance(state, commands, p, environment, 1e-3, 100)
        pull = 4 * 0.4 * 12.0 / 1.79 * math.sin(0.3) * 0.1
        np.testing.assert_allclose(state[VELOCITY_NED][:2], [north * pull, east * pull], atol=1e-9)


def test_rotor_drag_brakes_in_the_rotor_plane_only():
    vehicle, state, p, environment = free_body(rotor_drag_kg_s=0.05)
    command = np.full(4, vehicle.hover_command)
    state[ROTOR_SIGNALS][:4] = command
    state[VELOCITY_NED] = 4.0, 0.0, 0.0
    advance(state, command, p, environment, 1e-3, 500)
    # four rotors at the hover fraction f each brake with 0.05 √f; the hubs are level with the centre of mass: no torque
    rate = 4 * 0.05 * math.sqrt(vehicle.hover_command) / 1.79
    np.testing.assert_allclose(state[VELOCITY_NED], [4.0 * math.exp(-rate * 0.5), 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(state[BODY_RATE_FRD], 0.0, atol=1e-12)


def test_ground_effect_lifts_near_the_ground_only():
    """Cheeseman–Bennett at h = R: 1 / (1 − 1/16) = 1.0667."""
    vehicle, _, p, environment = free_body(ground_effect=1.0)
    command = np.full(4, vehicle.hover_command)
    gains = []
    for height in (0.127, 100.0):
        environment[9] = height
        state = initial_state(vehicle)
        state[ROTOR_SIGNALS][:4] = command
        p[-24:] *= 0.0  # no corners: only the air is asked here
        advance(state, command, p, environment, 1e-6, 1)
        gains.append(-state[SPECIFIC_FORCE_FRD][2] / 9.81)
    assert gains[0] == pytest.approx(16.0 / 15.0, rel=1e-4)
    assert gains[1] == pytest.approx(1.0, rel=1e-4)


def test_a_dropped_payload_makes_it_rise_and_a_dead_rotor_makes_it_tip():
    vehicle, state, p, environment = free_body()
    command = np.full(4, vehicle.hover_command)
    state[ROTOR_SIGNALS][:4] = command
    set_mass(p, 1.79 * 0.8, vehicle.inertia_kg_m2 * 0.9)
    advance(state, command, p, environment, 1e-3, 1000)
    assert state[5] == pytest.approx(-9.81 * (1 / 0.8 - 1), rel=1e-9)
    set_rotor_effectiveness(p, 0, 0.0)
    advance(state, command, p, environment, 1e-3, 100)
    assert state[BODY_RATE_FRD][1] < -1.0  # front rotor dead: nose drops
    assert state[ROTOR_THRUSTS][0] == 0.0


def test_the_battery_empties_by_the_current_it_gives_and_takes_thrust_with_it():
    vehicle, state, p, environment = free_body(battery_sag=True)
    command = np.full(4, 0.5)
    state[ROTOR_SIGNALS][:4] = command
    advance(state, command, p, environment, 1e-3, 10)
    early = state[ROTOR_THRUSTS][0]
    voltage, current = (
        state[BATTERY_VOLTAGE],
        vehicle.idle_current_a + 4 * 8.0 * early**1.5 / state[BATTERY_VOLTAGE],
    )
    assert state[BATTERY_VOLTAGE] == pytest.approx(12.6 - 0.012 * current, abs=0.02)
    assert early == pytest.approx(6.0 * (voltage / 12.6) ** 2, rel=1e-3)
    advance(state, command, p, environment, 1e-3, 100_000)
    assert state[CHARGE_USED] == pytest.approx(current * 100.0, rel=0.05)
    assert state[ROTOR_THRUSTS][0] < 0.97 * early
    p[22] = 0.0  # BATTERY_SAG off
    advance(state, command, p, environment, 1e-3, 1)
    assert state[ROTOR_THRUSTS][0] == pytest.approx(6.0)


def test_external_force_accelerates_by_its_mass_and_gravity_is_a_parameter():
    _, state, p, environment = free_body()
    p[GRAVITY] = 1.62
    environment[EXTERNAL_FORCE_NED] = 1.79, -3.58, 0.0
    advance(state, STOPPED, p, environment, 1e-3, 1000)
    np.testing.assert_allclose(state[VELOCITY_NED], [1.0, -2.0, 1.62], atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(cuts=st.lists(st.integers(1, 40), min_size=1, max_size=6), seed=st.integers(0, 1000))
def test_how_the_steps_are_cut_up_changes_no_bit(cuts, seed):
    generator = np.random.default_rng(seed)
    vehicle = load_vehicle("px4_sih")
    p, environment = vehicle.packed(), calm_environment(vehicle)
    whole = initial_state(vehicle, (0.0, 0.0, -0.02))
    commands = generator.uniform(0, 1, 4)
    whole[BODY_RATE_FRD] = generator.normal(size=3)
    pieces = whole.copy()
    advance(whole, commands, p, environment, 1e-3, sum(cuts))
    for cut in cuts:
        advance(pieces, commands, p, environment, 1e-3, cut)
    np.testing.assert_array_equal(whole[INFORMATION], pieces[INFORMATION])


def test_a_batch_ends_where_single_vehicles_end():
    vehicle = load_vehicle("qball2")
    generator = np.random.default_rng(5)
    states = np.stack([initial_state(vehicle, (0.0, 0.0, -2.0 * (i % 3))) for i in range(12)])
    commands = generator.uniform(0, 1, (12, 4))
    parameters = np.stack([vehicle.packed()] * 12)
    environments = np.stack([calm_environment(vehicle)] * 12)
    alone = states.copy()
    advance_batch(states, commands, parameters, environments, 1e-3, 300)
    for row in range(12):
        advance(alone[row], commands[row], parameters[row], environments[row], 1e-3, 300)
    np.testing.assert_array_equal(states[:, INFORMATION], alone[:, INFORMATION])


def test_plain_python_gives_the_compiled_result():
    """The step's own arithmetic, uncompiled (what it calls stays compiled), agrees to the last digits."""
    from sitl_stub.physics import rigid_body

    _, state, p, environment = free_body(rotor_drag_kg_s=0.03, ground_effect=1.0)
    state[BODY_RATE_FRD] = 1.0, 2.0, 3.0
    state[VELOCITY_NED] = 1.0, 2.0, 3.0
    twin = state.copy()
    rigid_body.turn_rotors(state, np.full(4, 0.6), p, 0.99, 0.98)
    rigid_body.turn_rotors.py_func(twin, np.full(4, 0.6), p, 0.99, 0.98)
    rigid_body.rigid_slope(state, p, environment, 0, rigid_body.THRUST_MIDDLE)
    rigid_body.rigid_slope.py_func(twin, p, environment, 0, rigid_body.THRUST_MIDDLE)
    np.testing.assert_allclose(state, twin, rtol=1e-12, atol=1e-15)


def test_vehicle_dataclass_is_what_the_file_says():
    vehicle = load_vehicle("qball2")
    assert isinstance(vehicle, VehicleParameters)
    assert vehicle.rotor_count == 4
    assert vehicle.mass_kg == 1.79
