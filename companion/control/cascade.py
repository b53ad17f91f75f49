"""The two-loop cascade that all laws share: all but the forces and torques themselves.

A law's `step` reads, from top to bottom:

    if not begin(p, m, x, m_next, t): return          refuse what no law may answer
    sigma_p = position_errors(p, m, x, t)             Eqs. (2)–(7), σ_p
    ... the law's own force f ...                     Eq. (13)
    sigma_eta = attitude_errors(p, m, x, m_next, t, sigma_p)   Eqs. (16)–(18), (21)–(23), σ_η
    ... the law's own torque, before Φᵀ ...           Eq. (27)
    finish(p, m, x, m_next, t, sigma_p, sigma_eta)    bounds, allocation, memory: Eqs. (15), (29)

p, m, x, m_next, t are the records of `packing.py`: parameters, memory, inputs, next memory, terms. So the laws
differ only in what is said in their files, and a comparison between them compares just that.
"""

from __future__ import annotations

import math

import numpy as np

from companion.control.allocation import allocate
from companion.control.bounds import (
    ATTITUDE_INTEGRAL,
    ATTITUDE_SATURATES,
    ATTITUDE_WEIGHTS,
    BODY_RATE,
    NOT_FINITE,
    POSITION_INTEGRAL,
    POSITION_SATURATES,
    POSITION_WEIGHTS,
    THRUST_MAX,
    THRUST_MIN,
    TOO_TILTED,
    bound_each,
    bound_force,
    bound_tilt,
)
from companion.control.command_filter import command_filter_transition
from companion.control.compiled import compiled
from companion.control.flatness import euler_from_force, flat_attitude
from companion.control.lyapunov import lyapunov
from companion.control.network import about_up, adapt, attitude_feature, frobenius_norm, hidden_layer
from companion.control.plant import mass_matrix_times
from companion.control.rotation import (
    euler_from_quaternion,
    inverse_rate_matrix,
    quaternion_from_euler,
    rate_matrix,
    thrust_direction,
    times,
    transposed_times,
    wrap_angle,
)
from companion.control.structs import AdaptationGate, Record, Vector

ATTITUDE, BODY_RATE_LEVEL, ACTUATOR = 0, 1, 2
RUN = float(AdaptationGate.RUN)
FREEZE_WEIGHTS = float(AdaptationGate.FREEZE_WEIGHTS)
GROUND = float(AdaptationGate.GROUND)


@compiled
def _finite(x: Record) -> bool:
    total = (
        x.thrust_min
        + x.thrust_max
        + x.dt
        + x.gate
        + x.reference_yaw
        + x.reference_yaw_rate
        + x.reference_yaw_acceleration
    )
    for i in range(3):
        total += x.position[i] + x.velocity[i] + x.body_rate[i] + x.quaternion[i]
        total += x.reference_position[i] + x.reference_velocity[i] + x.reference_acceleration[i]
        total += x.reference_jerk[i] + x.reference_snap[i]
    norm = x.quaternion[0] ** 2 + x.quaternion[1] ** 2 + x.quaternion[2] ** 2 + x.quaternion[3] ** 2
    return math.isfinite(total) and x.dt >= 0.0 and x.thrust_min < x.thrust_max and abs(norm - 1.0) < 0.01


@compiled
def begin(p: Record, m: Record, x: Record, m_next: Record, t: Record) -> bool:
    """Copy the memory, find η and η̇; False, with the reason in `t.bounds`, where no setpoint may be made."""
    m_next.position_integral[:] = m.position_integral
    m_next.position_weights[:, :] = m.position_weights
    m_next.attitude_integral[:] = m.attitude_integral
    m_next.attitude_weights[:, :] = m.attitude_weights
    m_next.filter_angle[:] = m.filter_angle
    m_next.filter_rate[:] = m.filter_rate
    m_next.feedback_rate[:] = m.feedback_rate
    m_next.wrench[:] = m.wrench
    m_next.hand_over_force[:] = m.hand_over_force
    m_next.hand_over_yaw = m.hand_over_yaw
    m_next.started = m.started
    if not _finite(x):
        t.bounds |= NOT_FINITE
        return False
    t.euler[:] = euler_from_quaternion(x.quaternion)
    if math.cos(t.euler[0]) * math.cos(t.euler[1]) < math.cos(p.tilt_abort):
        t.bounds |= TOO_TILTED
        return False
    t.euler_rate[:] = times(rate_matrix(t.euler), x.body_rate)
    return True


