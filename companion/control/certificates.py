"""The conditions of Propositions 1 and 2, checked on a configuration before it flies.

Both loops follow from `κ‖Ũ‖ tr(W̃ᵀŴ) ≤ κ‖Ũ‖ W_max²/4`: the Lyapunov functions (20), (32) fall while

    α ≥ κ W_max²/4 + ε_max

The report's `α_p ≥ κ_p W_P² + ε_P` is the stricter form; (32)'s proposition is garbled (control_laws.md, section 5).
A configuration that breaks the condition is flown only with a warning that names both sides in numbers.

With the exact sign and the condition met V falls wherever Ũ is not zero. With a boundary layer Ũ tanh(Ũ/w) falls short of
|Ũ| by up to 0.2785 w on each axis, so what is proven is that V falls while ‖Ũ‖ is above the layer r of

    λ_min(K_U) r² + (α − κ W_max²/4 − ε_max) r = 3 · 0.2785 α w

which exists for a broken condition too, only larger. Proven of the continuous law with true thrust, not of the
autopilot's lag.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.config.gains import ControllerGains, LoopGains

TANH_SHORTFALL = 0.2785
"""Greatest of |x| − x tanh(x), where it lies at x = 0.6392."""


@dataclass(frozen=True, slots=True)
class Condition:
    """One proposition's condition with its numbers."""

    proposition: int  # 1 position, 2 attitude
    alpha: float  # left side, N or N·m
    needed: float  # right side κ W_max²/4 + ε_max
    needed_strict: float  # the report's κ W_max² + ε_max
    unit: str
    K_U: float  # least inner gain
    boundary_width: float  # m/s or rad/s; 0 is the exact sign

    @property
    def holds(self) -> bool:
        """Whether the condition is met: errors go to zero with the exact sign, into `layer` with a boundary layer."""
        return self.alpha >= self.needed

    @property
    def strict(self) -> bool:
        """Whether the report's stricter form holds as well."""
        return self.alpha >= self.needed_strict

    @property
    def layer(self) -> float:
        """‖Ũ‖ above which V is proven to fall, m/s or rad/s; 0 is proven convergence to zero."""
        spare = self.alpha - self.needed
        shortfall = 3.0 * TANH_SHORTFALL * self.alpha * self.boundary_width
        return (math.sqrt(spare * spare + 4.0 * self.K_U * shortfall) - spare) / (2.0 * self.K_U)

    def warning(self) -> str:
        """A sentence with both sides in numbers."""
        loop = "position" if self.proposition == 1 else "attitude"
        return (
            f"Proposition {self.proposition} is not met in the {loop} loop: alpha = {self.alpha:.4g} {self.unit} is below "
            f"kappa·weight_bound²/4 + residual_bound = {self.needed:.4g} {self.unit}; proven is "
            f"only that ‖Ũ‖ goes back to below {self.layer:.3g} {'m/s' if self.proposition == 1 else 'rad/s'}"
        )


def condition(gains: LoopGains, proposition: int) -> Condition:
    """The condition of Proposition 1 (position loop) or 2 (attitude loop)."""
    pull = gains.kappa * gains.weight_bound**2
    return Condition(
        proposition=proposition,
        alpha=gains.alpha,
        needed=pull / 4.0 + gains.residual_bound,
        needed_strict=pull + gains.residual_bound,
        unit="N" if proposition == 1 else "N·m",
        K_U=min(gains.K_U),
        boundary_width=gains.boundary_width,
    )


def broken_conditions(gains: ControllerGains, *, attitude_loop_flies: bool) -> tuple[str, ...]:
    """Warnings for every broken condition; the attitude loop counts only where its torque is sent."""
    conditions = [condition(gains.position_loop, 1)]
    if attitude_loop_flies:
        conditions.append(condition(gains.attitude_loop, 2))
    return tuple(found.warning() for found in conditions if not found.holds)
