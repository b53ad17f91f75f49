"""Newtons to the number an autopilot calls thrust, and rotor thrusts to actuator controls.

Both autopilots' thrust setpoint is linear in force once their thrust curve (THR_MDL_FAC, MOT_THST_EXPO) is
set right: the curve is undone behind the setpoint. What is left is one scale, known from the setpoint at which
the vehicle hovers: `thrust = F · hover / (m g)`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.control.structs import Vector

GRAVITY = 9.81
LEAST_THRUST = 0.02  # a spinning rotor keeps the autopilot's mixer able to turn the vehicle


@dataclass(frozen=True, slots=True)
class ThrustScale:
    """The scale and the mixer of one vehicle."""

    hover_thrust: float  # normalised setpoint that carries the weight, 0..1
    mass_kg: float  # that is carried then: the true mass, not the assumed m̂
    rotor_max_newton: float  # one rotor at full throttle
    mixer: Vector  # (N, 4): rotor command = mixer @ (roll, pitch, yaw, thrust), FLU; see `mixer_of`
    least: float = LEAST_THRUST  # bounds of flight on the setpoint: the profile's thrust_min_ratio
    most: float = 1.0  # and thrust_max_ratio

    @property
    def full_newton(self) -> float:
        """Total thrust in N at setpoint 1."""
        return self.mass_kg * GRAVITY / self.hover_thrust

    @property
    def bounds_newton(self) -> tuple[float, float]:
        """Least and greatest total thrust in N that a law may ask for by this scale, so that nothing is cut behind it."""
        full = self.full_newton
        return max(self.least, LEAST_THRUST) * full, self.most * full

    def normalised(self, thrust_newton: float) -> float:
        """Setpoint for a total thrust, bounded to [LEAST_THRUST, 1]."""
        return min(1.0, max(LEAST_THRUST, thrust_newton / self.full_newton))

    def newton(self, normalised: float) -> float:
        """Total thrust in N of a setpoint."""
        return normalised * self.full_newton

    def controls(self, rotor_thrust: Vector) -> Vector:
        """(4,) roll, pitch, yaw (FLU, −1..1) and thrust (0..1) that the mixer turns into these rotor thrusts (N)."""
        commands = np.clip(rotor_thrust[: len(self.mixer)] / self.rotor_max_newton, 0.0, 1.0)
        controls, *_ = np.linalg.lstsq(self.mixer, commands, rcond=None)
        return np.clip(controls, (-1.0, -1.0, -1.0, 0.0), 1.0)


def mixer_of(rotor_positions_flu: Vector, rotor_spins: Vector) -> Vector:
    """(N, 4) mixer of PX4 1.13's control group 0, in FLU.

    PX4's mixers (`quad_x`, `quad_plus`) weigh roll and pitch by the direction of each arm and yaw by ±1. A rotor on
    the left (y > 0) rolls to the right with more thrust: positive about x. One in front (x > 0) pitches the nose
    up: negative about y.

    Args:
        rotor_positions_flu: (N, 3) m.
        rotor_spins: (N,) sign of the reaction torque about z up.
    """
    mixer = np.ones((len(rotor_positions_flu), 4))
    for row, (x, y, _), spin in zip(mixer, rotor_positions_flu, rotor_spins, strict=True):
        arm = math.hypot(x, y)
        row[:3] = y / arm, -x / arm, spin
    return mixer
