"""What PX4 sends: one builder a message, values in wire order, and the default rates of its links.

Constants that the stub has no model for (satellites, accuracies, sensor bits) are those of the capture. Positions on the
globe are flat about SIH_LOC_LAT0, SIH_LOC_LON0, SIH_LOC_H0.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence

from sitl_stub.firmware.common.clock import SIMULATED_EPOCH_US
from sitl_stub.firmware.common.mavlink_ids import LandedState, MissionState, ModeFlag, SystemStatus
from sitl_stub.firmware.common.radio import RECEIVER_BIT
from sitl_stub.firmware.common.streams import StreamRow
from sitl_stub.firmware.common.wire_values import NAN, Values, int16
from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.commander import Commander
from sitl_stub.firmware.px4.modes import Mode
from sitl_stub.firmware.px4.motion_messages import Px4Motion
from sitl_stub.firmware.px4.navigator import Navigator
from sitl_stub.firmware.px4.offboard import OffboardControl
from sitl_stub.firmware.px4.slow_messages import Px4Reports
from sitl_stub.firmware.px4.state import Px4State
from sitl_stub.firmware.px4.voice import Px4Voice
from sitl_stub.mavlink.links import Link
from sitl_stub.physics import vehicle as body

CAPABILITIES = 59647
PREARM_BIT = 1 << 28
GPS_BIT = 1 << 5
HEALTH_BITS = 52480063
SENSORS_PRESENT, SENSORS_ENABLED = 16431, 81967
PX4 = 12
"""MAV_AUTOPILOT."""


class Px4Messages:
    """Builders of every message of one vehicle."""

    def __init__(
        self,
        state: Px4State,
        voice: Px4Voice,
        navigator: Navigator,
        control: OffboardControl,
        commander: Commander,
    ) -> None:
        self.state = state
        self.voice = voice
        self.control = control
        self.commander = commander
        self.navigator = navigator
        self.motion = Px4Motion(state, navigator)
        self.reports = Px4Reports(state, navigator)
        self.ping_sequence = 0

    def definitions(self) -> Sequence[StreamRow]:
        """Name, builder, rates by link role. LOCAL_POSITION_NED comes before ATTITUDE_QUATERNION within one instant."""

        def rates(onboard: float, gcs: float) -> Mapping[str, float]:
            return {"onboard": onboard, "gcs": gcs}

        table: list[StreamRow] = [
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
            ("ORBIT_EXECUTION_STATUS", self.orbit_execution_status, rates(5, 2)),
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
        if self.state.version.newer_reports:
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
        a = self.state
        base = a.mode.value.base_flags | ModeFlag.CUSTOM_MODE_ENABLED
        if a.mode is Mode.OFFBOARD and self.control.attitude_loop_runs:
            base |= ModeFlag.STABILIZE_ENABLED
        if a.armed:
            base |= ModeFlag.SAFETY_ARMED
            status = SystemStatus.CRITICAL if a.failsafe else SystemStatus.ACTIVE
        else:
            status = SystemStatus.STANDBY if self.commander.ready_to_arm else SystemStatus.UNINIT
        return (a.mode.custom_mode, int(a.parameters["MAV_TYPE"]), PX4, base, status, 3)

    def sys_status(self, link: Link) -> Values:
        """SYS_STATUS: sensors, the pre-arm bit (28) for the present mode, battery."""
        a = self.state
        present, enabled, health = SENSORS_PRESENT, SENSORS_ENABLED, HEALTH_BITS
        if not a.home_known:
            present, enabled = 0, 0
        if a.armed or self.commander.ready_to_arm:
            health |= PREARM_BIT
        if a.sticks.radio and a.radio.healthy:
            health |= RECEIVER_BIT
        if not a.core.position_aided:
            health &= ~GPS_BIT
        truth = a.core.state
        volts = float(truth[body.BATTERY_VOLTAGE])
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
        return max(0, min(99, round(100.0 * self.state.charge_left)))

    def battery_status(self, link: Link) -> Values | None:
        """BATTERY_STATUS: one pack; its voltage is in the first cell's field, as PX4 does without cell measurement."""
        truth = self.state.core.state
        level = int(self.state.battery)
        voltages = (round(float(truth[body.BATTERY_VOLTAGE]) * 1000),) + (65535,) * 9
        used_mah = round(float(truth[body.CHARGE_USED]) / 3.6)
        current = int16(100.0 * float(truth[body.BATTERY_CURRENT]))
        head = (used_mah, -1, 32767, *voltages, current, 0, 1, 1, self._battery_percent())
        return (*head, 0, level, 0, 0, 0, 0, 0, 0)

    def extended_sys_state(self, link: Link) -> Values:
        """EXTENDED_SYS_STATE: on the ground, in the air, taking off, landing."""
        a = self.state
        if a.ground.landed:
            landed = LandedState.ON_GROUND
        elif a.mode is Mode.TAKEOFF:
            landed = LandedState.TAKEOFF
        elif a.mode in (Mode.LAND, Mode.PRECISION_LAND):
            landed = LandedState.LANDING
        else:
            landed = LandedState.IN_AIR
        return (0, landed)

    def current_mode(self, link: Link) -> Values:
        """CURRENT_MODE: what flies and what was asked for."""
        a = self.state
        return (a.mode.custom_mode, a.intended.custom_mode, a.mode.value.standard_mode)

    def current_event_sequence(self, link: Link) -> Values:
        """CURRENT_EVENT_SEQUENCE."""
        return (self.voice.event_sequence, 0)

    def system_time(self, link: Link) -> Values:
        """SYSTEM_TIME: simulated, counted from a fixed epoch."""
        now = self.state.clock.stamp_us
        return (SIMULATED_EPOCH_US + now, now // 1000)

    def timesync(self, link: Link) -> Values | None:
        """TIMESYNC request; in lockstep the server sends them instead."""
        if self.state.clock.lockstep:
            return None
        return (0, self.state.clock.stamp_us * 1000)

    def ping(self, link: Link) -> Values:
        """PING request."""
        self.ping_sequence += 1
        return (self.state.clock.stamp_us, self.ping_sequence - 1, 0, 0)

    def estimator_status(self, link: Link) -> Values:
        """ESTIMATOR_STATUS: ESTIMATOR_STATUS_FLAGS and accuracies."""
        a = self.state
        if a.estimator_ready:
            flags = 1023 if a.ground.landed else 895
            if not a.core.position_valid:
                flags &= ~(8 | 16 | 2 | 256 | 512)
        else:
            flags = 229 if a.home_known else 164
        sd = a.core.estimator.preset.position.sd
        ratios = (0.05, 0.03, 0.02, 0.05, 0.01, NAN)
        return (a.clock.stamp_us, *ratios, max(sd[:2]), sd[2], flags)

    def mission_current(self, link: Link) -> Values:
        """MISSION_CURRENT; mission_mode says whether the vehicle is in an automatic mode."""
        a = self.state
        mode = 1 if a.armed and a.mode.is_auto else 2
        total = len(a.plans.mission)
        if not total:
            return (0, 65535, MissionState.NONE, mode)
        flies = a.armed and a.mode is Mode.MISSION
        if self.navigator.mission.finished:
            stands = MissionState.COMPLETE
        elif flies:
            stands = MissionState.ACTIVE
        else:
            stands = MissionState.PAUSED if a.plans.current else MissionState.NOT_STARTED
        return (a.plans.current, total, stands, mode)

    def orbit_execution_status(self, link: Link) -> Values | None:
        """ORBIT_EXECUTION_STATUS, while it circles."""
        a, orbit = self.state, self.navigator.orbit
        if a.mode is not Mode.ORBIT:
            return None
        north, east, down = (float(value) for value in orbit.centre_ned)
        latitude, longitude = a.origin.globe_e7(north, east)
        return (a.clock.stamp_us, orbit.signed_radius_m, latitude, longitude, a.origin.altitude_of(down), 5)

    def vibration(self, link: Link) -> Values:
        """VIBRATION: the accelerometer noise of the preset."""
        a = self.state
        sd = a.core.estimator.preset.accelerometer_sd_thrusting if a.armed else (0.0, 0.0, 0.0)
        return (a.clock.stamp_us, 0.0, 0.05 * sd[0], float(sd[2]), 0, 0, 0)

    # --- place -------------------------------------------------------------------------------------------------
    def home_position(self, link: Link) -> Values | None:
        """HOME_POSITION, once known."""
        a = self.state
        if not a.home_known:
            return None
        x, y, z = (float(value) for value in a.home_ned)
        latitude, longitude = self.state.origin.globe_e7(x, y)
        altitude_mm = round(self.state.origin.altitude_of(z) * 1000)
        return (latitude, longitude, altitude_mm, x, y, z, *a.home_quaternion, 0.0, 0.0, 0.0, a.home_set_us)

    def gps_global_origin(self, link: Link) -> Values:
        """GPS_GLOBAL_ORIGIN: where local (0, 0, 0) is."""
        o = self.state.origin
        return (round(o.latitude_deg * 1e7), round(o.longitude_deg * 1e7), round(o.altitude_m * 1000), 0)

    def global_position_int(self, link: Link) -> Values | None:
        """GLOBAL_POSITION_INT from the estimate."""
        a = self.state
        if not a.home_known or not a.core.position_valid:
            return None
        x, y, z = a.core.position_ned.tolist()
        vx, vy, vz = (int16(100.0 * value) for value in a.core.velocity_ned.tolist())
        latitude, longitude = self.state.origin.globe_e7(x, y)
        heading = round(math.degrees(a.core.yaw) % 360.0 * 100) % 36000
        above_home = round((float(a.home_ned[2]) - z) * 1000)
        return (
            a.clock.stamp_ms,
            latitude,
            longitude,
            round(self.state.origin.altitude_of(z) * 1000),
            above_home,
            vx,
            vy,
            vz,
            heading,
        )

    def gps_raw_int(self, link: Link) -> Values:
        """GPS_RAW_INT: the estimate as a receiver with 10 satellites would report it."""
        a = self.state
        x, y, z = a.core.position_ned.tolist()
        vx, vy = float(a.core.velocity_ned[0]), float(a.core.velocity_ned[1])
        latitude, longitude = self.state.origin.globe_e7(x, y)
        altitude = round(self.state.origin.altitude_of(z) * 1000)
        course = round(math.degrees(math.atan2(vy, vx)) % 360.0 * 100) % 36000
        speed = min(round(100.0 * math.hypot(vx, vy)), 65534)
        fix, satellites = self.state.gps_fix
        head = (a.clock.stamp_us, latitude, longitude, altitude, 70, 110, speed, course, fix, satellites)
        return (*head, altitude, 900, 1780, 400, 0, 0)

    def altitude(self, link: Link) -> Values:
        """ALTITUDE."""
        a = self.state
        z = float(a.core.position_ned[2])
        above_sea = self.state.origin.altitude_of(z)
        above_home = float(a.home_ned[2]) - z
        return (
            a.clock.stamp_us,
            above_sea,
            above_sea,
            -z,
            above_home,
            -float(a.home_ned[2]),
            max(above_home, 0.0),
        )

    def distance_sensor(self, link: Link) -> Values:
        """DISTANCE_SENSOR looking down."""
        a = self.state
        centimetres = min(max(round(100.0 * a.core.clearance_m), 0), 10000)
        return (a.clock.stamp_ms, 0, 10000, centimetres, 0, 0, 25, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)

    def vfr_hud(self, link: Link) -> Values:
        """VFR_HUD."""
        a = self.state
        vx, vy, vz = a.core.velocity_ned.tolist()
        throttle = round(100.0 * float(a.core.memory[at.OUT_THRUST])) if a.armed else 0
        heading = int(math.degrees(a.core.yaw) % 360.0)
        altitude = self.state.origin.altitude_of(float(a.core.position_ned[2]))
        return (NAN, math.hypot(vx, vy), altitude, -vz, heading, throttle)

    def scaled_pressure(self, link: Link) -> Values:
        """SCALED_PRESSURE of the standard atmosphere."""
        a = self.state
        return (a.clock.stamp_ms, self.state.pressure_hpa, 0.0, 1180, 0)

    # --- on request --------------------------------------------------------------------------------------------
    def autopilot_version(self, link: Link) -> Values:
        """AUTOPILOT_VERSION."""
        version = self.state.version.flight_sw_version
        custom = struct.pack("<Q", 0xD6F12AD1C4000000)
        head = (CAPABILITIES, 5283920058631409231, version, version, 101854463, 1, 0, 0)
        return (*head, *custom, *custom, *bytes(8), *bytes(18))
