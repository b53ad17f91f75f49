"""What makes up for lags: lead on attitude, body rate and rotors, and the derivatives it stands on."""

import math

import numpy as np
import pytest
from control_cases import QBALL2, gains_of, law_of, random_memory, random_reference, random_state
from control_plant import GRAVITY, Plant, at_rest, lemniscate, matrix_of, quaternion_of, rotation_zyx

from companion.control.structs import AdaptationGate, ControlLevel, VehicleState

RUN = AdaptationGate.RUN
ATTITUDE, BODY_RATE, ACTUATOR = ControlLevel
UP = np.array([0.0, 0.0, GRAVITY])


def with_lead(gains, **lead):
    return gains.model_copy(update={"lead": gains.lead.model_copy(update=lead)})


def on_path(t):
    """A state exactly on the lemniscate."""
    plant = Plant()
    plant.start_on(lambda s: lemniscate(t + s))
    plant.time = t
    return plant.state()


def test_attitude_setpoint_inverts_the_second_order_response():
    """θ_sp = θ + 2ζ/ω θ̇ + θ̈/ω² with θ from differences of the path's own attitude; on the path, mass known."""
    profile = QBALL2.model_copy(update={"mass_ratio": 1.0})
    gains = with_lead(gains_of("tlmbc", ATTITUDE), feedback_s=0.0, attitude_scale=1.0)
    law = law_of("tlmbc", ATTITUDE, profile=profile, gains=gains)
    tilt = profile.response().tilt
    h, t = 1e-3, 1.3
    a = [lemniscate(t + k * h).acceleration_enu + UP for k in (-1, 0, 1)]
    # yaw 0: tan θ = a_x / a_z, tan φ = −a_y / √(a_x² + a_z²)
    angles = np.array([[-math.atan2(x[1], math.hypot(x[0], x[2])), math.atan2(x[0], x[2])] for x in a])
    rate, second = (angles[2] - angles[0]) / (2 * h), (angles[2] - 2 * angles[1] + angles[0]) / h**2
    w, z = tilt.natural_frequency_rad_s, tilt.damping
    expected = angles[1] + 2 * z / w * rate + second / w**2
    state = on_path(t)
    sent = law.step(law.initial_memory(), state, lemniscate(t), 0.01, RUN).terms.values.euler_setpoint
    np.testing.assert_allclose(sent[:2], expected, atol=2e-4)
    assert np.abs(expected - angles[1]).max() > 0.01


def test_yaw_setpoint_leads_by_the_yaw_response():
    law = law_of(gains=with_lead(gains_of("dtlannc", ATTITUDE), attitude_scale=0.5))
    yaw = QBALL2.response().yaw
    reference = at_rest()
    turning = type(reference)(*[getattr(reference, n) for n in reference.__slots__[:5]], 0.2, 0.3, -0.4)
    state = Plant().state()
    sent = law.step(law.initial_memory(), state, turning, 0.01, RUN).terms.values.euler_setpoint[2]
    w, z = yaw.natural_frequency_rad_s, yaw.damping
    assert sent == pytest.approx(0.2 + 0.5 * (2 * z / w * 0.3 - 0.4 / w**2))


