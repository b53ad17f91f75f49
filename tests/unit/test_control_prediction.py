"""The predictor against the test plant, which is integrated apart from it."""

import math

import numpy as np
import pytest
from control_cases import QBALL2
from control_plant import GRAVITY, Plant, matrix_of, quaternion_of, rotation_zyx

from companion.control.prediction import RING, Predictor
from companion.control.structs import ControlLevel, Setpoint, VehicleState

LEVELS = list(ControlLevel)


def profile(dead_time, estimator=0.0):
    response = QBALL2.response().model_copy(
        update=dict.fromkeys(
            ("dead_time_s", "rate_dead_time_s", "actuator_dead_time_s", "thrust_dead_time_s"), dead_time
        )
    )
    return QBALL2.model_copy(
        update={"responses": {"px4": response}, "estimator_delay_s": estimator, "mass_ratio": 1.0}
    )


def wild_setpoint(rng, level, t):
    attitude = quaternion_of(rotation_zyx(0.3 * math.sin(3 * t), 0.25 * math.cos(2 * t), 0.5 * t))
    rates = np.array([0.8 * math.sin(5 * t), 0.6 * math.cos(4 * t), 0.4])
    return Setpoint(level, 1.79 * GRAVITY + 3 * math.sin(4 * t), attitude, rates, rng.normal(0, 0.02, 3))


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("dead_time", [0.05, 0.12])
def test_prediction_is_where_the_vehicle_gets_to(level, dead_time):
    rng = np.random.default_rng(0)
    predictor = Predictor(profile(dead_time), level)
    response = QBALL2.response()
    plant = Plant(
        level=level.value,
        rotor_lag_rad_s=QBALL2.rotors.lag_rad_s,
        dead_time_s=dead_time,
        frequency_rad_s=response.tilt.natural_frequency_rad_s,
        damping=response.tilt.damping,
        yaw_frequency_rad_s=response.yaw.natural_frequency_rad_s,
        rate_lag_s=response.rate_lag_s,
        drag=np.zeros(3),
        rotational_drag=np.zeros(3),
    )
    predictor._mass = plant.mass  # what has been carried, settled
    guesses, straight, truths = {}, {}, {}
    for k in range(200):
        state = plant.state()
        truths[k] = state
        if k > 20:
            ahead = predictor.predict(state)
            assert ahead.time_s == pytest.approx(state.time_s + dead_time)
            guesses[k + round(dead_time * 100)] = ahead
            straight[k + round(dead_time * 100)] = state.position_enu + dead_time * state.velocity_enu
        setpoint = wild_setpoint(rng, level, plant.time)
        plant.command(setpoint)
        predictor.sent(plant.time, setpoint)
        predictor._mass = plant.mass
        plant.advance(0.01)
    gaps, lazy = [], []
    for k, guess in guesses.items():
        if k not in truths:
            continue
        truth = truths[k]
        gaps.append(np.linalg.norm(guess.position_enu - truth.position_enu))
        lazy.append(np.linalg.norm(straight[k] - truth.position_enu))
        turn = matrix_of(guess.quaternion_wxyz).T @ matrix_of(truth.quaternion_wxyz)
        angle = math.acos(min(1.0, (np.trace(turn) - 1) / 2))
        assert angle < math.radians(0.6 if level is not ControlLevel.ATTITUDE else 2.0)
        np.testing.assert_allclose(guess.velocity_enu, truth.velocity_enu, atol=0.02)
    assert max(gaps) < 0.1 * max(lazy)


def test_old_estimates_are_brought_up_to_date():
    """An estimate that is 30 ms old: the vehicle flew on at 2 m/s."""
    predictor = Predictor(profile(0.02, estimator=0.03), ControlLevel.ATTITUDE)
    level = np.array([1.0, 0, 0, 0])
    for k in range(100):
        predictor.sent(
            0.01 * k, Setpoint(ControlLevel.ATTITUDE, 1.79 * GRAVITY, level, np.zeros(3), np.zeros(3))
        )
    state = VehicleState(1.0, np.zeros(3), np.array([2.0, 0, 0]), level, np.zeros(3))
    ahead = predictor.predict(state)
    assert predictor.delay_s == pytest.approx(0.05)
    assert ahead.time_s == pytest.approx(1.02)
    np.testing.assert_allclose(ahead.position_enu, [0.1, 0, 0], atol=1e-6)


