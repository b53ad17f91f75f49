"""What PX4 says once a second or less: of its links, the way home, the receiver's integrity, remote identification.

Fields and conditions are those of PX4 1.17's `src/modules/mavlink/streams/` (LINK_NODE_STATUS.hpp,
TIME_ESTIMATE_TO_TARGET.hpp, GNSS_INTEGRITY.hpp, OPEN_DRONE_ID_LOCATION.hpp, OPEN_DRONE_ID_SYSTEM.hpp); what its own
simulator leaves unknown (UTC by satellite, the authentication of signals) is unknown here.
"""

from __future__ import annotations

import math

from sitl_stub.firmware.common.wire_values import Values
from sitl_stub.firmware.px4.modes import Mode
from sitl_stub.firmware.px4.navigator import Navigator
from sitl_stub.firmware.px4.state import Px4State
from sitl_stub.mavlink.links import Link

RECEIVER_ID = 4
"""Last byte of the device id of PX4's simulated receiver, as in the capture."""
LONGEST_S = 2**31 - 1
SLOWEST_M_S = 0.1
"""Parameters may be set to anything; slower than this is taken for this."""
UNKNOWN_8, UNKNOWN_16 = 255, 65535
UNTOLD_ID = (0,) * 20
"""`id_or_mac`, which only messages about other aircraft carry."""

ON_GROUND, AIRBORNE, EMERGENCY = 1, 2, 3
"""MAV_ODID_STATUS."""
WITHIN_1_M, WITHIN_3_M_UP, WITHIN_1_M_S = 12, 5, 3
"""MAV_ODID_HOR_ACC, VER_ACC and SPEED_ACC of the simulated receiver (eph 0.9 m, epv 1.78 m, 0.4 m²/s²)."""
UNKNOWN_DIRECTION, UNKNOWN_SPEED, UNKNOWN_CLIMB = 36100, 25500, 6300
UNKNOWN_ALTITUDE_M = -1000.0
UNKNOWN_HOUR_S = 65535.0
FASTEST_CM_S, FASTEST_CLIMB_CM_S = 25425, 6200
UTC_OFFSET_S = 1_546_300_800
"""Begin of 2019, from which OPEN_DRONE_ID_SYSTEM counts."""
TAKEOFF_PLACE = 0
"""MAV_ODID_OPERATOR_LOCATION_TYPE."""


class Px4Reports:
    """Builders of the slow reports of one vehicle."""

    def __init__(self, state: Px4State, navigator: Navigator) -> None:
        self.state = state
        self.navigator = navigator

    def link_node_status(self, link: Link) -> Values:
        """LINK_NODE_STATUS: what this link has carried. PX4 leaves the fill of the buffers at 0, and stamps in µs."""
        a, traffic = self.state, link.traffic
        traffic.measure(a.clock.time_us)
        return (
            a.clock.stamp_us,
            round(traffic.sent_bytes_s),
            round(traffic.received_bytes_s),
            traffic.sent,
            traffic.received,
            traffic.lost,
            link.counters.bad_checksum & 0xFFFF,
            traffic.overflows & 0xFFFF,
            0,
            0,
            0,
        )

    def time_estimate_to_target(self, link: Link) -> Values:
        """TIME_ESTIMATE_TO_TARGET: seconds that RTL would take at the most; PX4 estimates nothing else."""
        return (int(min(max(self._safe_return_s(), 0.0), LONGEST_S)), -1, -1, -1, -1)

    def _safe_return_s(self) -> float:
        """As `RtlDirect::calc_rtl_time_estimate`; 0 on the ground or without a place."""
        a = self.state
        core, p, navigator = a.core, a.parameters, self.navigator
        if not (a.home_known and core.position_valid) or a.ground.landed:
            return 0.0
        height = a.height_above_home_m
        names = ("MPC_Z_V_AUTO_UP", "MPC_Z_V_AUTO_DN", "MPC_XY_CRUISE")
        up, sink, along = (max(float(p[name]), SLOWEST_M_S) for name in names)
        if navigator.mode is Mode.RTL and navigator.stage == "land":
            seconds = abs(height) / sink
        else:
            away = a.distance_from_home_m
            top = navigator.return_height(away, height)
            low = min(float(p["RTL_DESCEND_ALT"]), top)
            seconds = (top - height) / up + away / along + (top - low) / sink
            if p["RTL_LAND_DELAY"] >= 0.0:  # a negative one waits there for good
                seconds += float(p["RTL_LAND_DELAY"]) + low / sink
        return float(p["RTL_TIME_FACTOR"]) * seconds + float(p["RTL_TIME_MARGIN"])

    def gnss_integrity(self, link: Link) -> Values:
        """GNSS_INTEGRITY: the simulated receiver knows of no errors and judges nothing."""
        return (0, UNKNOWN_16, UNKNOWN_16, RECEIVER_ID, 0, 0, 0, 0, *(UNKNOWN_8,) * 4)

    def open_drone_id_location(self, link: Link) -> Values:
        """OPEN_DRONE_ID_LOCATION: place, height over home and motion, in whole degrees and metres where PX4 rounds."""
        a = self.state
        core = a.core
        north, east, down = core.position_ned.tolist()
        altitude = self.state.origin.altitude_of(down)
        fix, _ = self.state.gps_fix
        place, geodetic, accuracy = (0, 0), UNKNOWN_ALTITUDE_M, (0, 0)
        motion, speed_accuracy = (UNKNOWN_DIRECTION, UNKNOWN_SPEED, UNKNOWN_CLIMB), 0
        if fix >= 3:
            place, geodetic = self.state.origin.globe_e7(north, east), float(round(altitude))
            accuracy = (WITHIN_1_M, WITHIN_3_M_UP)
            motion, speed_accuracy = self._motion(), WITHIN_1_M_S
        height = float(a.home_ned[2]) - down if a.home_known and core.position_valid else UNKNOWN_ALTITUDE_M
        status = ON_GROUND if a.ground.landed else AIRBORNE
        if a.armed and a.failsafe:
            status = EMERGENCY
        head = (*place, altitude, geodetic, height, UNKNOWN_HOUR_S, *motion, 0, 0, *UNTOLD_ID)
        return (*head, status, 0, *accuracy, 0, speed_accuracy, 0)

    def _motion(self) -> tuple[int, int, int]:
        """Course in whole degrees as centidegrees, speed and climb in cm/s."""
        vx, vy, vz = self.state.core.velocity_ned.tolist()
        course = 100 * round(math.degrees(math.atan2(vy, vx)) % 360.0)
        speed = min(int(100.0 * math.hypot(vx, vy)), FASTEST_CM_S)
        climb = min(max(round(-100.0 * vz), -FASTEST_CLIMB_CM_S), FASTEST_CLIMB_CM_S)
        return min(course, 35999), speed, climb

    def open_drone_id_system(self, link: Link) -> Values | None:
        """OPEN_DRONE_ID_SYSTEM: the operator is where the flight began; silent without a 3-D fix and a home.

        Its time is UTC by satellite less the year 2019; PX4's simulated receiver has no UTC, and the difference wraps.
        """
        a = self.state
        if not a.home_known or self.state.gps_fix[0] < 3:
            return None
        north, east, down = a.home_ned.tolist()
        place = self.state.origin.globe_e7(north, east)
        altitude = self.state.origin.altitude_of(down)
        head = (*place, UNKNOWN_ALTITUDE_M, UNKNOWN_ALTITUDE_M, altitude, -UTC_OFFSET_S & 0xFFFFFFFF)
        return (*head, 1, 0, 0, 0, *UNTOLD_ID, TAKEOFF_PLACE, 0, 0, 0)