@pytest.mark.parametrize("name", ["dtlannc", "tlmbc", "nnsmc"])
def test_feedback_rate_is_the_derivative_of_the_feedback(name):
    """Along a flown second: the model's derivative of f's feedback against differences of f − m̂ p̈_d, horizontally.

    The network's inputs are held still (its derivative through σ is left out on purpose) by tiny input scales.
    """
    gains = gains_of(name, ATTITUDE, input_scales=(1.0, 1e-6, 1e-6, 1e-6), kappa=0.0, boundary_width=0.5)
    gains = with_lead(gains, feedback_s=0.1, feedback_filter_s=0.0)
    profile = QBALL2.model_copy(update={"drag_kg_s": (0.0, 0.0, 0.0)})
    law = law_of(name, ATTITUDE, profile=profile, gains=gains)
    plant = Plant(level="attitude", drag=np.zeros(3))
    plant.p = np.array([0.2, -0.3, 0.0])
    dt, feedback, rates = 0.002, [], []
    memory = law.take_over(
        law.initial_memory(), plant.state(), at_rest(), plant.thrust, quaternion_of(plant.R)
    )
    for _ in range(500):
        result = law.step(memory, plant.state(), at_rest(), dt, RUN)
        t = result.terms.values
        feedback.append(t.position.total.copy())
        rates.append(t.feedback_lead_force / 0.1)
        memory = result.memory
        plant.command(result.setpoint)
        plant.advance(dt)
    feedback, rates = np.array(feedback), np.array(rates)
    numeric = (feedback[2:] - feedback[:-2]) / (2 * dt)
    scale = np.abs(numeric[:, :2]).max()
    assert scale > 0.3
    np.testing.assert_allclose(rates[1:-1, :2], numeric[:, :2], atol=0.06 * scale)
    assert not rates[:, 2].any()


def test_feedback_lead_moves_the_setpoint_by_its_force():
    gains = with_lead(
        gains_of("dtlannc", ATTITUDE), feedback_s=0.2, feedback_filter_s=0.0, attitude_scale=0.0
    )
    law = law_of(gains=gains)
    plant = Plant()
    plant.v = np.array([0.0, 0.0, 0.0])
    plant.R = rotation_zyx(
        0.0, -0.1, 0.0
    )  # accelerating west while it should go east: Ũ grows, so must the tilt
    t = law.step(law.initial_memory(), plant.state(), at_rest((0.05, 0, 0)), 0.01, RUN).terms.values
    assert t.feedback_lead_force[0] > 0.1
    direction = rotation_zyx(*t.euler_setpoint)[:, 2]
    force = t.force + t.feedback_lead_force
    np.testing.assert_allclose(direction, force / np.linalg.norm(force), atol=1e-12)


def test_feedback_rate_is_low_passed_exactly():
    gains = with_lead(gains_of("dtlannc", ATTITUDE), feedback_s=0.1, feedback_filter_s=0.05)
    law = law_of(gains=gains)
    state, reference = Plant().state(), at_rest((0.1, 0, 0))
    first = law.step(law.initial_memory(), state, reference, 0.01, AdaptationGate.FREEZE)
    raw = first.memory.values.feedback_rate.copy()
    later = law.step(first.memory, state, at_rest(), 0.05, AdaptationGate.FREEZE)
    np.testing.assert_allclose(later.memory.values.feedback_rate, raw * math.exp(-1), atol=1e-12)


def test_desired_rates_are_the_derivative_of_the_desired_angles():
    """The command filter's share: with slow changes η̇_d is the rate of η_d, and η̈_d the rate of η̇_d."""
    law = law_of(level=ACTUATOR)
    memory, dt = law.initial_memory(), 0.002
    rows = []
    for k in range(3000):
        t = k * dt
        state = VehicleState(t, np.zeros(3), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3))
        reference = at_rest((0.1 * math.sin(t), 0.1 * math.cos(t), 0.0))
        result = law.step(memory, state, reference, dt, AdaptationGate.FREEZE)
        memory, v = result.memory, result.terms.values
        rows.append(
            [v.euler_desired.copy(), v.euler_rate_desired.copy(), v.euler_acceleration_desired.copy()]
        )
    angle, rate, acceleration = np.array(rows)[1500:].transpose(1, 0, 2)
    numeric = np.gradient(rate, dt, axis=0)
    np.testing.assert_allclose(acceleration[5:-5], numeric[5:-5], atol=2e-3 * np.abs(numeric).max() + 1e-6)
    lag = 2 * law.parameters.filter_damping / law.parameters.filter_frequency
    shift = round(lag / dt)
    slope = np.gradient(angle, dt, axis=0)
    np.testing.assert_allclose(rate[shift:], slope[:-shift], atol=0.02 * np.abs(slope).max())


