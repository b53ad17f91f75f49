"""A family of vehicles from 0.25 to 35 kg, drawn from a seed: `random:7` is the same vehicle on every machine.

Sizes follow what is built: arms, propellers and motors that belong to the mass, heavier vehicles with more rotors, less
thrust to spare and slower motors. What is drawn about those trends is as wide as two owners' builds differ. The owner has
tuned the autopilot with sense (`Owner`), but measured nothing exactly.
"""

from __future__ import annotations

import math

import numpy as np

from sitl_stub.physics.vehicle import Owner, VehicleError, VehicleParameters

PREFIX = "random:"
LIGHTEST_KG, HEAVIEST_KG = 0.25, 35.0
QUAD_X_DEG = (45.0, 225.0, 315.0, 135.0)
"""Clockwise from the nose: front right, rear left, front left, rear right, as both autopilots number a quad X."""
QUAD_PLUS_DEG = (90.0, 270.0, 0.0, 180.0)
QUAD_SPIN = (1.0, 1.0, -1.0, -1.0)
FILTERS_S = 0.012
"""Delay of gyro filter, loop and motor driver beside the motors' lag, as far as an owner's tuning feels it, s."""


def random_vehicle(seed: int) -> VehicleParameters:
    """The vehicle of that seed (0 or more). Raises `VehicleError` for a negative one."""
    if seed < 0:
        raise VehicleError(f"vehicle {PREFIX}{seed}: the seed must not be negative")
    draw = np.random.default_rng([seed, 0x5EED])
    mass = float(np.exp(draw.uniform(math.log(LIGHTEST_KG), math.log(HEAVIEST_KG))))
    rotors = _rotor_count(mass, draw)
    arm = 0.17 * mass**0.42 * draw.uniform(0.85, 1.2)
    # neighbouring propeller discs leave a tenth of their diameter free
    radius = min(arm * math.sin(math.pi / rotors) / 1.1, 0.6 * arm)
    thrust_to_weight = draw.uniform(1.7, 2.6) + draw.uniform(0.0, 1.6) / (1.0 + mass / 2.0)
    gravity = 9.80665
    thrust_max = thrust_to_weight * mass * gravity / rotors
    roll, pitch = (mass * arm**2 * draw.uniform(0.16, 0.38) * side for side in draw.uniform(0.9, 1.1, 2))
    yaw = (roll + pitch) * draw.uniform(0.75, 0.95)
    motor_lag = 0.028 * mass**0.25 * draw.uniform(0.8, 1.35)
    curve = draw.uniform(0.0, 0.65)
    hover = mass * gravity / rotors
    drag_1_s = draw.uniform(0.03, 0.2, 2) * (mass**-0.15)
    rotor_drag = draw.uniform(0.05, 0.25) * mass / rotors / math.sqrt(hover / thrust_max)
    cells = int(np.clip(round(3.0 + 1.6 * math.log(mass / 0.5 + 1.0)), 3, 12))
    hover_power = 160.0 * mass * draw.uniform(0.8, 1.3)  # W: 6 g/W and its neighbours
    capacity_mah = hover_power * draw.uniform(12.0, 22.0) / 60.0 / (3.7 * cells) * 1000.0
    foot = arm * draw.uniform(0.6, 0.9)
    return VehicleParameters(
        name=f"{PREFIX}{seed}",
        mass_kg=mass,
        inertia_kg_m2=np.array([roll, pitch, yaw]),
        rotor_position_frd=_places(rotors, arm, draw.uniform() < 0.7),
        rotor_spin=np.array(QUAD_SPIN if rotors == 4 else [1.0, -1.0] * (rotors // 2)),
        max_thrust_newton=np.full(rotors, thrust_max),
        torque_per_thrust_m=2.0 * radius * draw.uniform(0.05, 0.08),
        rotor_lag_rad_s=1.0 / motor_lag,
        thrust_curve=curve,
        linear_drag_kg_s=mass * np.array([drag_1_s[0], drag_1_s[0], drag_1_s[1]]),
        angular_drag_kg_m2_s=np.array([roll, pitch, yaw]) * draw.uniform(0.02, 0.3),
        rotor_drag_kg_s=rotor_drag,
        rotor_radius_m=radius,
        ground_effect=1.0,
        gravity_m_s2=gravity,
        foot_half_length_m=foot,
        foot_half_width_m=foot,
        foot_height_m=0.05 + 0.3 * arm,
        top_height_m=0.04 + 0.2 * arm,
        ground_friction=draw.uniform(0.5, 1.0),
        battery_cells=cells,
        battery_capacity_mah=capacity_mah,
        battery_resistance_ohm=0.05 * (3.7 * cells) ** 2 / hover_power,
        battery_sag=bool(draw.uniform() < 0.3),
        power_per_thrust=hover_power / rotors / hover**1.5,
        idle_current_a=0.4,
        owner=Owner(
            rate_crossover_rad_s=draw.uniform(0.45, 0.75) / (motor_lag + FILTERS_S),
            hover_told=draw.uniform(0.88, 1.12),
            thrust_curve_told=round(float(np.clip(curve + draw.uniform(-0.1, 0.1), 0.0, 0.8)), 2),
        ),
    )


def _rotor_count(mass_kg: float, draw: np.random.Generator) -> int:
    """4, 6 or 8: the heavier, the more."""
    heavy = np.clip(math.log(mass_kg / 1.0) / math.log(20.0), 0.0, 1.0)
    shares = (1.0 - heavy) * np.array([0.85, 0.12, 0.03]) + heavy * np.array([0.2, 0.35, 0.45])
    return int(draw.choice([4, 6, 8], p=shares / shares.sum()))


def _places(rotors: int, arm_m: float, x_frame: bool) -> np.ndarray:
    """Rotors (N, 3) in FRD about the centre: X has the nose between two arms, + along one."""
    if rotors == 4:
        angles = np.radians(QUAD_X_DEG if x_frame else QUAD_PLUS_DEG)
    else:
        angles = (np.arange(rotors) + (0.5 if x_frame else 0.0)) * math.tau / rotors
    return np.column_stack([arm_m * np.cos(angles), arm_m * np.sin(angles), np.zeros(rotors)])
