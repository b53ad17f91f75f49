"""No law cares which way the nose points: no jump where the yaw crosses ±180°, and the same flight in every heading."""

import math

import numpy as np
import pytest
from control_cases import LAW_NAMES, LEVELS, QBALL2, law_of, random_memory
from control_plant import Plant, lemniscate, quaternion_of, rotation_zyx

from companion.control.prediction import Predictor
from companion.control.structs import AdaptationGate, ControlLevel, Reference, VehicleState

RUN = AdaptationGate.RUN
HEADINGS = np.radians([0.0, 45.0, 90.0, 135.0, 180.0, -135.0, -90.0, -45.0])


def facing(yaw, roll=0.1, pitch=-0.05):
    quaternion = quaternion_of(rotation_zyx(roll, pitch, yaw))
    return VehicleState(0.0, np.array([0.1, -0.2, 1.0]), np.array([0.3, 0.2, -0.1]), quaternion, np.zeros(3))


def wanted(yaw):
    still = np.zeros(3)
    return Reference(np.array([0.2, -0.1, 1.1]), still, still, still, still, yaw, 0.0, 0.0)


@pytest.mark.parametrize("name", LAW_NAMES)
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("off", [0.0, 0.3, -0.8])
def test_force_and_torque_do_not_jump_where_the_yaw_crosses_180_degrees(name, level, off):
    """2·10⁻⁷ rad of yaw apart, with weights as large as flights end with: nothing may differ by more than 10⁻⁵."""
    law = law_of(name, level)
    memory = random_memory(np.random.default_rng(2), law, weights=1.0)
    before, after = (
        law.step(memory, facing(yaw), wanted(math.pi + off), 0.01, RUN).terms.values
        for yaw in (math.pi - 1e-7, -math.pi + 1e-7)
    )
    assert before.euler[2] > 3.1 and after.euler[2] < -3.1
    np.testing.assert_allclose(before.position.total, after.position.total, atol=1e-5)
    np.testing.assert_allclose(before.torque_wanted, after.torque_wanted, atol=1e-5)


@pytest.mark.parametrize("name", LAW_NAMES)
def test_the_force_has_no_jump_at_any_yaw_error(name):
    """Once round against a desired yaw that stays: not even behind us, where the yaw error itself is wrapped."""
    law = law_of(name)
    memory = random_memory(np.random.default_rng(2), law, weights=1.0)
    forces = np.array(
        [
            law.step(memory, facing(yaw), wanted(0.7), 0.01, RUN).terms.values.position.total.copy()
            for yaw in np.linspace(-math.pi, math.pi, 2001)
        ]
    )
    assert np.abs(np.diff(forces, axis=0)).max() < 0.02  # N, in 0.18°
    np.testing.assert_allclose(forces[0], forces[-1], atol=1e-9)


def flown(name, heading, seconds=9.0, skip=4.0):
    """RMS (3,) m along the trajectory's own axes of the lemniscate laid out along `heading`, attitude level."""
    level, rate = ControlLevel.ATTITUDE, 100
    response = QBALL2.response()
    plant = Plant(
        level=level.value,
        rotor_lag_rad_s=QBALL2.rotors.lag_rad_s,
        frequency_rad_s=response.tilt.natural_frequency_rad_s,
        damping=response.tilt.damping,
        yaw_frequency_rad_s=response.yaw.natural_frequency_rad_s,
        rate_lag_s=response.rate_lag_s,
        dead_time_s=response.dead_time(level),
    )
    turn = rotation_zyx(0.0, 0.0, heading)

    def reference(time_s):
        r = lemniscate(time_s)
        rows = (r.position_enu, r.velocity_enu, r.acceleration_enu, r.jerk_enu, r.snap_enu)
        return Reference(*(turn @ row for row in rows), heading, 0.0, 0.0)

    plant.start_on(reference)
    plant.R = turn.copy()
    law = law_of(name, level)
    predictor = Predictor(QBALL2.model_copy(update={"estimator_delay_s": 0.0}), level)
    memory, errors = None, []
    for _ in range(round(seconds * rate)):
        state = predictor.predict(plant.state(None))
        here = reference(state.time_s)
        if memory is None:
            memory = law.take_over(law.initial_memory(), state, here, plant.thrust, quaternion_of(plant.R))
        result = law.step(memory, state, here, 1 / rate, RUN)
        memory = result.memory
        plant.command(result.setpoint)
        predictor.sent(plant.time, result.setpoint)
        plant.advance(1 / rate, 0.005)
        errors.append(turn.T @ (reference(plant.time).position_enu - plant.p))
    return np.sqrt((np.array(errors)[round(skip * rate) :] ** 2).mean(axis=0))


@pytest.mark.parametrize("name", ["dtlannc", "tlmbc"])
def test_eight_headings_fly_alike(name):
    """The axes of the sign term are the world's, so the flights are not the same to the bit."""
    rms = np.array([flown(name, heading) for heading in HEADINGS])
    middle = rms.mean(axis=0)
    assert (np.abs(rms - middle) <= 0.05 * middle + 0.001).all(), rms
