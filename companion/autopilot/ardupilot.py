"""ArduPilot Copter: GUIDED and GUIDED_NOGPS. Facts from ArduCopter 4.7 (docs/autopilots.md says how each was seen).

GUIDED_NOGPS takes the same setpoints with the same meaning of thrust (GUID_OPTIONS) and the same GUID_TIMEOUT. What it does
not ask for is a GPS and a home, without which GUIDED is not armed. So it is the mode of a vehicle that has no GPS and gets
its position from poses: our laws need a local position in either mode.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from companion.autopilot.adapter import Adapter, Finding, Intent, Verdict, Version, held_setpoint
from companion.autopilot.vehicle_parameters import ARDUPILOT_PARAMETERS, from_ardupilot
from companion.config.provenance import Known
from companion.control.structs import ControlLevel
from companion.mavlink.link import mav
from companion.mavlink.protocol import Command

THRUST_AS_THRUST = 8
"""Bit 3 of GUID_OPTIONS: SET_ATTITUDE_TARGET's thrust is thrust. Without it, it is a climb rate about 0.5."""

GUIDED_HELD_S = 0.5
"""How long the last attitude and thrust of a dead companion are borne: for the 3 s that GUID_TIMEOUT ships with, 5 % above
hover is a climb of 2 m. A flight without states ends as soon by itself (`attitude_age_s`)."""

_SOURCES = ("EK3_SRC1_POSXY", "EK3_SRC1_VELXY", "EK3_SRC1_POSZ", "EK3_SRC1_VELZ", "EK3_SRC1_YAW")
EXTERNAL_NAVIGATION = 6.0
"""The value of EK3_SRC1_… that means ODOMETRY and the like."""

_GPS_TYPE = ("GPS1_TYPE", "GPS_TYPE")
"""The parameter that says which GPS there is, 0 none; the second name until 4.5."""

_MODES = {Intent.EXTERNAL: 4, Intent.LAND: 9, Intent.HOLD: 17, Intent.RETURN: 6}
_MODES_NO_GPS = {Intent.EXTERNAL: 20, Intent.LAND: 9, Intent.HOLD: 2}
_NAMES = {
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE", 9: "LAND",
    11: "DRIFT", 13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE", 18: "THROW", 20: "GUIDED_NOGPS",
    21: "SMART_RTL", 22: "FLOWHOLD", 23: "FOLLOW", 24: "ZIGZAG", 27: "AUTO_RTL",
}  # fmt: skip


