"""Second-order command filter, discretised exactly: η̇_d and η̈_d of Eqs. (21)–(23) from η_d alone.

    ẍ = ω² (u − x) − 2 ζ ω ẋ

With u held over a step the solution is known in closed form, so the filter is stable and right for
every time step, also the one of 0.3 s after a stalled link.
"""

from __future__ import annotations

import math

import numpy as np

from companion.control.compiled import compiled
from companion.control.structs import Vector


@compiled
def command_filter_transition(natural_frequency: float, damping: float, dt: float) -> Vector:
    """Matrix exponential (2, 2) of the filter over `dt` seconds, on [x − u, ẋ].

    natural_frequency in rad/s, damping as a ratio (under 1 it overshoots; 1 is critical).
    """
    decay = damping * natural_frequency
    square = natural_frequency * natural_frequency - decay * decay
    # c and s solve the oscillator with the decay taken out; near critical damping both forms meet in s → dt
    if square * dt * dt > 1e-8:
        angular = math.sqrt(square)
        c, s = (
            math.exp(-decay * dt) * math.cos(angular * dt),
            math.exp(-decay * dt) * math.sin(angular * dt) / angular,
        )
    elif square * dt * dt < -1e-8:
        angular = math.sqrt(-square)
        slow, fast = math.exp((angular - decay) * dt), math.exp((-angular - decay) * dt)
        c, s = 0.5 * (slow + fast), 0.5 * (slow - fast) / angular
    else:
        c = math.exp(-decay * dt) * (1.0 - 0.5 * square * dt * dt)
        s = math.exp(-decay * dt) * dt * (1.0 - square * dt * dt / 6.0)
    transition = np.empty((2, 2))
    transition[0, 0], transition[0, 1] = c + decay * s, s
    transition[1, 0], transition[1, 1] = -natural_frequency * natural_frequency * s, c - decay * s
    return transition
