"""What differs between autopilots, as one contract. `px4.py` and `ardupilot.py` fill it in.

An adapter knows modes and their numbers, what has to be true before a flight, what thrust means and how a
setpoint is encoded. It holds no connection and sends nothing: it answers questions.
"""

from __future__ import annotations

import enum
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

from companion.config.provenance import Known
from companion.control.structs import ControlLevel, Reference, Setpoint, Vector
from companion.mavlink.frames import (
    frd_from_flu,
    ned_from_enu,
    quaternion_ned_frd_from_enu_flu,
    yaw_ned_from_enu,
)
from companion.mavlink.link import Message, mav
from companion.mavlink.protocol import Command

TYPE_MASK_ATTITUDE = (
    mav.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
    | mav.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
    | mav.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
)  # 7: attitude and thrust count. Mask 0 (everything counts) is a trap on both autopilots.
TYPE_MASK_BODY_RATE = mav.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE  # 128: body rates and thrust count

_VITAL_SENSORS = (
    mav.MAV_SYS_STATUS_SENSOR_3D_GYRO | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL | mav.MAV_SYS_STATUS_AHRS
)
_ESTIMATOR_RATIOS = ("vel_ratio", "pos_horiz_ratio", "pos_vert_ratio", "mag_ratio", "hagl_ratio")
_EKF_VARIANCES = ("velocity_variance", "pos_horiz_variance", "pos_vert_variance", "compass_variance")


TRUTH_MESSAGES = frozenset((mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, mav.MAVLINK_MSG_ID_SIM_STATE))
"""Messages that only a simulation can send: its true state."""
STATUS_MESSAGES = frozenset(
    (
        mav.MAVLINK_MSG_ID_HEARTBEAT,
        mav.MAVLINK_MSG_ID_CURRENT_MODE,
        mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
        mav.MAVLINK_MSG_ID_SYS_STATUS,
        mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
        mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
        mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
        mav.MAVLINK_MSG_ID_STATUSTEXT,
    )
)
"""Messages that `VehicleStatus` knows."""


Version = tuple[int, int, int]
"""Major, minor, patch of AUTOPILOT_VERSION.flight_sw_version."""


def version_text(version: Version | None) -> str:
    """A version for people."""
    return "of unknown version" if version is None else ".".join(map(str, version))


class Verdict(enum.Enum):
    """How a preflight check ended."""

    OK = "ok"
    WARNING = "warning"
    """Flyable, but the pilot should know."""
    REFUSAL = "refusal"
    """Not flyable as it is."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One preflight check: what was looked at, what was found, why it matters, and what mends it."""

    verdict: Verdict
    subject: str
    found: str
    why: str = ""
    remedy: str = ""
    fix: tuple[str, float] | None = None  # (parameter, value) that is safe to set for the flight


RATES_HELD_S, TORQUES_HELD_S = 0.5, 0.2
"""How long the last body rates (a turn at 1 rad/s is then 30°) or torques (which quicken a turn: 10 rad/s² are then 11°)
of a companion that has died may be held."""


def held_setpoint(name: str, held_s: float, longest_s: float, remedy: str, level: ControlLevel) -> Finding:
    """Judge how long the last setpoint is followed after the companion has died.

    Args:
        name: of the parameter that says so.
        held_s: its value, s.
        longest_s: what is borne at the attitude level.
        remedy: how it is set, up to the value.
        level: of the flight.
    """
    wanted_s, why = min(1.0, longest_s), "a dead companion is noticed this late only"
    if level is not ControlLevel.ATTITUDE:
        longest_s = wanted_s = RATES_HELD_S if level is ControlLevel.BODY_RATE else TORQUES_HELD_S
        why = (
            "when the companion dies its last rates or torques are held for so long: the vehicle may tip over"
        )
    found = f"{held_s:.1f} s"
    if held_s > longest_s:
        fix = f"{remedy} {wanted_s:g}, or fly with --fix"
        return Finding(Verdict.WARNING, name, found, why, fix, (name, wanted_s))
    return Finding(Verdict.OK, name, found)


