"""What ArduCopter sends: one builder a message, values in wire order. Nothing but HEARTBEAT is sent unasked.

Constants that the stub has no model for (sensor bits, receiver's accuracies) are those of the capture. Positions on the
globe are flat about the place where ArduPilot's simulator starts.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.guided import Guided, Target
from sitl_stub.firmware.ardupilot.modes import Mode
from sitl_stub.firmware.ardupilot.motion_messages import ArduPilotMotion
from sitl_stub.firmware.ardupilot.state import ArduPilotState
from sitl_stub.firmware.common.clock import SIMULATED_EPOCH_US
from sitl_stub.firmware.common.mavlink_ids import (
    LandedState,
    MissionState,
    ModeFlag,
    SystemStatus,
    VehicleType,
)
from sitl_stub.firmware.common.radio import RECEIVER_BIT
from sitl_stub.firmware.common.streams import Builder, StreamRow
from sitl_stub.firmware.common.wire_values import NAN, Values, int16
from sitl_stub.mavlink.codec import LAYOUTS
from sitl_stub.mavlink.links import Link
from sitl_stub.physics import vehicle as body

CAPABILITIES = 64495
FLIGHT_SW_VERSION = 67567616  # 4.7.0 dev
GIT_HASH = b"2598e9d4"
BOARD_UID = b"3d1219c7c4c54040"
ARDUPILOTMEGA = 3
"""MAV_AUTOPILOT."""
TYPE_OF_FRAME_CLASS = {1: VehicleType.QUADROTOR, 2: VehicleType.HEXAROTOR, 3: VehicleType.OCTOROTOR}
ALWAYS_ON = ModeFlag.STABILIZE_ENABLED | ModeFlag.MANUAL_INPUT_ENABLED | ModeFlag.CUSTOM_MODE_ENABLED
MULTICOPTER = 3
# SYS_STATUS bits of the capture
PRESENT, ENABLED, HEALTHY = 0x5371FC0F, 0x52419C0F, 0x47519C0F
GPS_BIT, HEIGHT_CONTROL_BIT, PLACE_CONTROL_BIT = 0x20, 0x2000, 0x4000
AHRS_BIT, LOGGING_BIT, PREARM_BIT = 0x200000, 0x1000000, 0x10000000
# EKF_STATUS_FLAGS
EKF_UNINITIALISED = 1024
EKF_NO_POSITION = 167
EKF_GOOD = 831
EKF_GOOD_LANDED = 831

STREAM_GROUPS: dict[int, tuple[str, ...]] = {
    1: ("RAW_IMU", "SCALED_IMU2", "SCALED_IMU3", "SCALED_PRESSURE", "SCALED_PRESSURE2", "AIRSPEED"),
    2: (
        "SYS_STATUS",
        "POWER_STATUS",
        "MCU_STATUS",
        "MEMINFO",
        "MISSION_CURRENT",
        "GPS_RAW_INT",
        "GPS2_RAW",
        "NAV_CONTROLLER_OUTPUT",
        "FENCE_STATUS",
        "POSITION_TARGET_GLOBAL_INT",
    ),
    3: ("SERVO_OUTPUT_RAW", "RC_CHANNELS"),
    6: ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"),
    10: ("ATTITUDE", "SIMSTATE", "AHRS2", "PID_TUNING"),
    11: ("VFR_HUD",),
    12: (
        "AHRS",
        "SYSTEM_TIME",
        "WIND",
        "RANGEFINDER",
        "DISTANCE_SENSOR",
        "BATTERY_STATUS",
        "OPTICAL_FLOW",
        "MAG_CAL_REPORT",
        "MAG_CAL_PROGRESS",
        "EKF_STATUS_REPORT",
        "VIBRATION",
        "RPM",
        "ESC_TELEMETRY_1_TO_4",
    ),
}
"""MAV_DATA_STREAM number to what REQUEST_DATA_STREAM turns on."""

SILENT = (
    "MEMINFO", "RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "SCALED_PRESSURE2", "SCALED_PRESSURE3", "GPS_RTK",
    "GPS2_RAW", "GPS2_RTK", "FENCE_STATUS", "AHRS2", "AHRS", "WIND", "RANGEFINDER", "DISTANCE_SENSOR", "TERRAIN_REQUEST",
    "TERRAIN_REPORT", "CAMERA_FEEDBACK", "CAMERA_INFORMATION", "CAMERA_SETTINGS", "OPTICAL_FLOW", "MAG_CAL_PROGRESS",
    "MAG_CAL_REPORT", "PID_TUNING", "RPM", "MISSION_ITEM_REACHED", "EFI_STATUS", "GENERATOR_STATUS", "WINCH_STATUS",
    "ESC_TELEMETRY_1_TO_4", "HIGH_LATENCY2", "MCU_STATUS", "RC_CHANNELS_RAW", "ADSB_VEHICLE",
)  # fmt: skip
"""Messages ArduCopter knows and the stub has nothing to say in: an interval is granted, none is sent."""


class ArduPilotMessages:
    """Builders of every message of one vehicle."""

    def __init__(self, state: ArduPilotState, guided: Guided) -> None:
        self.state = state
        self.guided = guided
        self.motion = ArduPilotMotion(state, guided)

    def definitions(self) -> Sequence[StreamRow]:
        """Name, builder, default rates: HEARTBEAT only. Order on the wire within one instant."""
        everywhere = dict.fromkeys(("onboard", "gcs", "tcp"), 1.0)
        table: list[StreamRow] = [("HEARTBEAT", self.heartbeat, everywhere)]
        asked: list[tuple[str, Builder]] = [
            ("SYS_STATUS", self.sys_status),
            ("EXTENDED_SYS_STATE", self.extended_sys_state),
            ("SYSTEM_TIME", self.system_time),
            ("BATTERY_STATUS", self.battery_status),
            ("POWER_STATUS", self.power_status),
            ("HWSTATUS", self.hwstatus),
            ("EKF_STATUS_REPORT", self.ekf_status_report),
            ("VIBRATION", self.vibration),
            ("HOME_POSITION", self.home_position),
            ("GPS_GLOBAL_ORIGIN", self.gps_global_origin),
            ("MISSION_CURRENT", self.mission_current),
            ("NAV_CONTROLLER_OUTPUT", self.nav_controller_output),
            ("GPS_RAW_INT", self.gps_raw_int),
            ("SCALED_PRESSURE", self.scaled_pressure),
            ("RC_CHANNELS", self.motion.rc_channels),
            ("SERVO_OUTPUT_RAW", self.motion.servo_output_raw),
            ("VFR_HUD", self.vfr_hud),
            ("GLOBAL_POSITION_INT", self.global_position_int),
            ("POSITION_TARGET_LOCAL_NED", self.motion.position_target_local_ned),
            ("POSITION_TARGET_GLOBAL_INT", self.motion.position_target_global_int),
            ("ATTITUDE_TARGET", self.motion.attitude_target),
            ("HIGHRES_IMU", self.motion.highres_imu),
            ("SIMSTATE", self.motion.simstate),
            ("SIM_STATE", self.motion.sim_state),
            ("LOCAL_POSITION_NED", self.local_position_ned),
            ("ATTITUDE", self.motion.attitude),
            ("ATTITUDE_QUATERNION", self.motion.attitude_quaternion),
            ("AUTOPILOT_VERSION", self.autopilot_version),
        ]
        table += [(name, build, {}) for name, build in asked]
        table += [(name, self.nothing, {}) for name in SILENT if name in LAYOUTS]
        return table

    @staticmethod
    def nothing(link: Link) -> Values | None:
        """A message the stub has nothing to say in."""
        return None

    # --- status ------------------------------------------------------------------------------------------------
    @property
    def place_controlled(self) -> bool:
        """Whether the horizontal position controller runs."""
        a = self.state
        on_ground = a.ground_control and a.mode is not Mode.RTL
        return on_ground or bool(a.core.setpoint[at.LATERAL] == at.LATERAL_POSITION)

    @property
    def height_controlled(self) -> bool:
        """Whether the height controller runs."""
        a = self.state
        on_ground = a.ground_control and a.mode is not Mode.RTL
        return on_ground or bool(a.core.setpoint[at.VERTICAL] == at.VERTICAL_POSITION)

    def heartbeat(self, link: Link) -> Values:
        """HEARTBEAT: the guided bit tells that the position controller runs, the status that it flies."""
        a = self.state
        base = ALWAYS_ON
        base |= ModeFlag.GUIDED_ENABLED if self.place_controlled else 0
        base |= ModeFlag.SAFETY_ARMED if a.armed else 0
        status = SystemStatus.STANDBY if a.landed else SystemStatus.ACTIVE
        kind = TYPE_OF_FRAME_CLASS.get(int(a.parameters["FRAME_CLASS"]), VehicleType.GENERIC)
        return (a.mode.custom_mode, kind, ARDUPILOTMEGA, base, status, 3)

    def sys_status(self, link: Link) -> Values:
        """SYS_STATUS: sensors, the pre-arm bit (28) for the present mode, battery."""
        a = self.state
        present, enabled, health = PRESENT, ENABLED, HEALTHY
        if a.gps_found:
            present, enabled = present | GPS_BIT, enabled | GPS_BIT
            health |= GPS_BIT if a.core.position_aided else 0
        for bit, on in (
            (HEIGHT_CONTROL_BIT, self.height_controlled),
            (PLACE_CONTROL_BIT, self.place_controlled),
            (AHRS_BIT, a.boot.ahrs_ready),
        ):
            if on:
                enabled |= bit
                health |= bit
        if a.logs:
            enabled |= LOGGING_BIT
        if a.prearm_good:
            health |= PREARM_BIT
        if not a.radio.healthy:
            health &= ~RECEIVER_BIT
        truth = a.core.state
        volts = round(float(truth[body.BATTERY_VOLTAGE]) * 1000)
        current = int16(100.0 * self._current())
        return (
            present,
            enabled,
            health,
            0,
            volts,
            current,
            0,
            0,
            0,
            0,
            0,
            0,
            self._battery_percent(),
            0,
            0,
            0,
        )

    def _current(self) -> float:
        return float(self.state.core.state[body.BATTERY_CURRENT]) if self.state.armed else 0.0

    def _battery_percent(self) -> int:
        return max(0, min(100, round(100.0 * self.state.charge_left)))

    def battery_status(self, link: Link) -> Values:
        """BATTERY_STATUS: one pack, its voltage in the first cell's field."""
        truth = self.state.core.state
        voltages = (round(float(truth[body.BATTERY_VOLTAGE]) * 1000),) + (65535,) * 9
        used_mah = round(float(truth[body.CHARGE_USED]) / 3.6)
        current = int16(100.0 * self._current())
        head = (used_mah, 0, 32767, *voltages, current, 0, 0, 0, self._battery_percent())
        return (*head, 0, int(self.state.battery), 0, 0, 0, 0, 0, 0)

    def power_status(self, link: Link) -> Values:
        """POWER_STATUS of a simulated board."""
        return (5000, 0, 0)

    def hwstatus(self, link: Link) -> Values:
        """HWSTATUS of a simulated board."""
        return (5000, 0)

    def extended_sys_state(self, link: Link) -> Values:
        """EXTENDED_SYS_STATE: on the ground, in the air, taking off, landing."""
        a = self.state
        if a.landed:
            landed = LandedState.ON_GROUND
        elif a.is_landing:
            landed = LandedState.LANDING
        elif a.mode is Mode.GUIDED and self.guided.target is Target.TAKE_OFF:
            landed = LandedState.TAKEOFF
        else:
            landed = LandedState.IN_AIR
        return (MULTICOPTER, landed)

    def system_time(self, link: Link) -> Values:
        """SYSTEM_TIME: no Unix time before the receiver has one."""
        now = self.state.clock.stamp_us
        return (SIMULATED_EPOCH_US + now if self.state.gps_found else 0, now // 1000)

    def ekf_status_report(self, link: Link) -> Values:
        """EKF_STATUS_REPORT: flags, and test ratios that are all well."""
        a = self.state
        flags = EKF_GOOD if a.position_known else EKF_NO_POSITION
        if not a.boot.ekf_started:
            return (0.0, 0.0, 0.0, 0.0, 0.0, EKF_UNINITIALISED, 0.0)
        return (0.02, 0.01, 0.01, 0.01, 0.0, flags, 0.0)

    def vibration(self, link: Link) -> Values:
        """VIBRATION: the accelerometer noise of the preset."""
        a = self.state
        sd = a.core.estimator.preset.accelerometer_sd_thrusting if a.armed else (0.0, 0.0, 0.0)
        return (a.clock.stamp_us, *(float(value) for value in sd), 0, 0, 0)

    def mission_current(self, link: Link) -> Values:
        """MISSION_CURRENT: home, item 0, is not counted. The stub keeps a mission, and does not fly it."""
        a = self.state
        total = len(a.plans.mission)
        state = MissionState.NOT_STARTED if total > 1 else MissionState.NONE
        return (a.plans.current, max(total - 1, 0), state, 0)

    def nav_controller_output(self, link: Link) -> Values:
        """NAV_CONTROLLER_OUTPUT: tilt asked for, distance from home."""
        a = self.state
        w, x, y, z = a.core.target_quaternion.tolist()
        roll = math.degrees(math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)))
        pitch = math.degrees(math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)))
        heading = int16(math.degrees(a.core.yaw))
        return (roll, pitch, 0.0, 0.0, 0.0, heading, 0, min(round(a.distance_from_home_m), 65535))

    # --- place -------------------------------------------------------------------------------------------------
    def home_position(self, link: Link) -> Values | None:
        """HOME_POSITION, once known; its attitude is not given."""
        a = self.state
        if not a.home_known:
            return None
        x, y, z = (float(value) for value in a.home_ned)
        latitude, longitude = self.state.origin.globe_e7(x, y)
        altitude_mm = round(self.state.origin.altitude_of(z) * 1000)
        return (
            latitude,
            longitude,
            altitude_mm,
            x,
            y,
            z,
            NAN,
            NAN,
            NAN,
            NAN,
            0.0,
            0.0,
            0.0,
            a.clock.stamp_us,
        )

    def gps_global_origin(self, link: Link) -> Values | None:
        """GPS_GLOBAL_ORIGIN: where local (0, 0, 0) is, once known."""
        o = self.state.origin
        if not self.state.home_known:
            return None
        place = (round(o.latitude_deg * 1e7), round(o.longitude_deg * 1e7), round(o.altitude_m * 1000))
        return (*place, self.state.clock.stamp_us)

    def local_position_ned(self, link: Link) -> Values | None:
        """LOCAL_POSITION_NED, once and as long as there is a position."""
        core = self.state.core
        if not self.state.position_known:
            return None
        return (self.state.clock.stamp_ms, *core.position_ned.tolist(), *core.velocity_ned.tolist())

    def global_position_int(self, link: Link) -> Values:
        """GLOBAL_POSITION_INT; zeros before there is a home."""
        a = self.state
        heading = round(math.degrees(a.core.yaw) % 360.0 * 100) % 36000
        if not a.home_known:
            return (a.clock.stamp_ms, 0, 0, 0, 0, 0, 0, 0, heading)
        x, y, z = a.core.position_ned.tolist()
        vx, vy, vz = (int16(100.0 * value) for value in a.core.velocity_ned.tolist())
        latitude, longitude = self.state.origin.globe_e7(x, y)
        above_home = round((float(a.home_ned[2]) - z) * 1000)
        altitude = round(self.state.origin.altitude_of(z) * 1000)
        return (a.clock.stamp_ms, latitude, longitude, altitude, above_home, vx, vy, vz, heading)

    def gps_raw_int(self, link: Link) -> Values:
        """GPS_RAW_INT: a simulated receiver, found some seconds after boot."""
        a = self.state
        if not a.gps_found:
            return (0, 0, 0, 0, 65535, 65535, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
        x, y, z = a.core.position_ned.tolist()
        vx, vy, _ = a.core.velocity_ned.tolist()
        latitude, longitude = self.state.origin.globe_e7(x, y)
        altitude = round(self.state.origin.altitude_of(z) * 1000)
        course = round(math.degrees(math.atan2(vy, vx)) % 360.0 * 100) % 36000
        speed = min(round(100.0 * math.hypot(vx, vy)), 65534)
        fix, satellites = (6, 10) if a.core.position_aided else (1, 0)
        head = (a.clock.stamp_us, latitude, longitude, altitude, 121, 200, speed, course, fix, satellites)
        return (*head, altitude, 300, 300, 40, 0, 0)

    def scaled_pressure(self, link: Link) -> Values:
        """SCALED_PRESSURE of the standard atmosphere."""
        return (self.state.clock.stamp_ms, self.state.pressure_hpa, 0.0, 3500, 0)

    def vfr_hud(self, link: Link) -> Values:
        """VFR_HUD."""
        a = self.state
        vx, vy, vz = a.core.velocity_ned.tolist()
        throttle = round(100.0 * float(a.core.memory[at.THROTTLE_OUT])) if a.armed else 0
        altitude = self.state.origin.altitude_of(float(a.core.position_ned[2])) if a.home_known else 0.0
        speed = math.hypot(vx, vy)
        return (speed, speed, altitude, -vz, int(math.degrees(a.core.yaw) % 360.0), throttle)

    # --- on request --------------------------------------------------------------------------------------------
    def autopilot_version(self, link: Link) -> Values:
        """AUTOPILOT_VERSION 4.7.0."""
        head = (CAPABILITIES, 0, FLIGHT_SW_VERSION, 0, 0, 0, 0, 0)
        uid2 = struct.pack("<18s", BOARD_UID)
        return (*head, *GIT_HASH, *bytes(8), *bytes(8), *uid2)
