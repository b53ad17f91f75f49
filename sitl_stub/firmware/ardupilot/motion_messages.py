"""What ArduCopter sends of its motion: the estimate, the truth, what its loops follow, and what goes to the motors."""

from __future__ import annotations

import numpy as np

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.guided import Guided, Target
from sitl_stub.firmware.ardupilot.state import ArduPilotState
from sitl_stub.firmware.common.vehicle_core import euler_of
from sitl_stub.firmware.common.wire_values import Values
from sitl_stub.mavlink.links import Link
from sitl_stub.physics import vehicle as body


class ArduPilotMotion:
    """Builders of the quick messages of one vehicle."""

    def __init__(self, state: ArduPilotState, guided: Guided) -> None:
        self.state = state
        self.guided = guided

    # --- motion ------------------------------------------------------------------------------------------------
    def attitude(self, link: Link) -> Values:
        """ATTITUDE: Euler angles of the estimate."""
        return (self.state.clock.stamp_ms, *self.state.core.euler_rad, *self._gyro())

    def _gyro(self) -> list[float]:
        """Body rates as ArduPilot reports them: after INS_GYRO_FILTER."""
        x, y, z = self.state.core.memory[at.GYRO : at.GYRO + 3].tolist()
        return [x, y, z]

    def attitude_quaternion(self, link: Link) -> Values:
        """ATTITUDE_QUATERNION."""
        core = self.state.core
        return (self.state.clock.stamp_ms, *core.quaternion.tolist(), *self._gyro(), 0.0, 0.0, 0.0, 0.0)

    def highres_imu(self, link: Link) -> Values:
        """HIGHRES_IMU."""
        core = self.state.core
        force = core.specific_force_frd.tolist()
        field = (232173.19, 52737.5, -528911.69)
        return (
            self.state.clock.stamp_us,
            *force,
            *self._gyro(),
            *field,
            self.state.pressure_hpa,
            0.0,
            0.0,
            26.5,
            0,
            0,
        )

    def sim_state(self, link: Link) -> Values:
        """SIM_STATE: the truth, without a time stamp. Latitude and longitude resolve 1.1 cm in their integer fields."""
        s = self.state.core.state
        q = s[body.QUATERNION_WXYZ].tolist()
        x, y, z = s[body.POSITION_NED].tolist()
        latitude, longitude = self.state.origin.globe_e7(x, y)
        angles = euler_of(s[body.QUATERNION_WXYZ])
        motion = (*s[body.SPECIFIC_FORCE_FRD].tolist(), *s[body.BODY_RATE_FRD].tolist())
        head = (
            *q,
            *angles,
            *motion,
            float(latitude),
            float(longitude),
            self.state.origin.altitude_of(z),
            0.0,
            0.0,
        )
        return (*head, *s[body.VELOCITY_NED].tolist(), latitude, longitude)

    def simstate(self, link: Link) -> Values:
        """SIMSTATE: the truth in Euler angles."""
        s = self.state.core.state
        x, y, _ = s[body.POSITION_NED].tolist()
        latitude, longitude = self.state.origin.globe_e7(x, y)
        motion = (*s[body.SPECIFIC_FORCE_FRD].tolist(), *s[body.BODY_RATE_FRD].tolist())
        return (*euler_of(s[body.QUATERNION_WXYZ]), *motion, latitude, longitude)

    # --- targets and outputs -----------------------------------------------------------------------------------
    def attitude_target(self, link: Link) -> Values:
        """ATTITUDE_TARGET: the shaped target the loops follow, and the throttle before angle boost."""
        a = self.state
        thrust = float(a.core.memory[at.THROTTLE_IN])
        return (
            a.clock.stamp_ms,
            *a.core.target_quaternion.tolist(),
            *a.core.target_rates.tolist(),
            thrust,
            0,
        )

    def position_target_local_ned(self, link: Link) -> Values | None:
        """POSITION_TARGET_LOCAL_NED: what GUIDED was asked for; silent elsewhere and with attitude targets."""
        a = self.state
        target = self.guided.target
        if not a.mode.value.takes_targets or target is Target.ANGLE:
            return None
        s = a.core.setpoint
        mask = 0b110000000000
        zero = [0.0, 0.0, 0.0]
        position, velocity, acceleration = zero, zero, zero
        if target in (Target.POSITION, Target.TRAJECTORY, Target.TAKE_OFF):
            position = s[at.POSITION : at.POSITION + 3].tolist()
        else:
            mask |= 0b111
        if target in (Target.TRAJECTORY, Target.VELOCITY):
            velocity = s[at.VELOCITY : at.VELOCITY + 3].tolist()
        else:
            mask |= 0b111000
        if target in (Target.TRAJECTORY, Target.VELOCITY, Target.ACCELERATION):
            acceleration = s[at.ACCELERATION : at.ACCELERATION + 3].tolist()
        else:
            mask |= 0b111000000
        vectors = [number for n, e, up in (position, velocity, acceleration) for number in (n, e, -up)]
        return (a.clock.stamp_ms, *vectors, 0.0, 0.0, mask, 1)

    def position_target_global_int(self, link: Link) -> Values | None:
        """POSITION_TARGET_GLOBAL_INT while a place is flown to."""
        a = self.state
        s = a.core.setpoint
        if not a.armed or s[at.LATERAL] != at.LATERAL_POSITION or s[at.NE_KIND] > at.KIND_TRAJECTORY:
            return None
        far = np.clip(s[at.POSITION : at.POSITION + 2], -1e6, 1e6).tolist()
        latitude, longitude = self.state.origin.globe_e7(*far)
        altitude = self.state.origin.altitude_m + float(s[at.POSITION + 2])
        zeros = (0.0,) * 8
        return (a.clock.stamp_ms, latitude, longitude, altitude, *zeros, 0xFDF8, 0)

    def servo_output_raw(self, link: Link) -> Values:
        """SERVO_OUTPUT_RAW: MOT_PWM_MIN..MAX in µs; unused outputs are zero."""
        a = self.state
        p, core = a.parameters, a.core
        least, most = p["MOT_PWM_MIN"], p["MOT_PWM_MAX"]
        outputs = [0] * 16
        for i, value in enumerate(
            core.memory[at.ACTUATORS : at.ACTUATORS + core.vehicle.rotor_count].tolist()
        ):
            outputs[i] = round(least + (most - least) * value)
        return (a.clock.stamp_us & 0xFFFFFFFF, *outputs[:8], 0, *outputs[8:])

    def rc_channels(self, link: Link) -> Values:
        """RC_CHANNELS: eight channels; the throttle is down unless somebody moves it."""
        a = self.state
        sticks = a.sticks
        first = (
            round(1500 + 500 * sticks.roll),
            round(1500 - 500 * sticks.pitch),
            round(1000 + 1000 * sticks.throttle),
            round(1500 + 500 * sticks.yaw),
        )
        shown, rssi = a.radio.received(first, 255)
        return (a.clock.stamp_ms, *shown, 1800, 1000, 1000, 1800, *([0] * 10), 8, rssi)
