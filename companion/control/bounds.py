"""Bounds on what a law may ask for, and the bits that say which of them are active.

A bound that acts is never silent: its bit is in `Terms.flags`, hence in the log and before the
supervisor. Bits marked *saturates* stop the position loop's integral and network for the step.
"""

from __future__ import annotations

import enum
import math

import numpy as np

from companion.control.compiled import compiled
from companion.control.structs import Vector


class Bound(enum.IntFlag):
    """Bits of `Terms.flags`."""

    THRUST_MIN = enum.auto()
    """F raised to the least allowed thrust. Saturates."""
    THRUST_MAX = enum.auto()
    """F cut to the greatest allowed thrust. Saturates."""
    FORCE_Z = enum.auto()
    """f_z raised to its floor; (17), (18) need it positive. Saturates."""
    TILT = enum.auto()
    """Horizontal force cut so that the desired tilt stays within its bound. Saturates."""
    SETPOINT_TILT = enum.auto()
    """The lead asked for more tilt than allowed; only the lead was cut."""
    BODY_RATE = enum.auto()
    """Desired body rate cut to its bound."""
    YAW_TORQUE = enum.auto()
    """Yaw torque cut: first to go when the rotors cannot give everything."""
    ROLL_PITCH_TORQUE = enum.auto()
    """Roll and pitch torque cut: last to go."""
    THRUST_FOR_TORQUE = enum.auto()
    """Total thrust moved so that roll and pitch torque fit between the rotors' bounds."""
    POSITION_WEIGHTS = enum.auto()
    """Projection held ‖Ŵ_p‖_F at its bound."""
    ATTITUDE_WEIGHTS = enum.auto()
    """Projection held ‖Ŵ_η‖_F at its bound."""
    POSITION_INTEGRAL = enum.auto()
    """Projection held ‖K_i ξ_p‖ at its bound."""
    ATTITUDE_INTEGRAL = enum.auto()
    """Projection held ‖K_i ξ_η‖ at its bound."""
    NOT_FINITE = enum.auto()
    """Refused: a NaN or an infinity in state, reference or time step, or a negative time step."""
    TOO_TILTED = enum.auto()
    """Refused: the vehicle is tilted so far that Φ nears its singularity."""


# Plain numbers for machine code.
THRUST_MIN = int(Bound.THRUST_MIN)
THRUST_MAX = int(Bound.THRUST_MAX)
FORCE_Z = int(Bound.FORCE_Z)
TILT = int(Bound.TILT)
SETPOINT_TILT = int(Bound.SETPOINT_TILT)
BODY_RATE = int(Bound.BODY_RATE)
YAW_TORQUE = int(Bound.YAW_TORQUE)
ROLL_PITCH_TORQUE = int(Bound.ROLL_PITCH_TORQUE)
THRUST_FOR_TORQUE = int(Bound.THRUST_FOR_TORQUE)
POSITION_WEIGHTS = int(Bound.POSITION_WEIGHTS)
ATTITUDE_WEIGHTS = int(Bound.ATTITUDE_WEIGHTS)
POSITION_INTEGRAL = int(Bound.POSITION_INTEGRAL)
ATTITUDE_INTEGRAL = int(Bound.ATTITUDE_INTEGRAL)
NOT_FINITE = int(Bound.NOT_FINITE)
TOO_TILTED = int(Bound.TOO_TILTED)
POSITION_SATURATES = THRUST_MIN | THRUST_MAX | FORCE_Z | TILT
ATTITUDE_SATURATES = YAW_TORQUE | ROLL_PITCH_TORQUE | THRUST_FOR_TORQUE


@compiled
def bound_force(force: Vector, force_z_min: float, tilt_max: float) -> int:
    """Keep f (3,) N above its floor and within the tilt cone, in place; the bits of what acted."""
    flags = 0
    if force[2] < force_z_min:
        force[2] = force_z_min
        flags |= FORCE_Z
    horizontal = math.sqrt(force[0] * force[0] + force[1] * force[1])
    allowed = force[2] * math.tan(tilt_max)
    if horizontal > allowed:
        force[0] *= allowed / horizontal
        force[1] *= allowed / horizontal
        flags |= TILT
    return flags


@compiled
def bound_tilt(euler: Vector, tilt_max: float) -> int:
    """Keep roll and pitch of η (3,) within a tilt of `tilt_max` rad, direction kept, in place."""
    upright = abs(euler[0]) < 1.5 and abs(euler[1]) < 1.5
    if upright and math.cos(euler[0]) * math.cos(euler[1]) >= math.cos(tilt_max):
        return 0
    # the horizontal parts of the thrust direction at yaw 0, per unit of its vertical part
    limit = 1.5
    pitch, roll = min(limit, max(-limit, euler[1])), min(limit, max(-limit, euler[0]))
    forward, left = math.tan(pitch), -math.tan(roll) / math.cos(pitch)
    scale = min(1.0, math.tan(tilt_max) / math.sqrt(forward * forward + left * left))
    euler[1] = math.atan(scale * forward)
    euler[0] = math.atan(-scale * left * math.cos(euler[1]))
    return SETPOINT_TILT


@compiled
def bound_each(vector: Vector, limit: Vector, bit: int) -> int:
    """Keep every component of `vector` (3,) within ± `limit` (3,), in place; `bit` where one was cut."""
    flags = 0
    for i in range(3):
        if abs(vector[i]) > limit[i]:
            vector[i] = limit[i] * np.sign(vector[i])
            flags = bit
    return flags
