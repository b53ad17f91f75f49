"""Where each number lies in the packed arrays of ArduCopter's controllers, and how its parameters get there.

The compiled loops take a few float64 arrays; these indices are the only place that knows their layout. SI units and
radians; attitude and rates FRD/NED. The position controller counts up (north, east, up), as ArduPilot's does: UP is −z.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# gains (GAINS_SIZE,): from parameters, constant between parameter changes
ANGLE_P = 0  # 3, 1/s: ATC_ANG_RLL_P ...
ACCEL_MAX = 3  # 3, rad/s²: ATC_ACCEL_R_MAX ...
RATE_MAX = 6  # 3, rad/s, 0: none: ATC_RATE_R_MAX ...
INPUT_TC = 9  # s: ATC_INPUT_TC
FEED_FORWARD = 10  # 0 or 1: ATC_RATE_FF_ENAB
RATE_P = 11  # 3: ATC_RAT_RLL_P ...
RATE_I = 14
RATE_D = 17
RATE_FF = 20
RATE_IMAX = 23
RATE_FLTT = 26  # 3, Hz, 0: none
RATE_FLTE = 29
RATE_FLTD = 32
GYRO_CUTOFF_HZ = 35  # INS_GYRO_FILTER
ANGLE_BOOST = 36  # 0 or 1: ATC_ANGLE_BOOST
THRUST_EXPO = 37  # MOT_THST_EXPO
YAW_HEADROOM = 38  # 0..1: MOT_YAW_HEADROOM / 1000
SPOOL_TIME = 39  # s: MOT_SPOOL_TIME
HOVER_THRUST = 40  # MOT_THST_HOVER
MIX_MIN = 41  # ATC_THR_MIX_MIN
MIX_MAN = 42
MIX_MAX = 43
SLEW_YAW = 44  # rad/s: ATC_SLEW_YAW
SPIN_ARM = 45  # MOT_SPIN_ARM
SPIN_MIN = 46
SPIN_MAX = 47
POSITION_P = 48  # PSC_POSXY_P
VELOCITY_P = 49
VELOCITY_I = 50
VELOCITY_D = 51
VELOCITY_IMAX = 52  # m/s²
VELOCITY_FLTE = 53
VELOCITY_FLTD = 54
HEIGHT_P = 55  # PSC_POSZ_P
CLIMB_P = 56
CLIMB_I = 57
CLIMB_IMAX = 58  # m/s²
CLIMB_FLTE = 59
LIFT_P = 60  # PSC_ACCZ_P, thrust per m/s²
LIFT_I = 61
LIFT_IMAX = 62  # thrust
LIFT_FLTE = 63
JERK_NE = 64  # m/s³: PSC_JERK_XY
JERK_UP = 65
TILT_MAX = 66  # rad: PSC_ANGLE_MAX or ANGLE_MAX
GAINS_SIZE = 67

# setpoint (SETPOINT_SIZE,)
SPOOL = 0
SPOOL_SHUT_DOWN = 0.0
SPOOL_GROUND_IDLE = 1.0
SPOOL_UNLIMITED = 2.0
LATERAL = 1
LATERAL_RELAX = 0.0  # level, heading as it is, integrals empty
LATERAL_QUATERNION = 1.0  # attitude with body rates on top
LATERAL_RATES = 2.0
LATERAL_LEAN = 3.0  # roll, pitch, rate of heading
LATERAL_POSITION = 4.0  # position controller
VERTICAL = 2
VERTICAL_THRUST = 0.0
VERTICAL_POSITION = 1.0  # height controller, by UP_KIND
QUATERNION = 3  # 4, body FRD to NED; turned on by the rates that come with it
RATES = 7  # 3, rad/s
THRUST = 10  # 0..1
NE_KIND = 11
UP_KIND = 12
KIND_POSITION = 1.0  # go there and stop
KIND_TRAJECTORY = 2.0  # position, velocity and acceleration
KIND_VELOCITY = 3.0  # velocity and acceleration
KIND_ACCELERATION = 4.0
POSITION = 13  # 3, north, east, up, m
VELOCITY = 16
ACCELERATION = 19
HEADING_KIND = 22
HEADING_RATE_ONLY = 0.0
HEADING_ANGLE = 1.0
HEADING = 23  # rad, clockwise from north
HEADING_RATE = 24
SPEED_NE = 25  # m/s
ACCEL_NE = 26  # m/s²
SPEED_UP = 27
SPEED_DOWN = 28  # positive
ACCEL_UP = 29
LEAN = 30  # 2, rad: roll, pitch
THROTTLE_MIX = 32  # 0 min, 1 man, 2 max
THROTTLE_CUTOFF_HZ = 33  # of VERTICAL_THRUST; 0: none
IGNORE_DESCENT_LIMIT = 34  # landing: go on down although the motors are at their least
SOFT_LANDING = 35  # it looks like the ground: the place to be held goes to where the vehicle is
SETPOINT_SIZE = 36

# memory (MEMORY_SIZE,): state of the controllers, and what they last asked for
TARGET = 0  # 4, attitude target
TARGET_RATES = 4  # 3, rad/s, in the target's frame
OUT_RATES = 7  # 3, rad/s, what the rate loops follow
PID_TARGET = 10  # 3
PID_ERROR = 13
PID_SLOPE = 16
PID_INTEGRAL = 19
PID_STARTED = 22
GYRO = 23  # 3, filtered
GYRO_DELAY_1 = 26
GYRO_DELAY_2 = 29
OUT_TORQUE = 32  # 3, −1..1
THROTTLE_IN = 35
THROTTLE = 36  # with angle boost
THROTTLE_FILTERED = 37
THROTTLE_AVERAGE_MAX = 38
RPY_MIX = 39
THROTTLE_OUT = 40
SPOOL_STATE = 41
STATE_SHUT_DOWN = 0.0
STATE_GROUND_IDLE = 1.0
STATE_SPOOLING_UP = 2.0
STATE_UNLIMITED = 3.0
STATE_SPOOLING_DOWN = 4.0
SPIN_RATIO = 42
THRUST_MAX = 43
LIMIT_TORQUE = 44  # 3, 1.0: cannot be given in full
LIMIT_LOWER = 47
LIMIT_UPPER = 48
OUT_MOTORS = 49  # 8, 0..1, of the range from spin-min to spin-max
ACTUATORS = 57  # 8, 0..1 of the PWM range
THRUST_ANGLE = 65  # rad, tilt
THRUST_ERROR_ANGLE = 66
NE_ACTIVE = 67
UP_ACTIVE = 68
DESIRED_POSITION = 69  # 3, north, east, up
DESIRED_VELOCITY = 72
DESIRED_ACCELERATION = 75
TARGET_VELOCITY = 78
TARGET_ACCELERATION = 81
LIMIT_VECTOR = 84  # 3
VELOCITY_ERROR = 87  # 3, filtered
VELOCITY_SLOPE = 90  # 3
VELOCITY_INTEGRAL = 93  # 3, m/s²
POSITION_ERROR = 96  # 3
LIFT_ERROR = 99
LIFT_INTEGRAL = 100
MEASURED_LIFT = 101  # m/s², upward acceleration
CUTOFF_HZ = 102
CLIMB_RATIO = 103  # ArduPilot's vel_u_control_ratio
LIFT_STARTED = 104
MEMORY_SIZE = 105

MOTORS_MOST = 8
CENTIDEGREES = math.radians(0.01)


def gains_from_parameters(p: Mapping[str, float]) -> FloatArray:
    """The gains array (GAINS_SIZE,) from ArduCopter's parameters."""
    gains = np.zeros(GAINS_SIZE)
    for axis, (long, short) in enumerate((("RLL", "R"), ("PIT", "P"), ("YAW", "Y"))):
        gains[ANGLE_P + axis] = p[f"ATC_ANG_{long}_P"]
        gains[ACCEL_MAX + axis] = p[f"ATC_ACCEL_{short}_MAX"] * CENTIDEGREES
        gains[RATE_MAX + axis] = math.radians(p[f"ATC_RATE_{short}_MAX"])
        for index, term in (
            (RATE_P, "P"),
            (RATE_I, "I"),
            (RATE_D, "D"),
            (RATE_FF, "FF"),
            (RATE_IMAX, "IMAX"),
            (RATE_FLTT, "FLTT"),
            (RATE_FLTE, "FLTE"),
            (RATE_FLTD, "FLTD"),
        ):
            gains[index + axis] = p[f"ATC_RAT_{long}_{term}"]
    gains[INPUT_TC] = p["ATC_INPUT_TC"]
    gains[FEED_FORWARD] = float(p["ATC_RATE_FF_ENAB"] != 0)
    gains[GYRO_CUTOFF_HZ] = p["INS_GYRO_FILTER"]
    gains[ANGLE_BOOST] = float(p["ATC_ANGLE_BOOST"] != 0)
    gains[THRUST_EXPO] = min(max(p["MOT_THST_EXPO"], 0.0), 1.0)
    gains[YAW_HEADROOM] = p["MOT_YAW_HEADROOM"] * 1e-3
    gains[SPOOL_TIME] = max(p["MOT_SPOOL_TIME"], 0.05)
    gains[HOVER_THRUST] = min(max(p["MOT_THST_HOVER"], 0.125), 0.6875)
    gains[MIX_MIN] = p["ATC_THR_MIX_MIN"]
    gains[MIX_MAN] = p["ATC_THR_MIX_MAN"]
    gains[MIX_MAX] = p["ATC_THR_MIX_MAX"]
    gains[SLEW_YAW] = p["ATC_SLEW_YAW"] * CENTIDEGREES
    gains[SPIN_ARM] = p["MOT_SPIN_ARM"]
    gains[SPIN_MIN] = p["MOT_SPIN_MIN"]
    gains[SPIN_MAX] = p["MOT_SPIN_MAX"]
    gains[POSITION_P] = p["PSC_POSXY_P"]
    gains[VELOCITY_P] = p["PSC_VELXY_P"]
    gains[VELOCITY_I] = p["PSC_VELXY_I"]
    gains[VELOCITY_D] = p["PSC_VELXY_D"]
    gains[VELOCITY_IMAX] = p["PSC_VELXY_IMAX"] * 0.01
    gains[VELOCITY_FLTE] = p["PSC_VELXY_FLTE"]
    gains[VELOCITY_FLTD] = p["PSC_VELXY_FLTD"]
    gains[HEIGHT_P] = p["PSC_POSZ_P"]
    gains[CLIMB_P] = p["PSC_VELZ_P"]
    gains[CLIMB_I] = p["PSC_VELZ_I"]
    gains[CLIMB_IMAX] = p["PSC_VELZ_IMAX"] * 0.01
    gains[CLIMB_FLTE] = p["PSC_VELZ_FLTE"]
    # PSC_ACCZ counts thousandths of thrust per cm/s²
    gains[LIFT_P] = p["PSC_ACCZ_P"] * 0.1
    gains[LIFT_I] = p["PSC_ACCZ_I"] * 0.1
    gains[LIFT_IMAX] = max(p["PSC_ACCZ_IMAX"] * 1e-3, gains[HOVER_THRUST])
    gains[LIFT_FLTE] = p["PSC_ACCZ_FLTE"]
    gains[JERK_NE] = p["PSC_JERK_XY"]
    gains[JERK_UP] = p["PSC_JERK_Z"]
    tilt = p["PSC_ANGLE_MAX"] * 100.0 if p["PSC_ANGLE_MAX"] > 0 else p["ANGLE_MAX"]
    gains[TILT_MAX] = tilt * CENTIDEGREES
    return gains
