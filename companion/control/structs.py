"""The values that pass between the parts of a flight: state, reference, setpoint.

All SI, world ENU (x east, y north, z up), body FLU (x forward, y left, z up), Hamilton quaternions
scalar first, body to world. Euler angles are ZYX: roll, pitch, yaw. MAVLink's NED/FRD never gets
this far; it is converted once in `companion/mavlink/frames.py`.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

Record = Any
"""A NumPy record of `packing.py`: its fields are attributes, which no type checker can see."""

Packed = NDArray[np.void]
"""An array of length 1 that holds a record: how it crosses into machine code (a bare record takes 5 µs each)."""


class ControlLevel(enum.Enum):
    """What is sent to the autopilot; the deeper the level, the more of the control law runs here.

    `minimum_rate_hz` is the least rate at which setpoints have to go out for the level to be flyable.
    """

    ATTITUDE = "attitude"
    """Thrust and attitude: the autopilot's attitude loop closes. SET_ATTITUDE_TARGET, type_mask 7."""
    BODY_RATE = "body_rate"
    """Thrust and body rates: the autopilot's rate loop closes. SET_ATTITUDE_TARGET, type_mask 128."""
    ACTUATOR = "actuator"
    """Thrust and torque: nothing but the mixer is left to the autopilot. SET_ACTUATOR_CONTROL_TARGET."""

    @property
    def minimum_rate_hz(self) -> float:
        """Least setpoint rate in Hz."""
        return {"attitude": 20.0, "body_rate": 50.0, "actuator": 100.0}[self.value]


@dataclass(frozen=True, slots=True)
class VehicleState:
    """The vehicle at one moment, as the control laws see it."""

    time_s: float  # the autopilot's time since boot at which all of this holds
    position_enu: Vector  # (3,) m
    velocity_enu: Vector  # (3,) m/s
    quaternion_wxyz: Vector  # (4,) Hamilton, body FLU to world ENU, unit length
    body_rate_flu: Vector  # (3,) rad/s


@dataclass(frozen=True, slots=True)
class Reference:
    """Where the vehicle should be at one moment, with the derivatives that flatness needs."""

    position_enu: Vector  # (3,) m
    velocity_enu: Vector  # (3,) m/s
    acceleration_enu: Vector  # (3,) m/s²
    jerk_enu: Vector  # (3,) m/s³
    snap_enu: Vector  # (3,) m/s⁴
    yaw_rad: float
    yaw_rate_rad_s: float
    yaw_acceleration_rad_s2: float


@dataclass(frozen=True, slots=True)
class Setpoint:
    """What a control law asks for. Fields beyond the level in use hold what the law computed on the way."""

    level: ControlLevel
    thrust_newton: float  # total thrust along body z
    quaternion_wxyz: Vector  # (4,) desired attitude, body FLU to world ENU
    body_rate_flu: Vector  # (3,) rad/s desired body rate
    torque_flu: Vector  # (3,) N·m desired body torque


class AdaptationGate(enum.IntEnum):
    """What the law's memory (integrals and network weights) may do in a step; the output comes either way.

    The order is from free to bound, so that of several opinions the greatest counts: `max(gates)`.
    """

    RUN = 0
    """Normal flight: integrals and weights run, each stopped by itself where its own loop saturates."""
    FREEZE_WEIGHTS = 1
    """Integrals run, weights keep their value: the non-adaptive fall-back of the supervisor."""
    FREEZE = 2
    """Integrals and weights keep their values: stale data, a pilot at the sticks, an overrun loop."""
    GROUND = 3
    """On the ground or spooling up: integrals and weights are held at zero and start clean at lift-off."""