class Intent(enum.Enum):
    """Modes the companion asks for, by what they are for."""

    EXTERNAL = "external"
    """The autopilot follows our setpoints: PX4 OFFBOARD, ArduPilot GUIDED or GUIDED_NOGPS."""
    LAND = "land"
    """The autopilot lands where it is."""
    HOLD = "hold"
    """The autopilot holds its position: PX4 AUTO.LOITER, ArduPilot BRAKE (LOITER needs sticks), without GPS ALT_HOLD."""
    RETURN = "return"
    """The autopilot returns to its home and lands there: PX4 AUTO.RTL, ArduPilot RTL. Not to be had without GPS."""


@dataclass(slots=True)
class VehicleStatus:
    """What the autopilot says of itself, kept up to date by `take`."""

    custom_mode: int = -1
    armed: bool = False
    landed_state: int = mav.MAV_LANDED_STATE_UNDEFINED
    prearm_ok: bool | None = None
    estimator_flags: int | None = None
    innovation_ratio: float | None = None  # the largest the estimator tells; above 1 it rejects a measurement
    sensors_unhealthy: float | None = (
        None  # of gyroscope, accelerometer and attitude estimate: enabled, not healthy
    )
    battery_remaining: float | None = None  # 0..1
    battery_voltage_v: float | None = None
    global_origin: tuple[float, float, float] | None = None  # latitude °, longitude °, altitude m
    texts: list[tuple[int, str]] = field(default_factory=list)  # (severity, text), newest last, bounded
    height_accuracy_m: float | None = None  # by how much the estimated height may be wrong (ESTIMATOR_STATUS)
    receiver_healthy: bool | None = None  # None: not told, or no receiver enabled
    heard_s: dict[int, float] = field(
        default_factory=dict
    )  # message number → when it came, autopilot's clock
    ahrs_tells_estimator: bool = False  # whether SYS_STATUS' attitude estimate stands for the whole estimator
    estimator_told_s: float | None = None  # when anything last told of the estimator

    def take(self, message: Message, time_s: float = 0.0) -> None:
        """Take one message that came at `time_s`, the autopilot's clock; ignores what it does not know."""
        kind = message.get_msgId()
        if kind == mav.MAVLINK_MSG_ID_HEARTBEAT:
            self.custom_mode = message.custom_mode
            self.armed = bool(message.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
        elif kind == mav.MAVLINK_MSG_ID_CURRENT_MODE:  # several times a second, where HEARTBEAT comes once
            self.custom_mode = message.custom_mode
        elif kind == mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
            self.landed_state = message.landed_state
        elif kind == mav.MAVLINK_MSG_ID_SYS_STATUS:
            present = message.onboard_control_sensors_present & mav.MAV_SYS_STATUS_PREARM_CHECK
            healthy = message.onboard_control_sensors_health & mav.MAV_SYS_STATUS_PREARM_CHECK
            self.prearm_ok = bool(healthy) if present else None
            sick = message.onboard_control_sensors_enabled & ~message.onboard_control_sensors_health
            self.sensors_unhealthy = float((sick & _VITAL_SENSORS).bit_count())
            enabled = message.onboard_control_sensors_enabled
            receiver = enabled & mav.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
            self.receiver_healthy = not sick & receiver if receiver else None
            if self.ahrs_tells_estimator and enabled & mav.MAV_SYS_STATUS_AHRS:
                self.estimator_told_s = time_s
            self.battery_remaining = (
                message.battery_remaining / 100.0 if message.battery_remaining >= 0 else None
            )
            self.battery_voltage_v = (
                message.voltage_battery / 1000.0 if message.voltage_battery != 65535 else None
            )
        elif kind in (mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS, mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT):
            self.estimator_told_s = time_s
            self.estimator_flags = message.flags  # the low bits mean the same in both messages
            names = _ESTIMATOR_RATIOS if kind == mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS else _EKF_VARIANCES
            ratios = [float(getattr(message, name)) for name in names]
            if kind == mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS:
                accuracy_m = float(message.pos_vert_accuracy)
                self.height_accuracy_m = (
                    accuracy_m if accuracy_m > 0.0 and math.isfinite(accuracy_m) else None
                )
            self.innovation_ratio = max((ratio for ratio in ratios if math.isfinite(ratio)), default=None)
        elif kind == mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN:
            self.global_origin = (message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1e3)
        elif kind == mav.MAVLINK_MSG_ID_STATUSTEXT:
            self.texts = [*self.texts[-19:], (message.severity, str(message.text))]


class Adapter(ABC):
    """One autopilot's ways."""

    name: str
    """For people: `PX4`, `ArduPilot`."""
    profile_key: str
    """Names this autopilot's responses in a vehicle profile."""
    truth_message_id: int
    """The message a simulation of this autopilot gives its true state in."""
    estimator_message_id: int
    """The message that tells what the estimator knows: ESTIMATOR_STATUS or EKF_STATUS_REPORT."""
    ahrs_tells_estimator: bool
    """Whether SYS_STATUS' attitude estimate is unhealthy when any part of the estimator is."""
    prearm_bit_counts: bool
    """Whether SYS_STATUS' pre-arm bit must be set before our mode is entered (on PX4 it is the current mode's)."""
    wants_setpoints_first: bool
    """Whether setpoints have to come in before our mode is entered, in the air too (PX4)."""
    spool_time_s: float
    """From arming until positive thrust turns into thrust."""
    bytewise_parameters: bool
    """Whether integer parameters travel as bit patterns (PX4) or as values (ArduPilot)."""
    takes_local_ned_odometry: bool
    """Whether ODOMETRY may be in MAV_FRAME_LOCAL_NED, so that its yaw is a heading; else MAV_FRAME_LOCAL_FRD only."""
    hover_thrust_parameter: str
    """The parameter that holds the thrust setpoint of hovering flight."""
    mass_parameter = ""
    """The parameter that holds its own simulator's mass, kg; empty where there is none."""

    @abstractmethod
    def mode(self, intent: Intent) -> Command:
        """The MAV_CMD_DO_SET_MODE that asks for `intent`."""

    def has_mode(self, intent: Intent) -> bool:
        """Whether there is a mode for `intent`."""
        return True

    @property
    def takes_positions(self) -> bool:
        """Whether its own controller follows a position (`encode_reference`)."""
        return True

    @abstractmethod
    def mode_name(self, custom_mode: int) -> str:
        """A custom_mode of HEARTBEAT as the autopilot's users call it."""

    @abstractmethod
    def is_mode(self, custom_mode: int, intent: Intent) -> bool:
        """Whether HEARTBEAT's custom_mode is the mode of `intent`."""

    @abstractmethod
    def parameters_needed(self) -> tuple[str, ...]:
        """Names of the parameters that `check` and the flight look at."""

    @abstractmethod
    def check(
        self, parameters: Mapping[str, float], level: ControlLevel, version: Version | None
    ) -> list[Finding]:
        """Judge parameters and firmware version (None: not known) for a flight at `level`."""

    @abstractmethod
    def tells(self, parameters: Mapping[str, float], vehicle_type: int) -> list[Known]:
        """What the parameters tell of the vehicle; `vehicle_type` is HEARTBEAT's MAV_TYPE."""

    def suited(self, parameters: Mapping[str, float]) -> Adapter:
        """The adapter for a vehicle with these parameters: this one, or another one of the same autopilot."""
        return self

    pose_parameters: tuple[str, ...]
    """Names of the parameters that say whether the estimator takes anything from ODOMETRY."""

    @abstractmethod
    def uses_poses(self, parameters: Mapping[str, float]) -> bool | None:
        """Whether the estimator takes anything from ODOMETRY; None where the parameters do not say."""

    def tilt_limit_deg(self, parameters: Mapping[str, float]) -> float:
        """Where the autopilot cuts the tilt of our attitude setpoints, °; infinite where it does not."""
        return math.inf

    def not_ready(self, status: VehicleStatus) -> list[str]:
        """Why the autopilot cannot be armed for our mode yet; empty when it can."""
        reasons = []
        if self.prearm_bit_counts and status.prearm_ok is not True:
            reasons.append("pre-arm checks not passed")
        flags = status.estimator_flags
        if flags is not None:
            needed = {
                mav.ESTIMATOR_ATTITUDE: "attitude",
                mav.ESTIMATOR_VELOCITY_HORIZ: "horizontal velocity",
                mav.ESTIMATOR_VELOCITY_VERT: "vertical velocity",
            }
            reasons += [f"estimator has no {what}" for bit, what in needed.items() if not flags & bit]
            if not flags & (mav.ESTIMATOR_POS_HORIZ_REL | mav.ESTIMATOR_POS_HORIZ_ABS):
                reasons.append("estimator has no horizontal position")
        return reasons

    def encode(self, setpoint: Setpoint, time_s: float, thrust: float, target_system: int) -> Message:
        """SET_ATTITUDE_TARGET of a setpoint at the attitude or body-rate level.

        Args:
            setpoint: what the control law asks for (ENU/FLU).
            time_s: the autopilot's time since boot it is for.
            thrust: the collective as the autopilot means it, 0..1.
            target_system: the autopilot's system id.
        """
        return attitude_target(
            target_system,
            time_s,
            TYPE_MASK_ATTITUDE if setpoint.level is ControlLevel.ATTITUDE else TYPE_MASK_BODY_RATE,
            setpoint.quaternion_wxyz,
            setpoint.body_rate_flu,
            thrust,
        )

    def encode_reference(self, reference: Reference, time_s: float, target_system: int) -> Message:
        """SET_POSITION_TARGET_LOCAL_NED of a reference, for the autopilot's own controller; both take it alike.

        Args:
            reference: position, velocity, acceleration and yaw count (ENU).
            time_s: the autopilot's time since boot it is for.
            target_system: the autopilot's system id.
        """
        return mav.MAVLink_set_position_target_local_ned_message(
            round(time_s * 1e3) & 0xFFFFFFFF,
            target_system,
            mav.MAV_COMP_ID_AUTOPILOT1,
            mav.MAV_FRAME_LOCAL_NED,
            mav.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE,
            *ned_from_enu(reference.position_enu).tolist(),
            *ned_from_enu(reference.velocity_enu).tolist(),
            *ned_from_enu(reference.acceleration_enu).tolist(),
            math.remainder(yaw_ned_from_enu(reference.yaw_rad), math.tau),
            0.0,
        )

    def encode_actuators(self, time_s: float, controls: Vector, target_system: int) -> Message:
        """Message for actuator controls (4,): roll, pitch, yaw (FLU, −1..1), thrust (0..1).

        Raises:
            NotImplementedError: the autopilot never took them; `check` refuses such a flight.
        """
        raise NotImplementedError(f"{self.name} takes no actuator controls")


def attitude_target(
    target_system: int,
    time_s: float,
    type_mask: int,
    quaternion_wxyz: Vector,
    body_rate_flu: Vector,
    thrust: float,
) -> Message:
    """SET_ATTITUDE_TARGET from ENU/FLU values: quaternion (4,), body rate (3,) rad/s, thrust 0..1."""
    roll_rate, pitch_rate, yaw_rate = frd_from_flu(body_rate_flu).tolist()
    return mav.MAVLink_set_attitude_target_message(
        round(time_s * 1e3) & 0xFFFFFFFF,
        target_system,
        mav.MAV_COMP_ID_AUTOPILOT1,
        type_mask,
        quaternion_ned_frd_from_enu_flu(quaternion_wxyz).tolist(),
        roll_rate,
        pitch_rate,
        yaw_rate,
        thrust,
    )


ARM = Command(mav.MAV_CMD_COMPONENT_ARM_DISARM, (1.0,), "arm")
DISARM = Command(mav.MAV_CMD_COMPONENT_ARM_DISARM, (0.0,), "disarm")
STOP_MOTORS = Command(mav.MAV_CMD_COMPONENT_ARM_DISARM, (0.0, 21196.0), "disarm in flight")
"""21196 is the magic number that makes both autopilots disarm in the air."""
