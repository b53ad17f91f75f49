"""Keeping a vehicle level when the control law does not fly it: idle on the ground, at lift-off, and at the flight's end.

A proportional-derivative law on the attitude alone, at the level that is flown. The level is not changed over at
lift-off, since PX4 looks only twice a second at which kind of setpoint comes: for that long it would go on with
the last one of the other kind, at a thrust above hover.
"""

from __future__ import annotations

import numpy as np

from companion.control.rotation import quaternion_product
from companion.control.structs import ControlLevel, Setpoint, Vector, VehicleState

TILT_RATE_GAIN = 5.0
"""Desired body rate per attitude error about x and y, 1/s: between the attitude loops of PX4 (6.5) and slow vehicles."""
YAW_RATE_GAIN = 2.0
"""The same about z, 1/s."""
TORQUE_BANDWIDTH_RAD_S = 10.0
"""Bandwidth of the rate error's correction by torque, rad/s."""


def level_setpoint(
    level: ControlLevel,
    state: VehicleState,
    wanted_wxyz: Vector,
    thrust_newton: float,
    inertia_kg_m2: Vector,
    body_rate_max_rad_s: Vector,
) -> Setpoint:
    """What brings the vehicle to the attitude `wanted_wxyz` (4,) and keeps it there, at `level`.

    Args:
        level: of the setpoint.
        state: the vehicle as it is.
        wanted_wxyz: (4,) attitude, body FLU to world ENU.
        thrust_newton: total thrust; without any, no torque is asked for either.
        inertia_kg_m2: (3,) diagonal.
        body_rate_max_rad_s: (3,) beyond which no rate is asked for.
    """
    conjugate = state.quaternion_wxyz * np.array([1.0, -1.0, -1.0, -1.0])
    gap = quaternion_product(conjugate, wanted_wxyz)
    error = 2.0 * gap[1:] * (1.0 if gap[0] >= 0.0 else -1.0)
    wished = error * np.array([TILT_RATE_GAIN, TILT_RATE_GAIN, YAW_RATE_GAIN])
    rate = np.clip(wished, -body_rate_max_rad_s, body_rate_max_rad_s)
    torque = np.zeros(3)
    if thrust_newton > 0.0:
        torque = TORQUE_BANDWIDTH_RAD_S * inertia_kg_m2 * (rate - state.body_rate_flu)
    return Setpoint(level, thrust_newton, wanted_wxyz, rate, torque)
