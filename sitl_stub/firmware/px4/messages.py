"""What PX4 sends: one builder a message, values in wire order, and the default rates of its links.

Constants that the stub has no model for (satellites, accuracies, sensor bits) are those of the capture. Positions on the
globe are flat about SIH_LOC_LAT0, SIH_LOC_LON0, SIH_LOC_H0.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from sitl_stub.firmware.common.autopilot import SIMULATED_EPOCH_US
from sitl_stub.firmware.common.globe import LocalOrigin
from sitl_stub.firmware.common.streams import Builder
from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.modes import ARMED_FLAG, CUSTOM_MODE_ENABLED, Mode
from sitl_stub.firmware.px4.motion_messages import NAN, Px4Motion, Values, int16
from sitl_stub.firmware.px4.slow_messages import Px4Reports
from sitl_stub.mavlink.links import Link
from sitl_stub.physics import vehicle as body

if TYPE_CHECKING:
    from sitl_stub.firmware.px4.autopilot import Px4


CAPABILITIES = 59647
PREARM_BIT = 1 << 28
GPS_BIT = 1 << 5
HEALTH_BITS = 52480063
SENSORS_PRESENT, SENSORS_ENABLED = 16431, 81967
LANDED_ON_GROUND, LANDED_IN_AIR, LANDED_TAKEOFF, LANDED_LANDING = 1, 2, 3, 4
STATUS_UNINIT, STATUS_STANDBY, STATUS_ACTIVE, STATUS_CRITICAL = 0, 3, 4, 5


class Px4Messages:
    """Builders of every message of one vehicle."""

    def __init__(self, autopilot: Px4) -> None:
        self.autopilot = autopilot
        self.motion = Px4Motion(self)
        self.reports = Px4Reports(self)
        self.ping_sequence = 0
        self._origin: LocalOrigin | None = None

    @property
    def origin(self) -> LocalOrigin:
        """Where local (0, 0, 0) lies on the globe."""
        if self._origin is None:
            p = self.autopilot.parameters
            self._origin = LocalOrigin(p["SIH_LOC_LAT0"], p["SIH_LOC_LON0"], p["SIH_LOC_H0"])
        return self._origin

    def altitude_of(self, down_m: float) -> float:
        """Altitude above sea level of local z."""
        return self.origin.altitude_m - down_m

    def down_of(self, altitude_m: float) -> float:
        """Local z of an altitude above sea level."""
        return self.origin.altitude_m - altitude_m

    def local_of(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """North and east of a place, m."""
        return self.origin.local(latitude_deg, longitude_deg)

    def definitions(self) -> Sequence[tuple[str, Builder, Mapping[str, float]]]:
        """Name, builder, rates by link role. LOCAL_POSITION_NED comes before ATTITUDE_QUATERNION within one instant."""

        def rates(onboard: float, gcs: float) -> Mapping[str, float]:
            return {"onboard": onboard, "gcs": gcs}

        table: list[tuple[str, Builder, Mapping[str, float]]] = [
            ("HEARTBEAT", self.heartbeat, rates(1, 1)),
            ("SYS_STATUS", self.sys_status, rates(5, 1)),
            ("EXTENDED_SYS_STATE", self.extended_sys_state, rates(5, 1)),
            ("SYSTEM_TIME", self.system_time, rates(1, 1)),
            ("PING", self.ping, rates(1, 0.1)),
            ("BATTERY_STATUS", self.battery_status, rates(1, 0.5)),
            ("ESTIMATOR_STATUS", self.estimator_status, rates(1, 0.5)),
            ("HOME_POSITION", self.home_position, rates(1, 0.5)),
            ("GPS_GLOBAL_ORIGIN", self.gps_global_origin, {}),
            ("MISSION_CURRENT", self.mission_current, rates(1, 0.5)),
            ("GPS_RAW_INT", self.gps_raw_int, rates(8, 1)),
            ("SCALED_PRESSURE", self.scaled_pressure, rates(1, 1)),
            ("VIBRATION", self.vibration, rates(0.5, 0.1)),
            ("TIMESYNC", self.timesync, rates(10, 0)),
            ("ALTITUDE", self.altitude, rates(10, 1)),
            ("DISTANCE_SENSOR", self.distance_sensor, rates(10, 0.5)),
            ("VFR_HUD", self.vfr_hud, rates(10, 4)),
            ("SERVO_OUTPUT_RAW", self.motion.servo_output_raw, rates(10, 1)),
            ("RC_CHANNELS", self.motion.rc_channels, rates(20, 5)),
            ("GLOBAL_POSITION_INT", self.global_position_int, rates(50, 5)),
            ("POSITION_TARGET_LOCAL_NED", self.motion.position_target_local_ned, rates(10, 1.5)),
            ("POSITION_TARGET_GLOBAL_INT", self.motion.position_target_global_int, rates(10, 1)),
            ("ATTITUDE_TARGET", self.motion.attitude_target, rates(10, 2)),
            ("HIGHRES_IMU", self.motion.highres_imu, rates(50, 0)),
            ("HIL_STATE_QUATERNION", self.motion.hil_state_quaternion, {}),
            ("ODOMETRY", self.motion.odometry, rates(30, 3)),
            ("LOCAL_POSITION_NED", self.motion.local_position_ned, rates(30, 1)),
            ("ATTITUDE", self.motion.attitude, rates(100, 15)),
            ("ATTITUDE_QUATERNION", self.motion.attitude_quaternion, rates(50, 10)),
            ("AUTOPILOT_VERSION", self.autopilot_version, {}),
            ("LINK_NODE_STATUS", self.reports.link_node_status, rates(1, 1)),
        ]
        if self.autopilot.version.newer_reports:
            table += [
                ("CURRENT_MODE", self.current_mode, rates(0.5, 0.5)),
                ("CURRENT_EVENT_SEQUENCE", self.current_event_sequence, rates(0.3, 0.3)),
                ("TIME_ESTIMATE_TO_TARGET", self.reports.time_estimate_to_target, rates(0.5, 0.5)),
                ("GNSS_INTEGRITY", self.reports.gnss_integrity, rates(1, 1)),
                ("OPEN_DRONE_ID_LOCATION", self.reports.open_drone_id_location, rates(1, 1)),
                ("OPEN_DRONE_ID_SYSTEM", self.reports.open_drone_id_system, rates(1, 1)),
            ]
        return table

    # --- status ------------------------------------------------------------------------------------------------
    def heartbeat(self, link: Link) -> Values:
        """HEARTBEAT: mode, armed, and the system status that follows arming and failsafe."""
        a = self.autopilot
        c = a.commander
        base = c.mode.value.base_flags | CUSTOM_MODE_ENABLED
        if c.mode is Mode.OFFBOARD and a.attitude_loop_runs_offboard:
            base |= 16
        if c.armed:
            base |= ARMED_FLAG
            status = STATUS_CRITICAL if c.failsafe else STATUS_ACTIVE
        else:
            status = STATUS_STANDBY if c.ready_to_arm else STATUS_UNINIT
        return (c.mode.custom_mode, 2, 12, base, status, 3)

    def sys_status(self, link: Link) -> Values:
        """SYS_STATUS: sensors, the pre-arm bit (28) for the present mode, battery."""
        a = self.autopilot
        c = a.commander
        present, enabled, health = SENSORS_PRESENT, SENSORS_ENABLED, HEALTH_BITS
        if not a.home_known:
            present, enabled = 0, 0
        if c.armed or c.ready_to_arm:
            health |= PREARM_BIT
        if not a.core.position_aided:
            health &= ~GPS_BIT
        state = a.core.state
        volts = float(state[body.BATTERY_VOLTAGE])
        values = (
            present,
            enabled,
            health,
            160,
            round(volts * 1000),
            -100,
            0,
            0,
            0,
            0,
            0,
            0,
            self._battery_percent(),
        )
        return (*values, 0, 0, 1)

    def _battery_percent(self) -> int:
        core = self.autopilot.core
        used = float(core.state[body.CHARGE_USED] / core.parameters_packed[body.BATTERY_CAPACITY])
        return max(0, min(99, round(100.0 * (1.0 - used))))

    def battery_status(self, link: Link) -> Values | None:
        """BATTERY_STATUS: one pack; its voltage is in the first cell's field, as PX4 does without cell measurement."""
        state = self.autopilot.core.state
        level = int(self.autopilot.commander.battery.level)
        voltages = (round(float(state[body.BATTERY_VOLTAGE]) * 1000),) + (65535,) * 9
        used_mah = round(float(state[body.CHARGE_USED]) / 3.6)
        current = int16(100.0 * float(state[body.BATTERY_CURRENT]))
        head = (used_mah, -1, 32767, *voltages, current, 0, 1, 1, self._battery_percent())
        return (*head, 0, level, 0, 0, 0, 0, 0, 0)

    def extended_sys_state(self, link: Link) -> Values:
        """EXTENDED_SYS_STATE: on the ground, in the air, taking off, landing."""
        a = self.autopilot
        if a.land_detector.landed:
            landed = LANDED_ON_GROUND
        elif a.commander.mode is Mode.TAKEOFF:
            landed = LANDED_TAKEOFF
        elif a.commander.mode in (Mode.LAND, Mode.PRECISION_LAND):
            landed = LANDED_LANDING
        else:
            landed = LANDED_IN_AIR
        return (0, landed)

    def current_mode(self, link: Link) -> Values:
        """CURRENT_MODE: what flies and what was asked for."""
        c = self.autopilot.commander
        return (c.mode.custom_mode, c.intended.custom_mode, c.mode.value.standard_mode)

    def current_event_sequence(self, link: Link) -> Values:
        """CURRENT_EVENT_SEQUENCE."""
        return (self.autopilot.event_sequence, 0)

    def system_time(self, link: Link) -> Values:
        """SYSTEM_TIME: simulated, counted from a fixed epoch."""
        now = self.autopilot.clock_us
        return (SIMULATED_EPOCH_US + now, now // 1000)

    def timesync(self, link: Link) -> Values | None:
        """TIMESYNC request; in lockstep the server sends them instead."""
        if self.autopilot.lockstep:
            return None
        return (0, self.autopilot.clock_us * 1000)

    def ping(self, link: Link) -> Values:
        """PING request."""
        self.ping_sequence += 1
        return (self.autopilot.clock_us, self.ping_sequence - 1, 0, 0)

    def estimator_status(self, link: Link) -> Values:
        """ESTIMATOR_STATUS: ESTIMATOR_STATUS_FLAGS and accuracies."""
        a = self.autopilot
        if a.estimator_ready:
            flags = 1023 if a.land_detector.landed else 895
            if not a.core.position_valid:
                flags &= ~(8 | 16 | 2 | 256 | 512)
        else:
            flags = 229 if a.home_known else 164
        sd = a.core.estimator.preset.position.sd
        ratios = (0.05, 0.03, 0.02, 0.05, 0.01, NAN)
        return (a.clock_us, *ratios, max(sd[:2]), sd[2], flags)

    def mission_current(self, link: Link) -> Values:
        """MISSION_CURRENT: no mission; mission_mode says whether the vehicle is in an automatic mode."""
        c = self.autopilot.commander
        mode = 1 if c.armed and c.mode.is_auto else 2
        return (0, 65535, 1, mode)

    def vibration(self, link: Link) -> Values:
        """VIBRATION: the accelerometer noise of the preset."""
        a = self.autopilot
        sd = a.core.estimator.preset.accelerometer_sd_thrusting if a.commander.armed else (0.0, 0.0, 0.0)
        return (a.clock_us, 0.0, 0.05 * sd[0], float(sd[2]), 0, 0, 0)

    # --- place -------------------------------------------------------------------------------------------------
    def home_position(self, link: Link) -> Values | None:
        """HOME_POSITION, once known."""
        a = self.autopilot
        if not a.home_known:
            return None
        x, y, z = (float(value) for value in a.home_ned)
        latitude, longitude = self.origin.globe_e7(x, y)
        altitude_mm = round(self.altitude_of(z) * 1000)
        return (latitude, longitude, altitude_mm, x, y, z, *a.home_quaternion, 0.0, 0.0, 0.0, a.home_set_us)

    def gps_global_origin(self, link: Link) -> Values:
        """GPS_GLOBAL_ORIGIN: where local (0, 0, 0) is."""
        o = self.origin
        return (round(o.latitude_deg * 1e7), round(o.longitude_deg * 1e7), round(o.altitude_m * 1000), 0)

    def global_position_int(self, link: Link) -> Values | None:
        """GLOBAL_POSITION_INT from the estimate."""
        a = self.autopilot
        if not a.home_known or not a.core.position_valid:
            return None
        x, y, z = a.core.position_ned.tolist()
        vx, vy, vz = (int16(100.0 * value) for value in a.core.velocity_ned.tolist())
        latitude, longitude = self.origin.globe_e7(x, y)
        heading = round(math.degrees(a.core.yaw) % 360.0 * 100) % 36000
        above_home = round((float(a.home_ned[2]) - z) * 1000)
        return (
            a.clock_us // 1000,
            latitude,
            longitude,
            round(self.altitude_of(z) * 1000),
            above_home,
            vx,
            vy,
            vz,
            heading,
        )

    @property
    def gps_fix(self) -> tuple[int, int]:
        """GPS_FIX_TYPE and the number of satellites."""
        core = self.autopilot.core
        if not core.position_aided:
            return 0, 0
        return (3, 10) if core.position_valid else (1, 10)

    def gps_raw_int(self, link: Link) -> Values:
        """GPS_RAW_INT: the estimate as a receiver with 10 satellites would report it."""
        a = self.autopilot
        x, y, z = a.core.position_ned.tolist()
        vx, vy = float(a.core.velocity_ned[0]), float(a.core.velocity_ned[1])
        latitude, longitude = self.origin.globe_e7(x, y)
        altitude = round(self.altitude_of(z) * 1000)
        course = round(math.degrees(math.atan2(vy, vx)) % 360.0 * 100) % 36000
        speed = min(round(100.0 * math.hypot(vx, vy)), 65534)
        fix, satellites = self.gps_fix
        head = (a.clock_us, latitude, longitude, altitude, 70, 110, speed, course, fix, satellites)
        return (*head, altitude, 900, 1780, 400, 0, 0)

    def altitude(self, link: Link) -> Values:
        """ALTITUDE."""
        a = self.autopilot
        z = float(a.core.position_ned[2])
        above_sea = self.altitude_of(z)
        above_home = float(a.home_ned[2]) - z
        return (a.clock_us, above_sea, above_sea, -z, above_home, -float(a.home_ned[2]), max(above_home, 0.0))

    def distance_sensor(self, link: Link) -> Values:
        """DISTANCE_SENSOR looking down."""
        a = self.autopilot
        height = max(float(a.core.environment[body.GROUND_DOWN] - a.core.state[body.POSITION + 2]), 0.0)
        height -= a.core.vehicle.foot_height_m
        centimetres = min(max(round(100.0 * height), 0), 10000)
        return (a.clock_us // 1000, 0, 10000, centimetres, 0, 0, 25, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)

    def vfr_hud(self, link: Link) -> Values:
        """VFR_HUD."""
        a = self.autopilot
        vx, vy, vz = a.core.velocity_ned.tolist()
        throttle = round(100.0 * float(a.core.memory[at.OUT_THRUST])) if a.commander.armed else 0
        heading = int(math.degrees(a.core.yaw) % 360.0)
        altitude = self.altitude_of(float(a.core.position_ned[2]))
        return (NAN, math.hypot(vx, vy), altitude, -vz, heading, throttle)

    def scaled_pressure(self, link: Link) -> Values:
        """SCALED_PRESSURE of the standard atmosphere."""
        a = self.autopilot
        return (a.clock_us // 1000, self.pressure_hpa(), 0.0, 1180, 0)

    def pressure_hpa(self) -> float:
        """Of the standard atmosphere at the estimated height."""
        altitude = self.altitude_of(float(self.autopilot.core.position_ned[2]))
        return 1013.25 * float(max(1.0 - 2.25577e-5 * altitude, 0.0) ** 5.25588)

    # --- on request --------------------------------------------------------------------------------------------
    def autopilot_version(self, link: Link) -> Values:
        """AUTOPILOT_VERSION."""
        version = self.autopilot.version.flight_sw_version
        custom = struct.pack("<Q", 0xD6F12AD1C4000000)
        head = (CAPABILITIES, 5283920058631409231, version, version, 101854463, 1, 0, 0)
        return (*head, *custom, *custom, *bytes(8), *bytes(18))
