"""PX4: OFFBOARD mode. Facts from PX4 v1.13 and v1.17 (docs/autopilots.md says how each was seen)."""

from __future__ import annotations

from collections.abc import Mapping

from companion.autopilot.adapter import (
    Adapter,
    Finding,
    Intent,
    Verdict,
    Version,
    held_setpoint,
    version_text,
)
from companion.autopilot.vehicle_parameters import PX4_PARAMETERS, from_px4
from companion.config.provenance import Known
from companion.control.structs import ControlLevel, Vector
from companion.mavlink.frames import frd_from_flu
from companion.mavlink.link import Message, mav
from companion.mavlink.protocol import Command

MAIN_AUTO, MAIN_OFFBOARD = 4, 6
SUB_LOITER, SUB_RTL, SUB_LAND = 3, 5, 6
_MODES = {
    Intent.EXTERNAL: (MAIN_OFFBOARD, 0),
    Intent.LAND: (MAIN_AUTO, SUB_LAND),
    Intent.HOLD: (MAIN_AUTO, SUB_LOITER),
    Intent.RETURN: (MAIN_AUTO, SUB_RTL),
}
_MAIN_NAMES = {
    1: "MANUAL",
    2: "ALTCTL",
    3: "POSCTL",
    4: "AUTO",
    5: "ACRO",
    6: "OFFBOARD",
    7: "STABILIZED",
    8: "RATTITUDE",
}
_AUTO_NAMES = {
    1: "READY",
    2: "TAKEOFF",
    3: "LOITER",
    4: "MISSION",
    5: "RTL",
    6: "LAND",
    8: "FOLLOW",
    9: "PRECLAND",
}

LAST_ACTUATOR_VERSION = (1, 13, 3)
"""The last release that acts on SET_ACTUATOR_CONTROL_TARGET; from 1.14 it arrives and nothing happens."""

_HEIGHT_FROM_VISION = 3.0  # of EKF2_HGT_REF
_LOSS_ACTIONS = {
    -1: "disabled",
    0: "position",
    1: "altitude",
    2: "manual",
    3: "return",
    4: "land",
    5: "hold",
    6: "terminate",
    7: "disarm",
}


