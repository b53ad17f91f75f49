"""A control law of one's own in one file: companion fly --sitl px4 --controller examples/my_law.py

PID: no model but the weight. f = K_U (ė + K_p e) + K_i ξ + m̂ g e₃, τ = Φᵀ [K_U Ũ_η + K_i ξ_η].
"""

from companion import register_law
from companion.control.cascade import attitude_errors, begin, finish, position_errors
from companion.control.compiled import compiled


@compiled
def feedback(g, loop):
    """K_U Ũ + K_i ξ of either loop, added to the model term into `loop.total`."""
    for i in range(3):
        loop.proportional_term[i] = g.K_U[i] * loop.U_error[i]  # Ũ = ė + K_p e
        loop.integral_term[i] = g.K_i[i] * loop.integral[i]
        loop.total[i] = loop.proportional_term[i] + loop.integral_term[i] + loop.model_term[i]


@compiled
def step(parameters, memory, inputs, memory_out, terms_out):
    """One control step; the records are those of `companion/control/packing.py`, each in an array of length 1."""
    p, m, x, m_next, t = parameters[0], memory[0], inputs[0], memory_out[0], terms_out[0]
    if not begin(p, m, x, m_next, t):
        return
    sigma_p = position_errors(p, m, x, t)
    t.position.model_term[2] = p.mass_estimate * p.gravity
    feedback(p.position, t.position)
    sigma_eta = attitude_errors(p, m, x, m_next, t, sigma_p)
    feedback(p.attitude, t.attitude)
    finish(p, m, x, m_next, t, sigma_p, sigma_eta)


register_law("my_law", step, "PID with the weight fed forward", gains_of="tlmbc")