def test_carried_mass_is_found_not_told():
    """Thrust commands that carry 2.4 kg for 5 s, on a profile that says 1.79 kg and a law told 70 % of it."""
    predictor = Predictor(QBALL2, ControlLevel.ATTITUDE)
    level = np.array([1.0, 0, 0, 0])
    assert predictor.mass_kg == pytest.approx(1.253)
    for k in range(500):
        predictor.sent(0.01 * k, Setpoint(ControlLevel.ATTITUDE, 2.4 * 9.81, level, np.zeros(3), np.zeros(3)))
    assert predictor.mass_kg == pytest.approx(2.4, rel=0.01)
    for k in range(500, 1000):  # idle after landing carries nothing and is not believed
        predictor.sent(0.01 * k, Setpoint(ControlLevel.ATTITUDE, 0.5, level, np.zeros(3), np.zeros(3)))
    assert predictor.mass_kg == pytest.approx(2.4, rel=0.01)


def test_a_clock_that_steps_back_does_no_harm():
    predictor = Predictor(QBALL2, ControlLevel.ATTITUDE)
    level = np.array([1.0, 0, 0, 0])
    hover = Setpoint(ControlLevel.ATTITUDE, 1.253 * 9.81, level, np.zeros(3), np.zeros(3))
    for time_s in [*np.arange(0, 3 * RING) * 0.01, 0.5, 0.5, 0.51, -1.0, 2.0]:
        predictor.sent(float(time_s), hover)
        ahead = predictor.predict(VehicleState(float(time_s), np.zeros(3), np.zeros(3), level, np.zeros(3)))
        assert np.isfinite(ahead.position_enu).all()
        assert np.abs(ahead.position_enu).max() < 0.01
        assert np.linalg.norm(ahead.quaternion_wxyz) == pytest.approx(1.0)


def test_without_delay_a_state_is_left_alone():
    predictor = Predictor(profile(0.0), ControlLevel.ATTITUDE)
    state = Plant().state()
    assert predictor.predict(state) is state


def test_without_setpoints_the_vehicle_flies_straight_on():
    predictor = Predictor(QBALL2, ControlLevel.ATTITUDE)
    state = VehicleState(5.0, np.zeros(3), np.array([1.0, 0, 0]), np.array([1.0, 0, 0, 0]), np.zeros(3))
    ahead = predictor.predict(state)
    np.testing.assert_allclose(ahead.position_enu, [predictor.delay_s, 0, 0])
    assert ahead.time_s == pytest.approx(5.0 + predictor.ahead_s)


def test_a_free_spin_keeps_its_angular_momentum():
    """No torque, three different inertias, fast rates: R I ω in the world stays, the gyroscopic term with its sign."""
    inertia = np.array([0.03, 0.05, 0.08])
    predictor = Predictor(
        profile(0.1).model_copy(update={"inertia_kg_m2": tuple(inertia)}), ControlLevel.ACTUATOR
    )
    level = np.array([1.0, 0, 0, 0])
    for k in range(20):
        predictor.sent(
            0.01 * k, Setpoint(ControlLevel.ACTUATOR, 1.79 * GRAVITY, level, np.zeros(3), np.zeros(3))
        )
    rate = np.array([2.0, 3.0, -1.5])
    ahead = predictor.predict(VehicleState(0.2, np.zeros(3), np.zeros(3), level, rate))
    before, after = inertia * rate, inertia * ahead.body_rate_flu
    assert np.linalg.norm(after - before) > 0.1 * np.linalg.norm(before)  # in the body it turns
    np.testing.assert_allclose(
        matrix_of(ahead.quaternion_wxyz) @ after, before, atol=0.01 * np.linalg.norm(before)
    )


