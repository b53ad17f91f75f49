"""Each law's step against its equations, restated here in matrix form from control_laws.md, and by hand."""

import math

import numpy as np
import pytest
from control_cases import (
    LAW_NAMES,
    LEVELS,
    MASS_ESTIMATE,
    QBALL2,
    gains_of,
    law_of,
    random_memory,
    random_reference,
    random_state,
)
from control_plant import GRAVITY, at_rest, matrix_of, quaternion_of, rotation_zyx

from companion.autopilot.thrust import ThrustScale
from companion.control.bounds import ATTITUDE_SATURATES, POSITION_SATURATES, Bound
from companion.control.law import StepRefused, pack_input
from companion.control.packing import Memory
from companion.control.structs import AdaptationGate, ControlLevel, VehicleState

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
HOVER = VehicleState(0.0, np.zeros(3), np.zeros(3), LEVEL, np.zeros(3))
RUN = AdaptationGate.RUN


def phi_of(euler):
    """Φ typed anew from control_laws.md, section 1."""
    sf, cf = math.sin(euler[0]), math.cos(euler[0])
    tt, ct = math.tan(euler[1]), math.cos(euler[1])
    return np.array([[1, sf * tt, cf * tt], [0, cf, -sf], [0, sf / ct, cf / ct]])


def euler_of(q):
    R = matrix_of(q)
    return np.array([math.atan2(R[2, 1], R[2, 2]), -math.asin(R[2, 0]), math.atan2(R[1, 0], R[0, 0])])


def with_relative_yaw(euler, reference):
    """What stands for η in both networks' inputs; control_laws.md, section 8."""
    return np.array([euler[0], euler[1], math.pi / 2 + math.sin(euler[2] - reference.yaw_rad)])


def smooth(u, width):
    return np.tanh(u / width) if width > 0 else np.sign(u)


@pytest.mark.parametrize("name", LAW_NAMES)
@pytest.mark.parametrize("level", LEVELS)
def test_hover_takes_the_estimated_weight(name, level):
    """At rest on the reference: F = m̂ g = 0.7 · 1.79 · 9.81 = 12.292 N, level, no torque."""
    result = law_of(name, level).step(law_of(name, level).initial_memory(), HOVER, at_rest(), 0.01, RUN)
    assert result.setpoint.thrust_newton == pytest.approx(12.29193, abs=1e-9)
    np.testing.assert_allclose(result.setpoint.quaternion_wxyz, LEVEL, atol=1e-12)
    np.testing.assert_allclose(result.setpoint.body_rate_flu, 0, atol=1e-12)
    np.testing.assert_allclose(result.setpoint.torque_flu, 0, atol=1e-12)
    assert result.terms.flags == 0


@pytest.mark.parametrize("name", LAW_NAMES)
def test_the_vehicle_is_told_to_go_where_the_reference_is(name):
    """East of us: nose (yaw 0) down, pitch positive. North: roll to the right is negative y, so roll is negative."""
    law = law_of(name)
    east = law.step(law.initial_memory(), HOVER, at_rest((0.3, 0, 0)), 0.01, RUN).terms.values
    assert east.euler_desired[1] > 0.01 and abs(east.euler_desired[0]) < 1e-9
    north = law.step(law.initial_memory(), HOVER, at_rest((0, 0.3, 0)), 0.01, RUN).terms.values
    assert north.euler_desired[0] < -0.01 and abs(north.euler_desired[1]) < 1e-9
    above = law.step(law.initial_memory(), HOVER, at_rest((0, 0, 0.1)), 0.01, RUN)
    assert above.setpoint.thrust_newton > 12.3
    turned = law.step(law.initial_memory(), HOVER, at_rest(yaw=0.2), 0.01, RUN)
    assert turned.setpoint.torque_flu[2] > 0 and turned.setpoint.body_rate_flu[2] > 0