@compiled
def _outer_loop(
    g: Record, desired_rate: Vector, rate: Vector, desired_acceleration: Vector, loop: Record
) -> None:
    """U = ẋ_d + K e, Ũ = U − ẋ, U̇ = ẍ_d + K ė, ė = ẋ_d − ẋ from an error already in `loop`. Eqs. (2)–(7), (21)–(23)."""
    for i in range(3):
        loop.error_rate[i] = desired_rate[i] - rate[i]
        loop.U[i] = desired_rate[i] + g.K_e[i] * loop.error[i]
        loop.U_error[i] = loop.U[i] - rate[i]
        loop.U_rate[i] = desired_acceleration[i] + g.K_e[i] * loop.error_rate[i]


@compiled
def network_heading(m: Record, x: Record) -> float:
    """By how much the position network's axes are turned from ENU, rad: with the desired heading, north is 0.

    V is random, so a network on the world's axes is another one in each heading, and flies otherwise: NNSMC's RMS
    differed by a factor of two. With axes that go with ψ_d the proof stays as it is, since Ũᵀ R Ŵᵀσ = (RᵀŨ)ᵀ Ŵᵀσ. Gains
    have been found with the nose to the north, where these axes are ENU.
    """
    return x.reference_yaw + m.hand_over_yaw - 0.5 * math.pi  # type: ignore[no-any-return]


@compiled
def position_network(p: Record, m: Record, x: Record, t: Record) -> Vector:
    """σ_p (L,) of γ_p = [1, ṗ, η, U̇_p], Eq. (11), ṗ and U̇_p along the network's own axes."""
    back = -network_heading(m, x)
    angles = attitude_feature(t.euler, x.reference_yaw + m.hand_over_yaw)
    return hidden_layer(p.position_V, about_up(x.velocity, back), angles, about_up(t.position.U_rate, back))


@compiled
def position_errors(p: Record, m: Record, x: Record, t: Record) -> Vector:
    """Errors and virtual control of the position loop, Eqs. (2)–(7); σ_p (L,) of γ_p = [1, ṗ, η, U̇_p], Eq. (11)."""
    loop = t.position
    for i in range(3):
        loop.error[i] = x.reference_position[i] - x.position[i]
        loop.integral[i] = m.position_integral[i]
    _outer_loop(p.position, x.reference_velocity, x.velocity, x.reference_acceleration, loop)
    loop.weight_norm = frobenius_norm(m.position_weights)
    momentum = np.empty(3)
    for i in range(3):
        momentum[i] = p.mass_estimate * loop.U_error[i]
    g = p.position
    loop.lyapunov = lyapunov(
        loop.error, loop.U_error, momentum, loop.integral, g.K_i, loop.weight_norm, g.N, p.beta[0]
    )
    return position_network(p, m, x, t)


@compiled
def _feedback_rate(p: Record, x: Record, t: Record, sigma: Vector) -> Vector:
    """Derivative (3,) N/s of the feedback in f, from the model instead of from differences of noisy velocities.

    The horizontal acceleration is read off the attitude: (g + p̈_d,z) r₃,xy / r₃,z needs no mass and no
    accelerometer. The vertical one is left out, since thrust needs no lead.
    """
    g = p.position
    loop = t.position
    direction = thrust_direction(t.euler)
    learning = 0.0
    for j in range(sigma.size):
        learning += g.N * sigma[j] * sigma[j]
    rate = np.zeros(3)
    for i in range(2):
        acceleration = (p.gravity + x.reference_acceleration[2]) * direction[i] / direction[2]
        slope = g.K_U[i]
        if g.boundary_width > 0.0:
            slope += g.alpha / g.boundary_width / math.cosh(loop.U_error[i] / g.boundary_width) ** 2
        rate[i] = slope * (loop.U_rate[i] - acceleration) + (g.K_i[i] + learning) * loop.U_error[i]
        model = p.model_in_feedback * p.mass_estimate * g.K_e[i]
        rate[i] += model * (x.reference_acceleration[i] - acceleration)
    return rate