def test_only_the_newest_setpoints_are_remembered_however_many_there_were():
    """2,000 setpoints, 20 seconds: the prediction is that of a predictor that was given the last RING of them alone."""
    long, short = (
        Predictor(profile(0.05), ControlLevel.ATTITUDE),
        Predictor(profile(0.05), ControlLevel.ATTITUDE),
    )
    rng = np.random.default_rng(3)
    for k in range(2000):
        setpoint = wild_setpoint(rng, ControlLevel.ATTITUDE, 0.01 * k)
        long.sent(0.01 * k, setpoint)
        if k >= 2000 - RING:
            short.sent(0.01 * k, setpoint)
        if k % 97 == 0 and k > 2 * RING:  # at every place in the rows
            assert np.all(np.diff(long._ring[:, 0]) > 0.0)
    short._mass = long._mass
    state = VehicleState(19.99, np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))
    ours, theirs = long.predict(state), short.predict(state)
    assert ours.position_enu.tolist() == theirs.position_enu.tolist()
    assert ours.quaternion_wxyz.tolist() == theirs.quaternion_wxyz.tolist()


@pytest.mark.parametrize("thrust_dead", [0.0, 0.01, 0.07, 0.1])
def test_thrust_acts_after_a_dead_time_of_its_own(thrust_dead):
    """Hover, then 1.3 times its thrust from t = 0 on: v = 0.3 g (τ − (1 − e^(−15 τ)) / 15), τ since it acts, by hand.

    The attitude's dead time is 0.07 s: with it for the thrust too, 10 ms become 70 and vz is 0.1 m/s behind. Beyond what
    is decided at 0.15 s the thrust goes to the mean of the last 0.25 s: 10 setpoints of the weight and 15 of 1.3 times it.
    """
    responses = {"px4": QBALL2.response().model_copy(update={"thrust_dead_time_s": thrust_dead})}
    predictor = Predictor(
        QBALL2.model_copy(update={"responses": responses, "estimator_delay_s": 0.0}), ControlLevel.ATTITUDE
    )
    level, still = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    weight = QBALL2.mass_kg * GRAVITY

    def speed_up(time_s):
        tau = max(0.0, time_s - thrust_dead)
        return 0.3 * GRAVITY * (tau - (1.0 - math.exp(-15.0 * tau)) / 15.0)

    for k in range(-50, 15):
        thrust = 1.3 * weight if k >= 0 else weight
        predictor.sent(0.01 * k, Setpoint(ControlLevel.ATTITUDE, thrust, level, still, still))
    predictor._mass = QBALL2.mass_kg
    now = VehicleState(0.15, still, np.array([0.0, 0.0, speed_up(0.15)]), level, still)
    ahead = predictor.predict(now)
    assert ahead.time_s == pytest.approx(0.22)
    decided = min(0.22, 0.15 + thrust_dead)
    usual, acting = 0.3 * 15 / 25, 0.3 * (1.0 - math.exp(-15.0 * max(0.0, decided - thrust_dead)))
    rest = usual * (0.22 - decided) + (acting - usual) * (1.0 - math.exp(-15.0 * (0.22 - decided))) / 15.0
    assert ahead.velocity_enu[2] == pytest.approx(speed_up(decided) + GRAVITY * rest, abs=0.003)


def test_a_thrust_that_swings_is_not_held_against_the_law():
    """Thrust that alternates about the weight at every step, as a law makes it that answers its own answer: with 0.14 s of
    dead time, 0.13 of them after the thrust, what is predicted hardly depends on which of the two came last."""
    slow = QBALL2.response().model_copy(update={"dead_time_s": 0.14})
    level, still = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    found = []
    for count in (60, 61):
        predictor = Predictor(
            QBALL2.model_copy(update={"responses": {"px4": slow}}), ControlLevel.ATTITUDE, "px4"
        )
        for k in range(count):
            thrust = QBALL2.mass_kg * GRAVITY * (1.3 if k % 2 else 0.7)
            predictor.sent(0.01 * k, Setpoint(ControlLevel.ATTITUDE, thrust, level, still, still))
        predictor._mass = QBALL2.mass_kg
        found.append(
            predictor.predict(VehicleState(0.01 * count, still, still, level, still)).velocity_enu[2]
        )
    assert abs(found[0] - found[1]) < 0.03  # held, it was 0.46 m/s
