"""Bumpless hand-over: the first command is the one taken over, and the next ones leave it smoothly."""

import math

import numpy as np
import pytest
from control_cases import LAW_NAMES, LEVELS, MASS_ESTIMATE, law_of, random_state
from control_plant import GRAVITY, Plant, at_rest, lemniscate, matrix_of, quaternion_of, rotation_zyx

from companion.control.structs import AdaptationGate, VehicleState

RUN = AdaptationGate.RUN


def angle_between(a, b):
    return 2 * math.acos(min(1.0, abs(float(np.dot(a, b)))))


@pytest.mark.parametrize("name", LAW_NAMES)
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("moving", [False, True])
def test_the_first_command_is_the_one_taken_over(name, level, moving):
    law = law_of(name, level)
    rng = np.random.default_rng(4)
    state = random_state(rng, tilt=0.1, yaw=0.3)
    state = VehicleState(state.time_s, 0.05 * state.position_enu, 0.1 * state.velocity_enu, *_rest(state))
    reference = lemniscate(0.7) if moving else at_rest((0.1, 0.0, 0.0))
    if moving:
        state = VehicleState(0.7, reference.position_enu + 0.03, reference.velocity_enu - 0.05, *_rest(state))
    given = quaternion_of(rotation_zyx(0.08, -0.05, 0.2))
    memory = law.take_over(law.initial_memory(), state, reference, 16.5, given)
    setpoint = law.step(memory, state, reference, 0.01, RUN).setpoint
    assert setpoint.thrust_newton == pytest.approx(16.5, abs=1e-9)
    assert angle_between(setpoint.quaternion_wxyz, given) < 1e-6


@pytest.mark.parametrize("level", LEVELS)
def test_a_turning_reference_is_taken_over_too(level):
    """The yaw lead is part of what is sent at the attitude level, so the hand-over has to count it."""
    law = law_of("dtlannc", level)
    still = at_rest()
    turning = type(still)(*[getattr(still, n) for n in still.__slots__[:5]], 0.2, 0.5, 0.3)
    given = quaternion_of(rotation_zyx(0.02, 0.03, -0.1))
    memory = law.take_over(law.initial_memory(), Plant().state(), turning, 17.0, given)
    setpoint = law.step(memory, Plant().state(), turning, 0.01, RUN).setpoint
    assert setpoint.thrust_newton == pytest.approx(17.0, abs=1e-9)
    assert angle_between(setpoint.quaternion_wxyz, given) < 1e-6


def _rest(state):
    return state.quaternion_wxyz, state.body_rate_flu


@pytest.mark.parametrize("name", LAW_NAMES)
def test_the_following_commands_leave_without_a_jump(name):
    """No step of thrust above 0.2 N or of attitude above 0.4° at 100 Hz while hovering with 5 N of unknown weight."""
    law = law_of(name)
    plant = Plant(level="attitude")
    memory = law.take_over(
        law.initial_memory(), plant.state(), at_rest(), 1.79 * GRAVITY, quaternion_of(np.eye(3))
    )
    last = (1.79 * GRAVITY, quaternion_of(np.eye(3)))
    for _ in range(600):
        result = law.step(memory, plant.state(), at_rest(), 0.01, RUN)
        memory, setpoint = result.memory, result.setpoint
        assert abs(setpoint.thrust_newton - last[0]) < 0.2
        assert angle_between(setpoint.quaternion_wxyz, last[1]) < math.radians(0.4)
        last = (setpoint.thrust_newton, setpoint.quaternion_wxyz)
        plant.command(setpoint)
        plant.advance(0.01, 0.005)
        assert np.linalg.norm(plant.p) < 0.25
    assert np.linalg.norm(plant.p) < 0.05


def test_unknown_weight_goes_into_the_integral_and_the_rest_fades():
    law = law_of("dtlannc")
    state = Plant().state()
    given = quaternion_of(rotation_zyx(0.0, 0.05, 0.3))
    memory = law.take_over(law.initial_memory(), state, at_rest(), 17.5599, given)
    K_i = law.parameters.position.K_i
    # by hand: 1.79 · 9.81 − 0.7 · 1.79 · 9.81 = 5.268 N
    assert K_i[2] * memory.position_integral[2] == pytest.approx(17.5599 - MASS_ESTIMATE * GRAVITY, abs=1e-9)
    v = memory.values
    assert v.hand_over_force[2] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(
        v.hand_over_force[:2], 17.5599 * math.tan(0.05) * np.array([math.cos(0.3), math.sin(0.3)]), atol=1e-9
    )
    assert v.hand_over_yaw == pytest.approx(0.3)
    after = law.step(memory, state, at_rest(), 1.0, RUN).memory.values  # hand_over_s is 1: e⁻¹ is left
    np.testing.assert_allclose(after.hand_over_force, v.hand_over_force * math.exp(-1), atol=1e-12)
    assert after.hand_over_yaw == pytest.approx(0.3 * math.exp(-1))


def test_what_the_integral_may_not_hold_fades_instead():
    from control_cases import gains_of

    from companion.control.structs import ControlLevel

    law = law_of(gains=gains_of("dtlannc", ControlLevel.ATTITUDE, integral_bound=2.0))
    memory = law.take_over(
        law.initial_memory(), Plant().state(), at_rest(), 17.5599, quaternion_of(np.eye(3))
    )
    assert law.parameters.position.K_i[2] * memory.position_integral[2] == pytest.approx(2.0)
    assert memory.values.hand_over_force[2] == pytest.approx(17.5599 - MASS_ESTIMATE * GRAVITY - 2.0)


def test_taking_over_keeps_what_was_learnt():
    law = law_of()
    memory = law.initial_memory()
    plant = Plant(level="attitude")
    for _ in range(50):
        memory = law.step(memory, plant.state(), at_rest((0.1, 0.1, 0)), 0.01, RUN).memory
    taken = law.take_over(memory, plant.state(), at_rest(), 15.0, quaternion_of(np.eye(3)))
    assert memory.position_weights.any()
    np.testing.assert_array_equal(taken.position_weights, memory.position_weights)
    assert matrix_of(plant.state().quaternion_wxyz)[2, 2] == pytest.approx(1.0)
