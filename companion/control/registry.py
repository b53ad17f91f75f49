"""How a law is built: bound to a vehicle, its gains and an output level. Which laws there are: `laws.py`."""

from __future__ import annotations

import math

import numpy as np

from companion.config.errors import UserError
from companion.config.gains import ControllerGains, LoopGains
from companion.config.profile import VehicleProfile
from companion.control.allocation import allocation_matrix
from companion.control.certificates import broken_conditions
from companion.control.law import ControlLaw
from companion.control.laws import LawEntry, law_entry
from companion.control.network import draw_input_weights
from companion.control.packing import parameters_dtype
from companion.control.structs import ControlLevel, Record

LEVEL_NUMBER = {ControlLevel.ATTITUDE: 0, ControlLevel.BODY_RATE: 1, ControlLevel.ACTUATOR: 2}


def build_law(
    name: str,
    gains: ControllerGains,
    profile: VehicleProfile,
    level: ControlLevel,
    seed: int,
    *,
    autopilot: str | None = None,
) -> ControlLaw:
    """Bind the law `name` to a vehicle, its gains and an output level.

    `seed` draws the networks' input matrices V; `autopilot` (`px4`, `ardupilot`) chooses the profile's response
    that the lead makes up for. Raises UserError naming the known laws, or what in the profile does not fit.
    """
    entry = law_entry(name)
    hidden = gains.hidden_neurons
    packed = np.zeros(1, parameters_dtype(hidden))
    p = packed[0]
    _fill_loop(p.position, gains.position_loop, entry)
    _fill_loop(p.attitude, gains.attitude_loop, entry)
    # two networks, two independent streams of one seed
    p.position_V = draw_input_weights(2 * seed, hidden, np.array(gains.position_loop.input_scales))
    p.attitude_V = draw_input_weights(2 * seed + 1, hidden, np.array(gains.attitude_loop.input_scales))
    p.level = LEVEL_NUMBER[level]
    p.model_in_feedback = float(entry.model_in_feedback)
    _fill_vehicle(p, profile)
    _fill_lead(p, gains, profile, autopilot)
    warnings: tuple[str, ...] = ()
    if entry.has_network:
        warnings = broken_conditions(gains, attitude_loop_flies=level is ControlLevel.ACTUATOR)
    return ControlLaw(name, level, seed, hidden, packed, entry.kernel, warnings)


def _fill_loop(g: Record, gains: LoopGains, entry: LawEntry) -> None:
    g.K_e, g.K_U = gains.K_e, gains.K_U
    g.K_i = gains.K_i if entry.has_integral else (0.0, 0.0, 0.0)
    g.alpha = gains.alpha if entry.has_network else 0.0
    g.N = gains.N if entry.has_network else 0.0
    g.boundary_width, g.kappa = gains.boundary_width, gains.kappa
    g.weight_bound, g.integral_bound = gains.weight_bound, gains.integral_bound


def _fill_vehicle(p: Record, profile: VehicleProfile) -> None:
    rotors, limits = profile.rotors, profile.limits
    count = len(rotors.layout)
    try:
        B = allocation_matrix(rotors.arms_m, rotors.spins, rotors.torque_per_newton_m)
    except ValueError as error:
        raise UserError(f"profile {profile.name!r}, rotors.layout: {error}") from None
    p.gravity, p.mass_estimate = profile.gravity_m_s2, profile.mass_estimate_kg
    p.inertia, p.drag = profile.inertia_kg_m2, profile.drag_kg_s
    p.rotational_drag = profile.rotational_drag_kg_m2_s
    p.rotor_count = count
    p.allocation[:, :count] = B
    p.mixer[:count, :] = np.linalg.pinv(B)
    p.rotor_thrust_min, p.rotor_thrust_max = rotors.thrust_min_newton, rotors.thrust_max_newton
    p.thrust_min = limits.thrust_min_ratio * profile.thrust_available_newton
    p.thrust_max = limits.thrust_max_ratio * profile.thrust_available_newton
    p.force_z_min = limits.force_z_min_ratio * profile.mass_estimate_kg * profile.gravity_m_s2
    p.tilt_max, p.tilt_abort = profile.tilt_max_rad, math.radians(limits.tilt_abort_deg)
    p.body_rate_max = np.radians(limits.body_rate_max_deg_s)


def _fill_lead(p: Record, gains: ControllerGains, profile: VehicleProfile, autopilot: str | None) -> None:
    lead, response = gains.lead, profile.response(autopilot)
    axes = (response.tilt, response.tilt, response.yaw)
    p.attitude_lead = [lead.attitude_scale * axis.lag_s for axis in axes]
    p.attitude_lead_2 = [lead.attitude_scale * axis.lag_squared_s2 for axis in axes]
    p.feedback_lead, p.feedback_lead_filter = lead.feedback_s, lead.feedback_filter_s
    p.rate_lead = [lead.rate_scale * lag for lag in response.rate_lag_s]
    p.rotor_lead, p.rotor_lead_filter = lead.rotor_scale / profile.rotors.lag_rad_s, lead.rotor_filter_s
    p.filter_frequency, p.filter_damping = gains.command_filter_rad_s, gains.command_filter_damping
    p.hand_over_time = gains.hand_over_s
    p.beta = gains.lyapunov_beta