def test_reference_share_of_the_rates_does_not_lag():
    law = law_of(level=ACTUATOR)
    v = law.step(law.initial_memory(), on_path(0.9), lemniscate(0.9), 0.004, RUN).terms.values
    h = 1e-4
    a = [lemniscate(0.9 + k * h).acceleration_enu + UP for k in (-1, 1)]
    pitch = [math.atan2(x[0], x[2]) for x in a]
    assert v.euler_rate_desired[1] == pytest.approx((pitch[1] - pitch[0]) / (2 * h), abs=1e-6)


def test_body_rates_lead_by_the_rate_loops_lag():
    rng = np.random.default_rng(11)
    state, reference = random_state(rng), random_reference(rng)
    rates = []
    for scale in (0.0, 1.0):
        limits = QBALL2.limits.model_copy(update={"body_rate_max_deg_s": (1e5, 1e5, 1e5)})
        law = law_of(
            level=BODY_RATE,
            gains=with_lead(gains_of("dtlannc", BODY_RATE), rate_scale=scale),
            profile=QBALL2.model_copy(update={"limits": limits}),
        )
        result = law.step(law.initial_memory(), state, reference, 0.01, RUN)
        rates.append(result.setpoint.body_rate_flu)
    R = matrix_of(state.quaternion_wxyz)
    roll, pitch = math.atan2(R[2, 1], R[2, 2]), -math.asin(R[2, 0])
    c, s = math.cos, math.sin
    to_body = np.array(
        [[1, 0, -s(pitch)], [0, c(roll), s(roll) * c(pitch)], [0, -s(roll), c(roll) * c(pitch)]]
    )
    lead = np.array(QBALL2.response().rate_lag_s) * (to_body @ result.terms.values.flat_euler_acceleration)
    np.testing.assert_allclose(rates[1] - rates[0], lead, atol=1e-12)


def test_rotor_lead_undoes_the_rotors_lag():
    """Sent through the lead and then a first-order lag of 15 rad/s, torque arrives as through the lead's filter alone."""
    filter_s, lag_s, dt = 0.02, 1 / 15, 0.002
    law = law_of(level=ACTUATOR, gains=with_lead(gains_of("dtlannc", ACTUATOR), rotor_filter_s=filter_s))
    still = Plant().state()
    memory = law.step(law.initial_memory(), still, at_rest(), dt, AdaptationGate.FREEZE).memory
    arrived, filtered = 0.0, 0.0
    for k in range(150):
        yaw = at_rest(yaw=0.02 if k > 0 else 0.0)
        result = law.step(memory, still, yaw, dt, AdaptationGate.FREEZE)
        memory, wanted = result.memory, result.terms.values.torque_wanted[2]
        arrived += (1 - math.exp(-dt / lag_s)) * (result.setpoint.torque_flu[2] - arrived)
        filtered += (1 - math.exp(-dt / filter_s)) * (wanted - filtered)
        assert arrived == pytest.approx(filtered, abs=0.06 * abs(wanted) + 1e-9)
    assert abs(wanted) > 1e-3


def test_memory_of_the_lead_is_part_of_the_step():
    """Two memories that differ in the filters alone give different setpoints: nothing hides outside the memory."""
    rng = np.random.default_rng(3)
    law = law_of(level=ACTUATOR)
    memory = random_memory(rng, law)
    other = type(memory).from_array(memory.to_array(), law.hidden)
    other.values["wrench"][1] += 0.05
    state, reference = random_state(rng, 0.1), random_reference(rng)
    one = law.step(memory, state, reference, 0.004, RUN).terms.values.torque[0]
    two = law.step(other, state, reference, 0.004, RUN).terms.values.torque[0]
    assert one != two
