"""What PX4 sends of its motion: the estimate, the truth, what its loops follow, and what goes to the motors."""

from __future__ import annotations

import functools
import math

from sitl_stub.firmware.common.wire_values import NAN, Values, int16
from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.modes import Mode
from sitl_stub.firmware.px4.navigator import Navigator
from sitl_stub.firmware.px4.state import Px4State
from sitl_stub.mavlink.links import Link
from sitl_stub.physics import vehicle as body


class Px4Motion:
    """Builders of the quick messages of one vehicle."""

    def __init__(self, state: Px4State, navigator: Navigator) -> None:
        self.state = state
        self.navigator = navigator

    # --- motion ------------------------------------------------------------------------------------------------
    def attitude(self, link: Link) -> Values:
        """ATTITUDE: Euler angles of the estimate."""
        core = self.state.core
        return (self.state.clock.stamp_ms, *core.euler_rad, *core.body_rate_frd.tolist())

    def attitude_quaternion(self, link: Link) -> Values:
        """ATTITUDE_QUATERNION."""
        core = self.state.core
        q, rates = core.quaternion.tolist(), core.body_rate_frd.tolist()
        return (self.state.clock.stamp_ms, *q, *rates, 0.0, 0.0, 0.0, 0.0)

    def local_position_ned(self, link: Link) -> Values:
        """LOCAL_POSITION_NED; PX4 goes on sending it when position is invalid."""
        core = self.state.core
        return (self.state.clock.stamp_ms, *core.position_ned.tolist(), *core.velocity_ned.tolist())

    def odometry(self, link: Link) -> Values:
        """ODOMETRY of the estimate: MAV_FRAME_LOCAL_NED for both, as PX4 sends it."""
        core = self.state.core
        pose, velocity = self._covariances
        resets = core.resets
        motion = (*core.position_ned.tolist(), *core.quaternion.tolist(), *core.velocity_ned.tolist())
        return (
            self.state.clock.stamp_us,
            *motion,
            *core.body_rate_frd.tolist(),
            *pose,
            *velocity,
            1,
            1,
            resets,
            8,
            0,
        )

    @functools.cached_property
    def _covariances(self) -> tuple[list[float], list[float]]:
        """Upper triangles (21,) of the pose's and the velocity's covariance, as the estimator's preset has them."""
        preset = self.state.core.estimator.preset
        pose = [NAN] * 21
        velocity = [NAN] * 21
        for axis, index in enumerate((0, 6, 11)):
            pose[index] = preset.position.sd[axis] ** 2
            velocity[index] = preset.velocity.sd[axis] ** 2
        for axis, index in enumerate((15, 18, 20)):
            pose[index] = preset.attitude.sd[axis] ** 2
        return pose, velocity

    def highres_imu(self, link: Link) -> Values:
        """HIGHRES_IMU."""
        core = self.state.core
        pressure = self.state.pressure_hpa
        altitude = self.state.origin.altitude_of(float(core.position_ned[2]))
        force, rates = core.specific_force_frd.tolist(), core.body_rate_frd.tolist()
        # earth's field at the captures' place, gauss, turned into the body
        w, x, y, z = core.quaternion.tolist()
        north, down = 0.2032, 0.4264
        field = (
            (1 - 2 * (y * y + z * z)) * north + 2 * (x * z - w * y) * down,
            2 * (x * y - w * z) * north + 2 * (y * z + w * x) * down,
            2 * (x * z + w * y) * north + (1 - 2 * (x * x + y * y)) * down,
        )
        return (self.state.clock.stamp_us, *force, *rates, *field, pressure, 0.0, altitude, 15.0, 511, 0)

    def hil_state_quaternion(self, link: Link) -> Values:
        """HIL_STATE_QUATERNION: the truth. Latitude and longitude resolve 1.1 cm, altitude 1 mm."""
        core = self.state.core
        s = core.state
        x, y, z = s[body.POSITION_NED].tolist()
        velocity = s[body.VELOCITY_NED].tolist()
        latitude, longitude = self.state.origin.globe_e7(x, y)
        force = s[body.SPECIFIC_FORCE_FRD].tolist()
        airspeed = min(round(100.0 * math.sqrt(sum(v * v for v in velocity))), 65535)
        head = (self.state.clock.stamp_us, *s[body.QUATERNION_WXYZ].tolist(), *s[body.BODY_RATE_FRD].tolist())
        place = (latitude, longitude, round(self.state.origin.altitude_of(z) * 1000))
        motion = tuple(int16(100.0 * v) for v in velocity)
        return (*head, *place, *motion, airspeed, airspeed, *(int16(v / 9.80665 * 1000) for v in force))

    # --- targets -----------------------------------------------------------------------------------------------
    def attitude_target(self, link: Link) -> Values:
        """ATTITUDE_TARGET: what the attitude and rate loops follow."""
        a = self.state
        m = a.core.memory
        mask = 0
        head = (a.clock.stamp_ms, *m[at.OUT_QUATERNION : at.OUT_QUATERNION + 4].tolist())
        return (*head, *m[at.OUT_RATES : at.OUT_RATES + 3].tolist(), float(m[at.OUT_THRUST]), mask)

    def _follows_trajectory(self) -> bool:
        return float(self.state.core.setpoint[at.KIND]) == at.KIND_TRAJECTORY

    def position_target_local_ned(self, link: Link) -> Values | None:
        """POSITION_TARGET_LOCAL_NED: the position controller's setpoint; silent while it does not run in the air."""
        a = self.state
        if a.armed and not self._follows_trajectory():
            return None
        if not a.armed:
            if a.mode is Mode.OFFBOARD:
                return None
            values = (NAN,) * 6 + (0.0, 0.0, 100.0, a.core.yaw, 0.0)
            return (a.clock.stamp_ms, *values, 63, 1)
        s, m = a.core.setpoint, a.core.memory
        position = s[at.POSITION : at.POSITION + 3].tolist()
        velocity = m[at.OUT_VELOCITY : at.OUT_VELOCITY + 3].tolist()
        acceleration = m[at.OUT_ACCELERATION : at.OUT_ACCELERATION + 3].tolist()
        mask = sum(1 << bit for bit, value in enumerate(position) if value != value)
        return (
            a.clock.stamp_ms,
            *position,
            *velocity,
            *acceleration,
            float(s[at.YAW]),
            float(s[at.YAW_RATE]),
            mask,
            1,
        )

    def position_target_global_int(self, link: Link) -> Values | None:
        """POSITION_TARGET_GLOBAL_INT in automatic modes."""
        a = self.state
        if not (a.armed and a.mode.is_auto and self._follows_trajectory()):
            return None
        s, m = a.core.setpoint, a.core.memory
        target = self.navigator.target
        latitude, longitude = self.state.origin.globe_e7(float(target[0]), float(target[1]))
        velocity = m[at.OUT_VELOCITY : at.OUT_VELOCITY + 3].tolist()
        acceleration = m[at.OUT_ACCELERATION : at.OUT_ACCELERATION + 3].tolist()
        altitude = self.state.origin.altitude_of(float(target[2]))
        yaw = float(s[at.YAW])
        return (a.clock.stamp_ms, latitude, longitude, altitude, *velocity, *acceleration, yaw, 0.0, 0, 5)

    def servo_output_raw(self, link: Link) -> Values:
        """SERVO_OUTPUT_RAW: 900 disarmed, 1000..2000 µs armed."""
        a = self.state
        count = a.core.vehicle.rotor_count
        outputs = [900] * 16
        if a.armed:
            for i, value in enumerate(a.core.motors[:count].tolist()):
                outputs[i] = round(1000.0 + 1000.0 * value)
        return (a.clock.stamp_us & 0xFFFFFFFF, *outputs[:8], 0, *outputs[8:])

    def rc_channels(self, link: Link) -> Values | None:
        """RC_CHANNELS of a pilot's radio: roll, pitch, throttle, yaw in µs; silent while there is none."""
        a = self.state
        sticks = a.sticks
        if not sticks.radio:
            return None
        first = (
            round(1500 + 500 * sticks.roll),
            round(1500 - 500 * sticks.pitch),
            round(1000 + 1000 * sticks.throttle),
            round(1500 + 500 * sticks.yaw),
        )
        shown, rssi = a.radio.received(first, 100)
        return (a.clock.stamp_ms, *shown, *([65535] * 14), 4, rssi)