@pytest.mark.parametrize("name", LAW_NAMES)
@pytest.mark.parametrize("seed", range(5))
def test_force_is_the_laws_equation(name, seed):
    """Eqs. (2)–(14) and section 6, in vectors."""
    rng = np.random.default_rng(seed)
    law = law_of(name)
    g = gains_of(name, ControlLevel.ATTITUDE).position_loop
    state, ref, memory = random_state(rng), random_reference(rng), random_memory(rng, law)
    t = law.step(memory, state, ref, 0.01, RUN).terms.values.position
    e = ref.position_enu - state.position_enu
    e_dot = ref.velocity_enu - state.velocity_enu
    U_tilde = ref.velocity_enu + np.array(g.K_e) * e - state.velocity_enu
    U_dot = ref.acceleration_enu + np.array(g.K_e) * e_dot
    turn = rotation_zyx(0.0, 0.0, ref.yaw_rad + memory.values.hand_over_yaw - math.pi / 2)
    angles = with_relative_yaw(euler_of(state.quaternion_wxyz), ref)
    gamma = np.concatenate([[1], turn.T @ state.velocity_enu, angles, turn.T @ U_dot])
    sigma = np.tanh(law.parameters.position_V.T @ gamma)
    up = np.array([0, 0, GRAVITY])
    network = turn @ memory.position_weights.T @ sigma
    integral = np.array(g.K_i) * memory.position_integral
    sign = g.alpha * smooth(U_tilde, g.boundary_width)
    f = {
        "dtlannc": integral + MASS_ESTIMATE * (ref.acceleration_enu + up) + network + sign,
        "tlmbc": integral + MASS_ESTIMATE * (U_dot + up) + np.array(QBALL2.drag_kg_s) * state.velocity_enu,
        "nnsmc": MASS_ESTIMATE * (U_dot + up) + network + sign,
    }[name] + np.array(g.K_U) * U_tilde
    np.testing.assert_allclose(t.error, e, atol=1e-14)
    np.testing.assert_allclose(t.error_rate, e_dot, atol=1e-14)
    np.testing.assert_allclose(t.U_error, U_tilde, atol=1e-13)
    np.testing.assert_allclose(t.U_rate, U_dot, atol=1e-13)
    np.testing.assert_allclose(t.total, f, atol=1e-11)