class Px4(Adapter):
    """See `Adapter`."""

    name = "PX4"
    profile_key = "px4"
    truth_message_id = mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION
    estimator_message_id = mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS
    ahrs_tells_estimator = False  # it says nothing of position
    prearm_bit_counts = False
    wants_setpoints_first = True
    spool_time_s = 1.0  # COM_SPOOLUP_TIME
    takes_local_ned_odometry = True
    bytewise_parameters = True
    hover_thrust_parameter = "MPC_THR_HOVER"
    mass_parameter = "SIH_MASS"
    pose_parameters = ("EKF2_EV_CTRL",)  # until 1.13: EKF2_AID_MASK, which is not looked at

    def mode(self, intent: Intent) -> Command:
        """See `Adapter.mode`: base mode 1 (custom), main and sub mode."""
        main, sub = _MODES[intent]
        return Command(mav.MAV_CMD_DO_SET_MODE, (1.0, float(main), float(sub)), f"mode {intent.value}")

    def mode_name(self, custom_mode: int) -> str:
        """See `Adapter.mode_name`."""
        main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
        name = _MAIN_NAMES.get(main, f"mode {main}")
        return f"AUTO.{_AUTO_NAMES.get(sub, sub)}" if main == MAIN_AUTO else name

    def is_mode(self, custom_mode: int, intent: Intent) -> bool:
        """See `Adapter.is_mode`."""
        return (custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF) == _MODES[intent]

    def parameters_needed(self) -> tuple[str, ...]:
        """See `Adapter.parameters_needed`."""
        return (
            *PX4_PARAMETERS,
            "COM_OF_LOSS_T",
            "COM_OBL_RC_ACT",
            "COM_RC_OVERRIDE",
            "COM_RCL_EXCEPT",
            "COM_SPOOLUP_TIME",
            "COM_DISARM_PRFLT",
            "EKF2_HGT_REF",
            "EKF2_RNG_CTRL",
        )

    def tells(self, parameters: Mapping[str, float], vehicle_type: int) -> list[Known]:
        """See `Adapter.tells`."""
        return from_px4(parameters, vehicle_type)

    def uses_poses(self, parameters: Mapping[str, float]) -> bool | None:
        """See `Adapter.uses_poses`: any bit of EKF2_EV_CTRL."""
        fused = parameters.get("EKF2_EV_CTRL")
        return None if fused is None else fused != 0.0

    def check(
        self, parameters: Mapping[str, float], level: ControlLevel, version: Version | None
    ) -> list[Finding]:
        """See `Adapter.check`."""
        findings = []
        if level is ControlLevel.ACTUATOR:
            old_enough = version is not None and version <= LAST_ACTUATOR_VERSION
            findings.append(
                Finding(
                    Verdict.OK if old_enough else Verdict.REFUSAL,
                    "actuator controls",
                    f"firmware {version_text(version)}",
                    ""
                    if old_enough
                    else "PX4 takes SET_ACTUATOR_CONTROL_TARGET up to 1.13 only; later ones ignore it",
                    "" if old_enough else "fly at --level body_rate",
                )
            )
        hover = parameters.get("MPC_THR_HOVER")
        if hover is None:
            findings.append(
                _unread("MPC_THR_HOVER", "the scale of thrust starts from the profile's hover_thrust")
            )
        else:
            sane = 0.1 <= hover <= 0.8
            findings.append(
                Finding(
                    Verdict.OK if sane else Verdict.REFUSAL,
                    "MPC_THR_HOVER",
                    f"{hover:.3f}",
                    "thrust in newtons is scaled by it"
                    if sane
                    else "no multirotor hovers there; thrust would be scaled wrongly",
                    ""
                    if sane
                    else "fly manually once with MPC_USE_HTE 1 and take the estimate, then: param set MPC_THR_HOVER",
                )
            )
        loss_time = parameters.get("COM_OF_LOSS_T")
        if loss_time is not None:
            findings.append(held_setpoint("COM_OF_LOSS_T", loss_time, 2.0, "param set COM_OF_LOSS_T", level))
        action = parameters.get("COM_OBL_RC_ACT")
        if action is not None:
            lands = action not in (-1.0, 2.0, 6.0, 7.0)
            findings.append(
                Finding(
                    Verdict.OK if lands else Verdict.WARNING,
                    "COM_OBL_RC_ACT",
                    f"{action:.0f} ({_LOSS_ACTIONS.get(int(action), 'unknown')})",
                    ""
                    if lands
                    else "when the companion dies the vehicle is not brought down by the autopilot",
                    "" if lands else "param set COM_OBL_RC_ACT 4 (land)",
                )
            )
        idle = parameters.get("COM_DISARM_PRFLT")
        if idle is not None and idle <= 0.0:
            findings.append(
                Finding(
                    Verdict.WARNING,
                    "COM_DISARM_PRFLT",
                    f"{idle:.0f} s",
                    "if the companion dies before lift-off, the vehicle stays armed on the ground",
                    "param set COM_DISARM_PRFLT 10, or fly with --fix",
                    ("COM_DISARM_PRFLT", 10.0),
                )
            )
        override = parameters.get("COM_RC_OVERRIDE")
        if override is not None and not int(override) & 2:
            findings.append(
                Finding(
                    Verdict.WARNING,
                    "COM_RC_OVERRIDE",
                    f"{override:.0f}",
                    "moving the sticks does not take the vehicle out of offboard; the mode switch does",
                    f"param set COM_RC_OVERRIDE {int(override) | 2}",
                )
            )
        if parameters.get("EKF2_HGT_REF") == _HEIGHT_FROM_VISION and parameters.get("EKF2_RNG_CTRL") == 1.0:
            findings.append(
                Finding(
                    Verdict.WARNING,
                    "EKF2_RNG_CTRL",
                    "1 (conditional)",
                    "low and slow, a range finder takes the height reference from the poses, and height drifts off them",
                    "param set EKF2_RNG_CTRL 0",
                )
            )
        return findings

    def encode_actuators(self, time_s: float, controls: Vector, target_system: int) -> Message:
        """SET_ACTUATOR_CONTROL_TARGET, group 0; see `Adapter.encode_actuators`."""
        torque_frd = frd_from_flu(controls[:3])
        group = [float(value) for value in (*torque_frd, controls[3], 0.0, 0.0, 0.0, 0.0)]
        return mav.MAVLink_set_actuator_control_target_message(
            round(time_s * 1e6), 0, target_system, mav.MAV_COMP_ID_AUTOPILOT1, group
        )


def _unread(name: str, consequence: str) -> Finding:
    return Finding(
        Verdict.WARNING, name, "not answered", consequence, "check the link's quality and try again"
    )
