"""The non-adaptive fall-back: the same loops, with what the networks gave handed to what stays, without a bump.

The network's vertical force carries weight that m̂ does not know of, so it goes into the integral, as far as its bound
has room. The rest goes into the hand-over force, which fades. Where a loop has no integral its weights are only frozen.
"""

from __future__ import annotations

import math

import numpy as np

from companion.control.law import ControlLaw
from companion.control.packing import Memory, Terms


def without_networks(law: ControlLaw, memory: Memory, terms: Terms) -> Memory:
    """Memory whose next step asks for the force and torque of the step that gave `terms`, networks switched off.

    The attitude network (actuator level) goes into the attitude loop's integral.
    """
    packed = memory.packed.copy()
    fresh, last, gains = packed[0], terms.values, law.parameters
    force = np.array(last.position.network_term)
    g = gains.position
    if g.K_i[2] > 0.0:
        xi = fresh["position_integral"]
        others = float(np.sum((g.K_i[:2] * xi[:2]) ** 2))
        room = math.sqrt(max(0.0, float(g.integral_bound) ** 2 - others))
        held = float(g.K_i[2] * xi[2])
        kept = min(room, max(-room, held + force[2])) - held
        xi[2] += kept / float(g.K_i[2])
        fresh["position_weights"][:, 2] = 0.0
        force[2] -= kept
    else:
        force[2] = 0.0
    fresh["position_weights"][:, :2] = 0.0
    fresh["hand_over_force"] += force
    g = gains.attitude
    if np.all(g.K_i > 0.0):
        xi = fresh["attitude_integral"]
        wanted = g.K_i * xi + last.attitude.network_term
        size = float(np.linalg.norm(wanted))
        if size <= g.integral_bound:
            fresh["attitude_integral"] = wanted / g.K_i
            fresh["attitude_weights"][:, :] = 0.0
    return Memory(packed)
