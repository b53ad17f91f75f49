"""Where each number lies in the packed arrays of the flight controller, and how parameters get there.

The compiled loops take a few float64 arrays; these indices are the only place that knows their layout. NED/FRD,
SI units, radians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# gains (GAINS_SIZE,): from parameters, constant between parameter changes
ATTITUDE_P = 0  # 3: roll, pitch, yaw, 1/s
YAW_WEIGHT = 3
RATE_LIMIT = 4  # 3: rad/s
RATE_P = 7  # 3, already times K
RATE_I = 10
RATE_D = 13
RATE_FF = 16
RATE_INTEGRAL_LIMIT = 19  # 3: normalised torque
GYRO_CUTOFF_HZ = 22
GYRO_D_CUTOFF_HZ = 23
YAW_TORQUE_CUTOFF_HZ = 24
THRUST_MODEL_FACTOR = 25
POSITION_P = 26  # 3: 1/s
VELOCITY_P = 29
VELOCITY_I = 32
VELOCITY_D = 35
VELOCITY_MAX_XY = 38
VELOCITY_MAX_UP = 39
VELOCITY_MAX_DOWN = 40
TILT_MAX = 41
HOVER_THRUST = 42
THRUST_MIN = 43
THRUST_MAX = 44
THRUST_XY_MARGIN = 45
ACCELERATION_DECOUPLED = 46
VELOCITY_D_CUTOFF_HZ = 47
TORQUE_SCALE = 48  # 3: 1 / normalised torque of the autopilot's mixer (see `mixing.py`)
THRUST_MIN_MANUAL = 51
GAINS_SIZE = 52

# setpoint (SETPOINT_SIZE,): what the loops are to follow; KIND selects the level
KIND = 0
KIND_IDLE = 0.0  # rotors at rest
KIND_ATTITUDE = 1.0
KIND_RATES = 2.0
KIND_ACTUATORS = 3.0
KIND_TRAJECTORY = 4.0
QUATERNION = 1  # 4, body to NED, scalar first
YAW_RATE = 5  # rad/s, fed forward in attitude and trajectory
RATES = 6  # 3, rad/s, FRD
THRUST = 9  # 0..1
ACTUATORS = 10  # 4: roll, pitch, yaw, thrust as in actuator control group 0
POSITION = 14  # 3, NED, m; NaN where not controlled
VELOCITY = 17  # 3
ACCELERATION = 20  # 3
YAW = 23  # rad; NaN keeps the present one
OVERRIDE_PERIODS = 24  # control periods for which the rates below win over the attitude loop; counts down
OVERRIDE_RATES = 25  # 3, rad/s
OVERRIDE_THRUST = 28  # 0..1
SETPOINT_SIZE = 29
ALWAYS = 1e9  # periods: attitude and rates given together (mask 0)

# memory (MEMORY_SIZE,): state of the controllers, and what they last asked for
RATE_INTEGRAL = 0
GYRO_DELAY_1 = 3
GYRO_DELAY_2 = 6
RATE_FILTERED = 9
RATE_ACCELERATION = 12
YAW_TORQUE_FILTERED = 15
SATURATED_HIGH = 16  # 3
SATURATED_LOW = 19  # 3
VELOCITY_INTEGRAL = 22
VELOCITY_PREVIOUS = 25
VELOCITY_SLOPE = 28
OUT_QUATERNION = 31  # 4
OUT_RATES = 35  # 3
OUT_THRUST = 38
OUT_TORQUE = 39  # 3, normalised
OUT_MOTORS = 42  # 8
OUT_ACCELERATION = 50  # 3, NED, of the position controller
OUT_VELOCITY = 53  # 3, NED
STEPS_TO_POSITION = 56
STARTED = 57
TRAJECTORY_RUNNING = 58
OUT_THRUST_NED = 59  # 3
MEMORY_SIZE = 62

MOTORS_MOST = 8
POSITION_PERIOD_STEPS_HZ = 100.0


def gains_from_parameters(parameters: Mapping[str, float], torque_scale: FloatArray) -> FloatArray:
    """The gains array from PX4 parameters; `torque_scale` (3,) adapts the rate loops to another mixer's normalisation."""
    p = parameters
    gains = np.zeros(GAINS_SIZE)
    yaw_weight = min(max(p["MC_YAW_WEIGHT"], 0.0), 1.0)
    gains[ATTITUDE_P : ATTITUDE_P + 3] = (
        p["MC_ROLL_P"],
        p["MC_PITCH_P"],
        p["MC_YAW_P"] / yaw_weight if yaw_weight > 1e-4 else p["MC_YAW_P"],
    )
    gains[YAW_WEIGHT] = yaw_weight
    for axis, name in enumerate(("ROLL", "PITCH", "YAW")):
        gains[RATE_LIMIT + axis] = math.radians(p[f"MC_{name}RATE_MAX"])
        scale = p[f"MC_{name}RATE_K"]
        gains[RATE_P + axis] = scale * p[f"MC_{name}RATE_P"]
        gains[RATE_I + axis] = scale * p[f"MC_{name}RATE_I"]
        gains[RATE_D + axis] = scale * p[f"MC_{name}RATE_D"]
        gains[RATE_FF + axis] = p[f"MC_{name}RATE_FF"]
        gains[RATE_INTEGRAL_LIMIT + axis] = p[f"MC_{name[0]}R_INT_LIM"]
    gains[TORQUE_SCALE : TORQUE_SCALE + 3] = torque_scale
    gains[GYRO_CUTOFF_HZ] = p["IMU_GYRO_CUTOFF"]
    gains[GYRO_D_CUTOFF_HZ] = p["IMU_DGYRO_CUTOFF"]
    gains[YAW_TORQUE_CUTOFF_HZ] = p.get("MC_YAW_TQ_CUTOFF", 0.0)
    gains[THRUST_MODEL_FACTOR] = min(max(p["THR_MDL_FAC"], 0.0), 1.0)
    gains[POSITION_P : POSITION_P + 3] = (p["MPC_XY_P"], p["MPC_XY_P"], p["MPC_Z_P"])
    for index, term in ((VELOCITY_P, "P"), (VELOCITY_I, "I"), (VELOCITY_D, "D")):
        horizontal, vertical = p[f"MPC_XY_VEL_{term}_ACC"], p[f"MPC_Z_VEL_{term}_ACC"]
        gains[index : index + 3] = (horizontal, horizontal, vertical)
    gains[VELOCITY_MAX_XY] = p["MPC_XY_VEL_MAX"]
    gains[VELOCITY_MAX_UP] = p["MPC_Z_VEL_MAX_UP"]
    gains[VELOCITY_MAX_DOWN] = p["MPC_Z_VEL_MAX_DN"]
    gains[TILT_MAX] = math.radians(p["MPC_TILTMAX_AIR"])
    gains[HOVER_THRUST] = min(max(p["MPC_THR_HOVER"], 0.05), 0.9)
    gains[THRUST_MIN] = p["MPC_THR_MIN"]
    gains[THRUST_MAX] = p["MPC_THR_MAX"]
    gains[THRUST_XY_MARGIN] = p["MPC_THR_XY_MARG"]
    gains[ACCELERATION_DECOUPLED] = p.get("MPC_ACC_DECOUPLE", 0.0)
    gains[VELOCITY_D_CUTOFF_HZ] = p["MPC_VELD_LP"]
    return gains
