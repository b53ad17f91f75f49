"""MAVLink's numbers by name, as common.xml has them: commands and severities. Messages go by their names everywhere."""

from __future__ import annotations

from enum import IntEnum


class MavCommand(IntEnum):
    """MAV_CMD: the commands that a firmware of the stub takes."""

    NAV_LOITER_UNLIM = 17
    NAV_RETURN_TO_LAUNCH = 20
    NAV_LAND = 21
    NAV_TAKEOFF = 22
    DO_ORBIT = 34
    CONDITION_YAW = 115
    DO_SET_MODE = 176
    DO_CHANGE_SPEED = 178
    DO_SET_HOME = 179
    DO_REPOSITION = 192
    DO_SET_MISSION_CURRENT = 224
    PREFLIGHT_CALIBRATION = 241
    PREFLIGHT_REBOOT_SHUTDOWN = 246
    MISSION_START = 300
    COMPONENT_ARM_DISARM = 400
    GET_HOME_POSITION = 410
    GET_MESSAGE_INTERVAL = 510
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512
    REQUEST_AUTOPILOT_CAPABILITIES = 520


class Severity(IntEnum):
    """MAV_SEVERITY."""

    EMERGENCY = 0
    CRITICAL = 2
    WARNING = 4
    NOTICE = 5
    INFO = 6


class ModeFlag(IntEnum):
    """MAV_MODE_FLAG: bits of HEARTBEAT.base_mode and of what asks for a mode."""

    CUSTOM_MODE_ENABLED = 1
    GUIDED_ENABLED = 8
    STABILIZE_ENABLED = 16
    MANUAL_INPUT_ENABLED = 64
    SAFETY_ARMED = 128


class MissionState(IntEnum):
    """MISSION_STATE."""

    NONE = 1
    NOT_STARTED = 2
    ACTIVE = 3
    PAUSED = 4
    COMPLETE = 5


class LandedState(IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class SystemStatus(IntEnum):
    """MAV_STATE."""

    UNINIT = 0
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5


class VehicleType(IntEnum):
    """MAV_TYPE."""

    GENERIC = 0
    QUADROTOR = 2
    HEXAROTOR = 13
    OCTOROTOR = 14