@compiled
def _point_thrust(p: Record, m: Record, x: Record, m_next: Record, t: Record, sigma: Vector) -> None:
    """From f to thrust and desired attitude, bounds and lead included. Eqs. (16)–(18).

    At the attitude level the autopilot's loop lags like a second-order system, so it is sent not η_d but what
    makes such a system follow η_d: η_d + lead·η̇ + lead₂·η̈ on the reference's own attitude, which is exact, and a lead
    on the derivative of the feedback force, which is filtered.
    """
    fade = math.exp(-x.dt / p.hand_over_time)
    for i in range(3):
        t.hand_over_force[i] = m.hand_over_force[i]
        m_next.hand_over_force[i] = m.hand_over_force[i] * fade
        t.force[i] = t.position.total[i] + t.hand_over_force[i]
    m_next.hand_over_yaw = m.hand_over_yaw * fade
    yaw = x.reference_yaw + m.hand_over_yaw
    t.bounds |= bound_force(t.force, p.force_z_min, p.tilt_max)
    t.thrust_wanted = t.force[2] / (math.cos(t.euler[0]) * math.cos(t.euler[1]))
    t.euler_desired[:] = euler_from_force(t.force, yaw)

    rows = flat_attitude(
        x.reference_acceleration,
        x.reference_jerk,
        x.reference_snap,
        x.reference_yaw,
        x.reference_yaw_rate,
        x.reference_yaw_acceleration,
        p.gravity,
    )
    t.flat_euler[:], t.flat_euler_rate[:], t.flat_euler_acceleration[:] = rows[0], rows[1], rows[2]

    raw = _feedback_rate(p, x, t, sigma)
    weight = 1.0
    if m.started > 0.0 and p.feedback_lead_filter > 0.0:
        weight = -math.expm1(-x.dt / p.feedback_lead_filter)
    led = np.empty(3)
    for i in range(3):
        m_next.feedback_rate[i] = m.feedback_rate[i] + weight * (raw[i] - m.feedback_rate[i])
        t.feedback_lead_force[i] = p.feedback_lead * m_next.feedback_rate[i]
        led[i] = t.force[i] + t.feedback_lead_force[i]
    t.euler_setpoint[:] = euler_from_force(led, yaw)
    for i in range(3):
        t.euler_setpoint[i] += (
            p.attitude_lead[i] * t.flat_euler_rate[i] + p.attitude_lead_2[i] * t.flat_euler_acceleration[i]
        )
    t.bounds |= bound_tilt(t.euler_setpoint, p.tilt_max)


@compiled
def _desired_rates(p: Record, m: Record, x: Record, m_next: Record, t: Record) -> None:
    """η̇_d and η̈_d: exact for the reference's share of η_d, a second-order command filter for the rest."""
    transition = command_filter_transition(p.filter_frequency, p.filter_damping, x.dt)
    for i in range(3):
        rest = wrap_angle(t.euler_desired[i] - t.flat_euler[i])
        angle, rate = m.filter_angle[i], m.filter_rate[i]
        if m.started == 0.0:
            angle, rate = rest, 0.0
        gap = angle - rest
        m_next.filter_angle[i] = rest + transition[0, 0] * gap + transition[0, 1] * rate
        m_next.filter_rate[i] = transition[1, 0] * gap + transition[1, 1] * rate
        # the mean over the step: at its end, ẍ would miss half of what the held input stepped by
        acceleration = (m_next.filter_rate[i] - rate) / x.dt if x.dt > 0.0 else 0.0
        t.euler_rate_desired[i] = t.flat_euler_rate[i] + m_next.filter_rate[i]
        t.euler_acceleration_desired[i] = t.flat_euler_acceleration[i] + acceleration


@compiled
def attitude_errors(p: Record, m: Record, x: Record, m_next: Record, t: Record, sigma: Vector) -> Vector:
    """Thrust and η_d from f, then the attitude loop's errors, Eqs. (16)–(18), (21)–(23); σ_η (L,), Eq. (26)."""
    _point_thrust(p, m, x, m_next, t, sigma)
    _desired_rates(p, m, x, m_next, t)
    loop = t.attitude
    for i in range(3):
        loop.error[i] = wrap_angle(t.euler_desired[i] - t.euler[i])
        loop.integral[i] = m.attitude_integral[i]
    _outer_loop(p.attitude, t.euler_rate_desired, t.euler_rate, t.euler_acceleration_desired, loop)
    loop.weight_norm = frobenius_norm(m.attitude_weights)
    g = p.attitude
    momentum = mass_matrix_times(t.euler, p.inertia, loop.U_error)
    loop.lyapunov = lyapunov(
        loop.error, loop.U_error, momentum, loop.integral, g.K_i, loop.weight_norm, g.N, p.beta[1]
    )
    angles = attitude_feature(t.euler, t.euler_desired[2])
    return hidden_layer(p.attitude_V, angles, t.euler_rate, loop.U_rate)


@compiled
def _integrate(g: Record, integral: Vector, U_error: Vector, dt: float, out: Vector, bit: int) -> int:
    """ξ̇ = Ũ over a step into `out` (3,), ‖K_i ξ‖ projected on its bound; `bit` where that acted."""
    size = 0.0
    for i in range(3):
        out[i] = integral[i] + dt * U_error[i] if g.K_i[i] > 0.0 else 0.0
        size += (g.K_i[i] * out[i]) ** 2
    size = math.sqrt(size)
    if size <= g.integral_bound:
        return 0
    for i in range(3):
        out[i] *= g.integral_bound / size
    return bit