@pytest.mark.parametrize("name", LAW_NAMES)
@pytest.mark.parametrize("seed", range(5))
def test_torque_is_the_laws_equation(name, seed):
    """Eqs. (21)–(28) and section 6, in matrices; η̇_d, η̈_d as the step found them."""
    rng = np.random.default_rng(100 + seed)
    level = ControlLevel.ACTUATOR
    law = law_of(name, level)
    g = gains_of(name, level).attitude_loop
    state, ref, memory = random_state(rng), random_reference(rng), random_memory(rng, law)
    terms = law.step(memory, state, ref, 0.004, RUN).terms.values
    t = terms.attitude
    euler = euler_of(state.quaternion_wxyz)
    Phi = phi_of(euler)
    rate = Phi @ state.body_rate_flu
    e = terms.euler_desired - euler
    e[2] = (e[2] + math.pi) % (2 * math.pi) - math.pi
    U_tilde = terms.euler_rate_desired + np.array(g.K_e) * e - rate
    U_dot = terms.euler_acceleration_desired + np.array(g.K_e) * (terms.euler_rate_desired - rate)
    sigma = np.tanh(
        law.parameters.attitude_V.T @ np.concatenate([[1], with_relative_yaw(euler, ref), rate, U_dot])
    )
    network = memory.attitude_weights.T @ sigma
    integral = np.array(g.K_i) * memory.attitude_integral
    sign = g.alpha * smooth(U_tilde, g.boundary_width)
    if name == "tlmbc":
        # M U̇ + C η̇ as Φ⁻ᵀ (I d/dt(Φ⁻¹ η̇) + ω × Iω) with η̈ = U̇, the derivative by differences
        h = 1e-6
        inertia = np.array(QBALL2.inertia_kg_m2)
        ahead = np.linalg.inv(phi_of(euler + h * rate)) @ (rate + h * U_dot)
        behind = np.linalg.inv(phi_of(euler - h * rate)) @ (rate - h * U_dot)
        w = state.body_rate_flu
        body = inertia * (ahead - behind) / (2 * h) + np.cross(w, inertia * w)
        model = np.linalg.inv(Phi).T @ body + np.array(QBALL2.rotational_drag_kg_m2_s) * rate
        bracket = integral + model
    else:
        bracket = network + sign + (integral if name == "dtlannc" else 0)
    bracket = bracket + np.array(g.K_U) * U_tilde
    np.testing.assert_allclose(t.error, e, atol=1e-12)
    np.testing.assert_allclose(t.U_error, U_tilde, atol=1e-11)
    np.testing.assert_allclose(t.U_rate, U_dot, atol=1e-10)
    np.testing.assert_allclose(t.total, bracket, atol=1e-7)
    np.testing.assert_allclose(terms.torque_wanted, Phi.T @ bracket, atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_thrust_and_attitude_carry_the_force(seed):
    """Eqs. (16)–(18): thrust by the present tilt, direction by the desired attitude."""
    rng = np.random.default_rng(seed)
    law = law_of(level=ControlLevel.ACTUATOR)
    state = random_state(rng)
    t = law.step(law.initial_memory(), state, random_reference(rng), 0.01, RUN).terms.values
    R = matrix_of(state.quaternion_wxyz)
    assert t.thrust_wanted == pytest.approx(t.force[2] / R[2, 2], rel=1e-12)
    direction = rotation_zyx(*t.euler_desired)[:, 2]
    np.testing.assert_allclose(direction, t.force / np.linalg.norm(t.force), atol=1e-12)
    np.testing.assert_allclose(matrix_of(t.quaternion), rotation_zyx(*t.euler_desired), atol=1e-12)


def test_body_rates_are_u_eta_through_the_inverse_of_phi():
    rng = np.random.default_rng(7)
    gains = gains_of("dtlannc", ControlLevel.BODY_RATE)
    gains = gains.model_copy(update={"lead": gains.lead.model_copy(update={"rate_scale": 0.0})})
    limits = QBALL2.limits.model_copy(update={"body_rate_max_deg_s": (1e4, 1e4, 1e4)})
    profile = QBALL2.model_copy(update={"limits": limits})
    law = law_of(level=ControlLevel.BODY_RATE, gains=gains, profile=profile)
    state = random_state(rng)
    result = law.step(law.initial_memory(), state, random_reference(rng), 0.01, RUN)
    expected = np.linalg.inv(phi_of(euler_of(state.quaternion_wxyz))) @ result.terms.values.attitude.U
    np.testing.assert_allclose(result.setpoint.body_rate_flu, expected, atol=1e-12)


def test_integral_and_weights_after_one_step_by_hand():
    """ξ ← dt Ũ and Ŵ ← dt N σŨᵀ / (1 + dt N κ‖Ũ‖) from rest, 0.1 m east of us: Ũ = K_p e = (0.15, 0, 0)."""
    gains = gains_of("dtlannc", ControlLevel.ATTITUDE, K_e=(1.5, 1.5, 1.5), N=2.0, kappa=0.4)
    law = law_of(gains=gains)
    result = law.step(law.initial_memory(), HOVER, at_rest((0.1, 0, 0)), 0.02, RUN)
    np.testing.assert_allclose(result.memory.position_integral, [0.003, 0, 0], atol=1e-15)
    V = law.parameters.position_V  # every feature but the bias and the yaw's π/2 is zero, U̇ too
    sigma = np.tanh(V[0] + math.pi / 2 * V[6])
    leak = 1 + 0.02 * 2.0 * 0.4 * 0.15
    along_the_nose = [
        0.0,
        0.15,
        0.0,
    ]  # the network's y, as ENU's is to a nose that points north; ours points east
    expected = np.outer(0.02 * 2.0 * sigma, along_the_nose) / leak
    np.testing.assert_allclose(result.memory.position_weights, expected, rtol=1e-12, atol=1e-17)


@pytest.mark.parametrize("name", LAW_NAMES)
def test_what_a_law_does_not_have_stays_zero(name):
    rng = np.random.default_rng(1)
    law = law_of(name, ControlLevel.ACTUATOR)
    result = law.step(law.initial_memory(), random_state(rng, 0.1), random_reference(rng), 0.01, RUN)
    t = result.terms.values.position
    if name == "tlmbc":
        assert not t.network_term.any() and not t.sign_term.any() and not result.memory.position_weights.any()
    else:
        assert t.sign_term.any()
    if name == "nnsmc":
        assert not t.integral_term.any() and not result.memory.position_integral.any()


@pytest.mark.parametrize("level", LEVELS)
def test_attitude_network_learns_only_where_its_torque_flies(level):
    law = law_of(level=level)
    state = VehicleState(0.0, np.zeros(3), np.zeros(3), quaternion_of(rotation_zyx(0.05, 0, 0)), np.zeros(3))
    memory = law.step(law.initial_memory(), state, at_rest(), 0.01, RUN).memory
    assert memory.attitude_weights.any() == (level is ControlLevel.ACTUATOR)
    assert memory.attitude_integral.any() == (level is ControlLevel.ACTUATOR)


GATE_EFFECT = {
    # gate: (integral moves, weights move)
    AdaptationGate.RUN: (True, True),
    AdaptationGate.FREEZE_WEIGHTS: (True, False),
    AdaptationGate.FREEZE: (False, False),
}


@pytest.mark.parametrize("gate", list(AdaptationGate))
def test_gate(gate):
    law = law_of(level=ControlLevel.ACTUATOR)
    memory = law.initial_memory()
    memory.values["position_integral"] = memory.values["attitude_integral"] = 0.01
    memory.values["position_weights"], memory.values["attitude_weights"] = 0.02, 0.001
    result = law.step(memory, HOVER, at_rest((0.01, 0.01, 0.01)), 0.01, gate)
    assert not result.terms.flags & (
        POSITION_SATURATES | ATTITUDE_SATURATES
    )  # or the loops freeze by themselves
    after = result.memory
    if gate is AdaptationGate.GROUND:
        for part in (
            after.position_integral,
            after.position_weights,
            after.attitude_integral,
            after.attitude_weights,
        ):
            assert not part.any()
        return
    integral, weights = GATE_EFFECT[gate]
    assert np.array_equal(after.position_integral, memory.position_integral) != integral
    assert np.array_equal(after.attitude_integral, memory.attitude_integral) != integral
    assert np.array_equal(after.position_weights, memory.position_weights) != weights
    assert np.array_equal(after.attitude_weights, memory.attitude_weights) != weights


@pytest.mark.parametrize(
    ("position", "bit"), [((30, 0, 0), "TILT"), ((0, 0, -30), "FORCE_Z"), ((0, 0, 30), "THRUST_MAX")]
)
def test_saturation_is_said_and_freezes_the_position_loop(position, bit):
    law = law_of()
    memory = random_memory(np.random.default_rng(3), law, weights=0.1)
    result = law.step(memory, HOVER, at_rest(position), 0.01, RUN)
    assert Bound[bit] in Bound(result.terms.flags)
    np.testing.assert_array_equal(result.memory.position_integral, memory.position_integral)
    np.testing.assert_array_equal(result.memory.position_weights, memory.position_weights)
    tilt = math.acos(matrix_of(result.setpoint.quaternion_wxyz)[2, 2])
    assert tilt <= math.radians(QBALL2.limits.tilt_max_deg) + 1e-9
    assert result.setpoint.thrust_newton <= 0.9 * 48 + 1e-9


def test_integral_is_projected():
    gains = gains_of("dtlannc", ControlLevel.ATTITUDE, K_i=(2.0, 2.0, 4.0), integral_bound=0.5)
    law = law_of(gains=gains)
    memory = law.initial_memory()
    for _ in range(300):
        memory = law.step(memory, HOVER, at_rest((0.2, 0.1, 0.2)), 0.05, RUN).memory
    assert np.linalg.norm(np.array([2, 2, 4]) * memory.position_integral) == pytest.approx(0.5, rel=1e-9)


@pytest.mark.parametrize(
    "what", ["position", "velocity", "quaternion", "body_rate", "dt", "length", "reference"]
)
def test_bad_numbers_are_refused(what):
    law = law_of()
    arrays = {
        "position": HOVER.position_enu.copy(),
        "velocity": HOVER.velocity_enu.copy(),
        "quaternion": LEVEL.copy(),
        "body_rate": np.zeros(3),
    }
    dt, reference = 0.01, at_rest()
    if what == "dt":
        dt = -0.01
    elif what == "length":
        arrays["quaternion"] *= 1.1
    elif what == "reference":
        reference = at_rest((math.inf, 0, 0))
    else:
        arrays[what][1] = math.nan
    state = VehicleState(0.0, *arrays.values())
    with pytest.raises(StepRefused, match="finite"):
        law.step(law.initial_memory(), state, reference, dt, RUN)


@pytest.mark.parametrize("tilt", [(0.0, 1.35), (1.35, 0.0), (3.0, 0.0), (1.1, 1.1)])
def test_a_vehicle_near_the_singularity_is_refused(tilt):
    law = law_of()
    state = VehicleState(0.0, np.zeros(3), np.zeros(3), quaternion_of(rotation_zyx(*tilt, 0.0)), np.zeros(3))
    with pytest.raises(StepRefused, match="tilt_abort_deg = 75"):
        law.step(law.initial_memory(), state, at_rest(), 0.01, RUN)


@pytest.mark.parametrize("level", LEVELS)
def test_a_step_changes_nothing_and_repeats_to_the_bit(level):
    rng = np.random.default_rng(5)
    law = law_of(level=level)
    memory, state, ref = random_memory(rng, law), random_state(rng), random_reference(rng)
    before = memory.to_array().tobytes()
    first = law.step(memory, state, ref, 0.01, RUN)
    again = law.step(Memory.from_array(memory.to_array(), law.hidden), state, ref, 0.01, RUN)
    assert memory.to_array().tobytes() == before
    assert first.terms.values.tobytes() == again.terms.values.tobytes()
    assert first.memory.values.tobytes() == again.memory.values.tobytes()


def test_thrust_is_bounded_by_the_scale_in_force_and_the_integral_rests():
    """A vehicle that hovers at 0.6 of full thrust gives 29.3 N at most, 26.3 N of them within the profile's 0.9.

    2 m below the reference the law wants more for 5 s. By the profile's 43.2 N alone it would not know that anything
    was cut, and would wind its integral up.
    """
    scale = ThrustScale(0.6, QBALL2.mass_kg, 12.0, np.ones((4, 4)), 0.05, 0.9)
    assert scale.bounds_newton == pytest.approx((1.463, 26.340), abs=1e-3)
    law = law_of(gains=gains_of("dtlannc", ControlLevel.ATTITUDE, K_e=(4, 4, 4), K_U=(3, 3, 4)))

    def five_seconds(bounds):
        memory = law.initial_memory()
        for _ in range(500):
            result = law.step_packed(memory, pack_input(HOVER, at_rest((0, 0, 1.0)), 0.01, RUN, bounds))
            memory = result.memory
        return result

    kept = five_seconds(scale.bounds_newton)
    assert kept.terms.values.thrust_wanted > 26.34
    assert Bound.THRUST_MAX in Bound(kept.terms.flags)
    assert kept.setpoint.thrust_newton == pytest.approx(26.340, abs=1e-3)
    assert scale.normalised(kept.setpoint.thrust_newton) == pytest.approx(0.9)
    assert not kept.memory.position_weights.any() and kept.memory.position_integral[2] == 0.0
    wound = five_seconds(law.thrust_bounds_newton)  # as it was: the bounds of another thrust scale
    assert 8.0 * wound.memory.position_integral[2] > 6.0 and wound.setpoint.thrust_newton > scale.full_newton
