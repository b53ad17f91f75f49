"""TLMBC: the two-loop model-based law the report compares with; control_laws.md, section 6.

    f = K_U Ũ_p + K_i ξ_p + m̂(U̇_p + g e₃) + D_p ṗ
    τ = Φᵀ [ K_U Ũ_η + K_i ξ_η + M U̇_η + (C + D_η) η̇ ]

The same loops, filters, bounds and m̂ as DTLANNC; no network and no sign term.
"""

from __future__ import annotations

from companion.control.cascade import attitude_errors, begin, finish, position_errors
from companion.control.compiled import compiled
from companion.control.plant import coriolis_times, mass_matrix_times
from companion.control.structs import Packed, Record


@compiled
def feedback(g: Record, loop: Record) -> None:
    """K_U Ũ + K_i ξ of either loop, added to the model term into `loop.total`."""
    for i in range(3):
        loop.proportional_term[i] = g.K_U[i] * loop.U_error[i]
        loop.integral_term[i] = g.K_i[i] * loop.integral[i]
        loop.total[i] = loop.proportional_term[i] + loop.integral_term[i] + loop.model_term[i]


@compiled
def step(parameters: Packed, memory: Packed, inputs: Packed, memory_out: Packed, terms_out: Packed) -> None:
    """One control step; the records are those of `packing.py`, each in an array of length 1."""
    p, m, x, m_next, t = parameters[0], memory[0], inputs[0], memory_out[0], terms_out[0]
    if not begin(p, m, x, m_next, t):
        return
    sigma_p = position_errors(p, m, x, t)
    for i in range(3):
        t.position.model_term[i] = p.mass_estimate * t.position.U_rate[i] + p.drag[i] * x.velocity[i]
    t.position.model_term[2] += p.mass_estimate * p.gravity
    feedback(p.position, t.position)

    sigma_eta = attitude_errors(p, m, x, m_next, t, sigma_p)
    inertial = mass_matrix_times(t.euler, p.inertia, t.attitude.U_rate)
    coriolis = coriolis_times(t.euler, t.euler_rate, p.inertia, t.euler_rate)
    for i in range(3):
        damping = p.rotational_drag[i] * t.euler_rate[i]
        t.attitude.model_term[i] = inertial[i] + coriolis[i] + damping
    feedback(p.attitude, t.attitude)
    finish(p, m, x, m_next, t, sigma_p, sigma_eta)
