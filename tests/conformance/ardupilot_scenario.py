"""The scripted session of the ArduPilot capture, flown again: same phases at the same times of the autopilot's clock.

Nothing streams until asked for, so the session begins with SET_MESSAGE_INTERVAL for ATTITUDE, whose times are its clock.
The capture's own hold law is not in its log; the one here does the same job (see `hold`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from px4_scenario import ATTITUDE_ONLY, INTERVALS, NO_THROTTLE, RATES_ONLY, ScenarioPilot, Session
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

HOVER_THRUST = 0.369
HEIGHT_M = 2.5
STEP_YAW_RAD = 0.8
ATTITUDE_INTERVAL_US = 10000
LEMNISCATE_PERIODS_S = (4.0, 8.0)
LEMNISCATE_SIZE_M = (0.5, 1.0)
GUIDED, LOITER, LAND = 4, 5, 9
PARAMETERS = {45.52: (b"GUID_OPTIONS", 8.0), 45.82: (b"ATC_ANGLE_BOOST", 0.0)}


class ArduPilotPilot(ScenarioPilot):
    """Flies the session on a mavutil connection."""

    def __init__(self, connection: Any, until_s: float = 1e9) -> None:
        super().__init__(connection, until_s)
        self.asked = False
        self.yaw0: float | None = None
        self.start = (0.0, 0.0)

    def _take(self, message: Any) -> None:
        if message.get_type() == "HEARTBEAT" and message.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
            if not self.asked:
                self.asked = True
                self.command(
                    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                    mavlink.MAVLINK_MSG_ID_ATTITUDE,
                    ATTITUDE_INTERVAL_US,
                )
            armed = bool(message.base_mode & 128)
            self._armed_seen |= armed
            if self._armed_seen and not armed and self.time_s > 60.0:
                self.done = True
        super()._take(message)

    # --- what is sent ------------------------------------------------------------------------------------------
    def thrust_for_height(self) -> float:
        climb = 0.6 * (-HEIGHT_M - self.position[2]) - 0.9 * self.velocity[2]
        return min(max(HOVER_THRUST - 0.075 * climb, 0.1), 0.6)

    def hold(self, yaw: float = 0.0) -> None:
        """Stay over the place of the take-off, `yaw` from the heading then."""
        if self.yaw0 is None:
            self.yaw0 = self.yaw
        ax = -0.5 * self.position[0] - 0.8 * self.velocity[0]
        ay = -0.5 * self.position[1] - 0.8 * self.velocity[1]
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        forward, right = c * ax + s * ay, c * ay - s * ax
        pitch, roll = min(max(-forward / 9.81, -0.2), 0.2), min(max(right / 9.81, -0.2), 0.2)
        self.attitude(roll, pitch, self.yaw0 + yaw, self.thrust_for_height())

    def tilt(self, roll: float, pitch: float, thrust: float | None = None, mask: int = ATTITUDE_ONLY) -> None:
        assert self.yaw0 is not None
        self.attitude(roll, pitch, self.yaw0, HOVER_THRUST if thrust is None else thrust, mask)

    def rates(self, p: float, q: float, r: float) -> None:
        self.connection.mav.set_attitude_target_send(
            int(self.time_s * 1e3), 1, 1, RATES_ONLY, [1, 0, 0, 0], p, q, r, HOVER_THRUST
        )

    def lemniscate(self, start_s: float) -> None:
        t = self.time_s - start_s
        a, b = (2 * math.pi / period for period in LEMNISCATE_PERIODS_S)
        sx, sy = LEMNISCATE_SIZE_M
        # the capture's starts at the middle with speed along x, and its y goes from 0 to 2 m and back
        x, vx, ax = sx * math.sin(a * t), sx * a * math.cos(a * t), -sx * a * a * math.sin(a * t)
        y, vy, ay = sy * (1 - math.cos(b * t)), sy * b * math.sin(b * t), sy * b * b * math.cos(b * t)
        self.connection.mav.set_position_target_local_ned_send(
            int(self.time_s * 1e3), 1, 1, 1, 2048, x, y, -HEIGHT_M, vx, vy, 0, ax, ay, 0, self.yaw0 or 0.0, 0
        )

    # --- when --------------------------------------------------------------------------------------------------
    def _timeline(self) -> list[tuple[float, Callable[[], None]]]:
        hold, script = self.hold, []

        def at(time_s: float, action: Callable[[], None]) -> None:
            script.append((time_s, action))

        def phase(time_s: float, text: str, action: Callable[[], None]) -> None:
            at(time_s, lambda: self.mark(text))
            at(time_s, action)

        def stream(action: Callable[[], None] | None) -> Callable[[], None]:
            return lambda: setattr(self, "streaming", action)

        phase(
            5.70,
            "connected",
            lambda: self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
        )
        at(6.19, lambda: self.command(mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1))
        at(7.00, lambda: self.connection.mav.param_request_read_send(1, 1, b"NO_SUCH_PARAM", -1))
        phase(7.50, "param list", lambda: self.connection.mav.param_request_list_send(1, 1))
        for index, (message_id, interval) in enumerate(INTERVALS.items()):
            at(
                8.17 + 0.05 * index,
                lambda m=message_id, i=interval: self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, m, i),
            )
        at(9.91, lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, GUIDED))
        at(10.91, lambda: self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1))
        at(11.91, lambda: self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0))
        at(12.41, lambda: self.command(31999, 1))
        for time_s, (name, value) in PARAMETERS.items():
            at(time_s, lambda n=name, v=value: self.connection.mav.param_set_send(1, 1, n, v, 9))
        phase(46.12, "guided", lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, GUIDED))
        phase(46.62, "arm", lambda: self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1))
        phase(47.62, "takeoff by attitude+thrust", stream(hold))
        for time_s, name, roll, pitch in (
            (57.62, "roll +0.2", 0.2, 0.0),
            (63.42, "roll -0.2", -0.2, 0.0),
            (69.22, "pitch +0.2", 0.0, 0.2),
            (75.02, "pitch -0.2", 0.0, -0.2),
        ):
            phase(time_s, f"step {name}", stream(lambda r=roll, p=pitch: self.tilt(r, p)))
            phase(time_s + 0.8, "back", stream(hold))
        phase(80.82, "step yaw +0.8", stream(lambda: hold(STEP_YAW_RAD)))
        phase(84.82, "step yaw -0.8", stream(hold))
        for time_s, name, axis in ((88.82, "roll", 0), (94.63, "pitch", 1), (100.44, "yaw", 2)):
            rate = [0.6 if index == axis else 0.0 for index in range(3)]
            phase(time_s, f"step {name} rate 0.6", stream(lambda r=rate: self.rates(*r)))
            at(time_s + 0.4, stream(lambda r=rate: self.rates(*(-v for v in r))))
            phase(time_s + 0.81, "back", stream(hold))
        for time_s, name, change in ((106.25, "+0.1", 0.1), (111.85, "-0.1", -0.1)):
            phase(time_s, f"step thrust {name}", stream(lambda c=change: self.tilt(0, 0, HOVER_THRUST + c)))
            phase(time_s + 0.6, "back", stream(hold))
        phase(117.45, "mask 64 throttle ignored, short", stream(lambda: self.tilt(0, 0, 0.0, NO_THROTTLE)))
        at(117.61, stream(hold))
        phase(121.61, "position+velocity+acceleration lemniscat", stream(lambda: self.lemniscate(121.61)))
        at(145.61, stream(hold))
        phase(150.61, "setpoints stop", stream(None))
        phase(155.11, "regain", stream(hold))
        phase(
            161.11,
            "pilot takeover: position hold mode",
            lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, LOITER),
        )
        phase(163.11, "regain", lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, GUIDED))
        phase(167.11, "land", lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, LAND))
        at(167.11, stream(None))
        return script


def fly_scenario(endpoint: str, until_s: float = 1e9, alive: Callable[[], bool] = lambda: True) -> Session:
    """Fly the session against `endpoint` (pymavlink's spelling) as system 255, component 191, like the capture."""
    connection = mavutil.mavlink_connection(endpoint, source_system=255, source_component=191)
    try:
        return ArduPilotPilot(connection, until_s).run(alive)
    finally:
        connection.close()
