"""NNSMC: adaptive-network sliding mode, the report's other comparison; control_laws.md, section 6.

    s = ė + K e  (which equals Ũ)
    f = K_U s + m̂(U̇_p + g e₃) + Ŵᵀσ_p + α_p sign(s) ,   τ = Φᵀ [ K_U s + Ŵᵀσ_η + α_η sign(s) ]

The same loops, filters, bounds, m̂ and adaptation as DTLANNC; no integral.
"""

from __future__ import annotations

from companion.control.cascade import attitude_errors, begin, finish, network_heading, position_errors
from companion.control.compiled import compiled
from companion.control.network import about_up, output_layer, smooth_sign
from companion.control.structs import Packed, Record, Vector


@compiled
def reaching(g: Record, network: Vector, loop: Record) -> None:
    """K_U s + Ŵᵀσ + α sign(s) of either loop, added to the model term into `loop.total`."""
    for i in range(3):
        loop.proportional_term[i] = g.K_U[i] * loop.U_error[i]
        loop.network_term[i] = network[i]
        loop.sign_term[i] = g.alpha * smooth_sign(loop.U_error[i], g.boundary_width)
        loop.total[i] = (
            loop.proportional_term[i] + loop.model_term[i] + loop.network_term[i] + loop.sign_term[i]
        )


@compiled
def step(parameters: Packed, memory: Packed, inputs: Packed, memory_out: Packed, terms_out: Packed) -> None:
    """One control step; the records are those of `packing.py`, each in an array of length 1."""
    p, m, x, m_next, t = parameters[0], memory[0], inputs[0], memory_out[0], terms_out[0]
    if not begin(p, m, x, m_next, t):
        return
    sigma_p = position_errors(p, m, x, t)
    for i in range(3):
        t.position.model_term[i] = p.mass_estimate * t.position.U_rate[i]
    t.position.model_term[2] += p.mass_estimate * p.gravity
    network = about_up(output_layer(m.position_weights, sigma_p), network_heading(m, x))
    reaching(p.position, network, t.position)

    sigma_eta = attitude_errors(p, m, x, m_next, t, sigma_p)
    reaching(p.attitude, output_layer(m.attitude_weights, sigma_eta), t.attitude)
    finish(p, m, x, m_next, t, sigma_p, sigma_eta)
