"""The gains of one controller at one output level, each with its unit and the equation it stands in.

Gains belong to a vehicle, a controller and a level together, so they ship in the vehicle's profile as
`[controllers.<name>.<level>.position_loop]` and so on. A controller ignores what it lacks: TLMBC has no network and no
sign term, NNSMC no integral (control_laws.md, section 6).
"""

from __future__ import annotations

from pydantic import Field

from companion.config.model import NotNegative, NotNegative3, Positive, Positive3, SettingsModel


class LoopGains(SettingsModel):
    """One loop, position or attitude: the same law in other units (N and m/s, N·m and rad/s)."""

    K_e: Positive3
    """Outer gain on the error, 1/s: K_p of Eq. (2), K_η of Eq. (21). Order x, y, z; roll, pitch, yaw."""
    K_U: Positive3
    """Inner gain on Ũ: N·s/m in Eq. (13), N·m·s in Eq. (27)."""
    K_i: NotNegative3 = (0.0, 0.0, 0.0)
    """Integral gain on ξ: N/m in Eq. (13), N·m in Eq. (27). 0 switches the axis' integral off."""
    alpha: NotNegative = 0.0
    """α of the sign term, N in Eq. (14), N·m in Eq. (28)."""
    boundary_width: NotNegative = 0.1
    """sign(Ũ) becomes tanh(Ũ / width), width in m/s or rad/s; 0 is the report's exact sign, which chatters."""
    N: NotNegative = 0.0
    """Adaptation gain of Eqs. (15), (29), N²·s/(kg·m) sort of units: how fast Ŵ follows σŨᵀ."""
    kappa: NotNegative = 0.0
    """Leak κ of Eqs. (15), (29), s/m or s/rad: pulls Ŵ back in proportion to ‖Ũ‖."""
    weight_bound: Positive = 20.0
    """W_max: bound on ‖Ŵ‖_F by projection, N or N·m; also W_max of Propositions 1 and 2."""
    integral_bound: Positive = 10.0
    """Bound on ‖K_i ξ‖ by projection, N or N·m."""
    residual_bound: NotNegative = 0.1
    """ε_max of Propositions 1 and 2: what the network cannot explain (approximation, gusts), N or N·m."""
    input_scales: tuple[Positive, Positive, Positive, Positive] = (1.0, 1.0, 1.0, 1.0)
    """Scale of V's rows: for the bias and the three vectors in γ (ṗ, η, U̇_p; or η, η̇, U̇_η). 1/their units."""


class LeadGains(SettingsModel):
    """What makes up for the lag of the autopilot's own loops."""

    attitude_scale: NotNegative = 1.0
    """Share of the profile's attitude response that is inverted on the reference's attitude; 1 is all, 0 none."""
    feedback_s: NotNegative = 0.0
    """Lead on the feedback force at the attitude level, s. As large as noise allows, at most the loop's lag."""
    feedback_filter_s: NotNegative = 0.05
    """Low-pass on the feedback force's derivative, s."""
    rate_scale: NotNegative = 1.0
    """Share of the profile's rate response that is inverted on the desired rate at the body-rate level."""
    rotor_scale: NotNegative = 1.0
    """Share of the rotors' lag that is made up for on thrust (all levels) and torque (actuator level)."""
    rotor_filter_s: Positive = 0.02
    """Low-pass of that lead, s. Shorter than the rotors' lag, or there is no lead."""


class ControllerGains(SettingsModel):
    """All gains of one controller at one level."""

    position_loop: LoopGains
    """Eqs. (2)–(15)."""
    attitude_loop: LoopGains
    """Eqs. (21)–(29). At the attitude level computed for the log only."""
    lead: LeadGains = LeadGains()
    """Lead against the autopilot's lag."""
    command_filter_rad_s: Positive = 12.0
    """Natural frequency of the command filter behind η̇_d, η̈_d, rad/s."""
    command_filter_damping: Positive = 0.8
    """Its damping ratio."""
    hidden_neurons: int = Field(default=10, ge=1, le=256)
    """L, neurons of each network."""
    hand_over_s: Positive = 1.0
    """Time constant with which the difference to the command taken over fades, s."""
    lyapunov_beta: tuple[Positive, Positive] = (1.0, 1.0)
    """β_p, β_η of Eqs. (20), (32). They weigh the logged V and change nothing in flight."""