@compiled
def _learn(
    g: Record,
    x: Record,
    U_error: Vector,
    network_error: Vector,
    sigma: Vector,
    xi: Vector,
    W: Vector,
    xi_next: Vector,
    W_next: Vector,
) -> tuple[bool, bool]:
    """One loop's memory after the step; whether the projections of integral and weights acted.

    `network_error` (3,) is Ũ along the network's axes.
    """
    integral_held = _integrate(g, xi, U_error, x.dt, xi_next, 1) > 0
    weights_held = False
    if x.gate == RUN:
        weights_held = adapt(W, sigma, network_error, g.N, g.kappa, g.weight_bound, x.dt, W_next)
    return integral_held, weights_held


@compiled
def _actuate(p: Record, m: Record, x: Record, m_next: Record, t: Record) -> None:
    """Thrust and torque for the rotors: the lead against their lag, bounds, allocation.

    The rotors follow like 1/(lag s + 1), so they are sent (lag s + 1)/(filter s + 1) of what is wanted.
    """
    t.torque_wanted[:] = transposed_times(rate_matrix(t.euler), t.attitude.total)
    wrench = np.empty(4)
    wrench[0] = min(x.thrust_max, max(x.thrust_min, t.thrust_wanted))
    wrench[1:] = t.torque_wanted
    weight, ratio = 1.0, 1.0
    if m.started > 0.0 and p.rotor_lead > p.rotor_lead_filter:
        weight = -math.expm1(-x.dt / p.rotor_lead_filter)
        ratio = p.rotor_lead / p.rotor_lead_filter
    for i in range(4):
        m_next.wrench[i] = m.wrench[i] + weight * (wrench[i] - m.wrench[i])
        wrench[i] = m_next.wrench[i] + ratio * (wrench[i] - m_next.wrench[i])
    t.thrust = min(x.thrust_max, max(x.thrust_min, wrench[0]))
    # what the bounds took, off the thrust wanted or off its lead, is known here and nowhere later
    if t.thrust_wanted > x.thrust_max or wrench[0] > x.thrust_max:
        t.bounds |= THRUST_MAX
    if t.thrust_wanted < x.thrust_min or wrench[0] < x.thrust_min:
        t.bounds |= THRUST_MIN
    got = np.empty(4)
    low, high = p.rotor_thrust_min, p.rotor_thrust_max
    cut = allocate(p.mixer, p.rotor_count, low, high, t.thrust, wrench[1:], t.rotor_thrust, got)
    t.torque[:] = got[1:]
    if p.level == ACTUATOR:
        t.thrust = got[0]
        t.bounds |= cut
    m_next.started = 1.0


@compiled
def finish(
    p: Record, m: Record, x: Record, m_next: Record, t: Record, sigma_p: Vector, sigma_eta: Vector
) -> None:
    """Setpoints of every level from the two totals, allocation, and the memory for the next step.

    Integrals and weights stand still where the gate says so and where their own loop saturates; the
    attitude loop's learn at the actuator level only, elsewhere their torque reaches no rotor.
    """
    t.quaternion[:] = quaternion_from_euler(t.euler_setpoint if p.level == ATTITUDE else t.euler_desired)
    to_body = inverse_rate_matrix(t.euler)
    t.body_rate[:] = times(to_body, t.attitude.U)
    angular_acceleration = times(to_body, t.flat_euler_acceleration)
    for i in range(3):
        t.body_rate[i] += p.rate_lead[i] * angular_acceleration[i]
    t.bounds |= bound_each(t.body_rate, p.body_rate_max, BODY_RATE)

    _actuate(p, m, x, m_next, t)

    if x.gate == GROUND:
        m_next.position_integral[:] = 0.0
        m_next.position_weights[:, :] = 0.0
        m_next.attitude_integral[:] = 0.0
        m_next.attitude_weights[:, :] = 0.0
    elif x.gate <= FREEZE_WEIGHTS:
        if not t.bounds & POSITION_SATURATES:
            held = _learn(
                p.position,
                x,
                t.position.U_error,
                about_up(t.position.U_error, -network_heading(m, x)),
                sigma_p,
                m.position_integral,
                m.position_weights,
                m_next.position_integral,
                m_next.position_weights,
            )
            t.bounds |= POSITION_INTEGRAL * held[0] | POSITION_WEIGHTS * held[1]
        if p.level == ACTUATOR and not t.bounds & ATTITUDE_SATURATES:
            held = _learn(
                p.attitude,
                x,
                t.attitude.U_error,
                t.attitude.U_error,
                sigma_eta,
                m.attitude_integral,
                m.attitude_weights,
                m_next.attitude_integral,
                m_next.attitude_weights,
            )
            t.bounds |= ATTITUDE_INTEGRAL * held[0] | ATTITUDE_WEIGHTS * held[1]