class ArduPilot(Adapter):
    """See `Adapter`."""

    name = "ArduPilot"
    profile_key = "ardupilot"
    truth_message_id = mav.MAVLINK_MSG_ID_SIM_STATE
    estimator_message_id = mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT
    ahrs_tells_estimator = True  # AP_AHRS::healthy
    prearm_bit_counts = True
    wants_setpoints_first = False
    spool_time_s = 2.5  # 2 s arming delay and 0.5 s spool-up
    takes_local_ned_odometry = False
    bytewise_parameters = False
    hover_thrust_parameter = "MOT_THST_HOVER"
    pose_parameters = ("VISO_TYPE", *_SOURCES)
    modes = _MODES

    def mode(self, intent: Intent) -> Command:
        """See `Adapter.mode`."""
        return Command(mav.MAV_CMD_DO_SET_MODE, (1.0, float(self.modes[intent])), f"mode {intent.value}")

    def has_mode(self, intent: Intent) -> bool:
        """See `Adapter.has_mode`."""
        return intent in self.modes

    def mode_name(self, custom_mode: int) -> str:
        """See `Adapter.mode_name`."""
        return _NAMES.get(custom_mode, f"mode {custom_mode}")

    def is_mode(self, custom_mode: int, intent: Intent) -> bool:
        """See `Adapter.is_mode`."""
        return custom_mode == self.modes.get(intent)

    def parameters_needed(self) -> tuple[str, ...]:
        """See `Adapter.parameters_needed`."""
        return (
            "GUID_OPTIONS",
            "GUID_TIMEOUT",
            "ATC_ANGLE_BOOST",
            *ARDUPILOT_PARAMETERS,
            "ANGLE_MAX",
            "ATC_ANGLE_MAX",
            *_GPS_TYPE,
        )

    def suited(self, parameters: Mapping[str, float]) -> ArduPilot:
        """See `Adapter.suited`: without any GPS the one for GUIDED_NOGPS."""
        types = [parameters[name] for name in _GPS_TYPE if name in parameters]
        return ArduPilotNoGps() if types and not any(types) else ArduPilot()

    def tilt_limit_deg(self, parameters: Mapping[str, float]) -> float:
        """See `Adapter.tilt_limit_deg`: ATC_ANGLE_MAX in °, before 4.7 ANGLE_MAX in centidegrees."""
        newest, older = parameters.get("ATC_ANGLE_MAX"), parameters.get("ANGLE_MAX")
        if newest is not None:
            return newest
        return older / 100.0 if older is not None else math.inf

    def tells(self, parameters: Mapping[str, float], vehicle_type: int) -> list[Known]:
        """See `Adapter.tells`."""
        return from_ardupilot(parameters, vehicle_type, self.tilt_limit_deg(parameters))

    def uses_poses(self, parameters: Mapping[str, float]) -> bool | None:
        """See `Adapter.uses_poses`: VISO_TYPE on, and any source of the first set external navigation."""
        sources = [parameters[name] for name in _SOURCES if name in parameters]
        if parameters.get("VISO_TYPE") == 0.0:
            return False
        return EXTERNAL_NAVIGATION in sources if sources else None

    def check(
        self, parameters: Mapping[str, float], level: ControlLevel, version: Version | None
    ) -> list[Finding]:
        """See `Adapter.check`."""
        findings = []
        if level is ControlLevel.ACTUATOR:
            findings.append(
                Finding(
                    Verdict.REFUSAL,
                    "actuator controls",
                    "ArduPilot",
                    "ArduPilot never took SET_ACTUATOR_CONTROL_TARGET",
                    "fly at --level body_rate",
                )
            )
        options = parameters.get("GUID_OPTIONS")
        if options is None:
            findings.append(
                Finding(
                    Verdict.REFUSAL,
                    "GUID_OPTIONS",
                    "not answered",
                    "without bit 3 thrust means climb rate, so it has to be known",
                    "check the link's quality and try again",
                )
            )
        elif not int(options) & THRUST_AS_THRUST:
            findings.append(
                Finding(
                    Verdict.REFUSAL,
                    "GUID_OPTIONS",
                    f"{options:.0f}",
                    "thrust means climb rate on this vehicle",
                    f"set GUID_OPTIONS to {int(options) | THRUST_AS_THRUST} (it is {options:.0f}), or fly with --fix",
                    ("GUID_OPTIONS", float(int(options) | THRUST_AS_THRUST)),
                )
            )
        else:
            findings.append(Finding(Verdict.OK, "GUID_OPTIONS", f"{options:.0f}", "thrust means thrust"))
        boost = parameters.get("ATC_ANGLE_BOOST")
        if boost is None or boost != 0.0:
            findings.append(
                Finding(
                    Verdict.REFUSAL,
                    "ATC_ANGLE_BOOST",
                    "not answered" if boost is None else f"{boost:.0f}",
                    "the autopilot would multiply our thrust by 1/cos(tilt) once more",
                    "set ATC_ANGLE_BOOST to 0, or fly with --fix",
                    None if boost is None else ("ATC_ANGLE_BOOST", 0.0),
                )
            )
        else:
            findings.append(Finding(Verdict.OK, "ATC_ANGLE_BOOST", "0", "thrust goes through as sent"))
        timeout = parameters.get("GUID_TIMEOUT")
        if timeout is not None:
            findings.append(
                held_setpoint("GUID_TIMEOUT", timeout, GUIDED_HELD_S, "set GUID_TIMEOUT to", level)
            )
        hover = parameters.get("MOT_THST_HOVER")
        if hover is not None:
            sane = 0.1 <= hover <= 0.8
            findings.append(
                Finding(
                    Verdict.OK if sane else Verdict.REFUSAL,
                    "MOT_THST_HOVER",
                    f"{hover:.3f}",
                    "thrust in newtons is scaled by it",
                    "" if sane else "hover once in ALT_HOLD with MOT_HOVER_LEARN 2",
                )
            )
        return findings


class ArduPilotNoGps(ArduPilot):
    """ArduPilot on a vehicle without GPS: GUIDED_NOGPS, and ALT_HOLD instead of BRAKE, which needs what GUIDED needs."""

    modes = _MODES_NO_GPS

    def check(
        self, parameters: Mapping[str, float], level: ControlLevel, version: Version | None
    ) -> list[Finding]:
        """See `Adapter.check`."""
        mode = Finding(
            Verdict.OK,
            "mode",
            "GUIDED_NOGPS",
            "this vehicle has no GPS (GPS1_TYPE 0); handed back, it holds its height only (ALT_HOLD)",
        )
        return [mode, *super().check(parameters, level, version)]
