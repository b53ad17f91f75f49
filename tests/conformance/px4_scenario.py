"""The scripted session of the PX4 capture, flown again: same phases at the same autopilot times, against any endpoint.

Every message of both directions is kept with the autopilot's time at which the client had it or sent it, as
`(time_s, outgoing, message)`; `step_response.py` and the tests read that list. The client answers TIMESYNC requests after
everything before them has been handled, so a stub in lockstep is flown repeatably.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

os.environ.setdefault("MAVLINK20", "1")
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

HOVER_THRUST = 0.5
HEIGHT_M = 2.0
INTERVALS = {
    30: 10000,
    31: 10000,
    32: 20000,
    83: 20000,
    105: 10000,
    331: 20000,
    147: 1000000,
    245: 500000,
    1: 500000,
}
INTERVALS |= {242: 1000000, 33: 200000, 230: 500000, 36: 50000, 9999: 100000}
ATTITUDE_ONLY, RATES_ONLY, NO_THROTTLE = 7, 128, 71
OFFBOARD, POSCTL, AUTO_LOITER, AUTO_LAND = (6,), (3,), (4, 3), (4, 6)
"""Main and sub mode of DO_SET_MODE."""


@dataclass
class Session:
    """What went over the wire."""

    messages: list[tuple[float, bool, Any]] = field(default_factory=list)

    def all(self, name: str, outgoing: bool = False) -> list[tuple[float, Any]]:
        """Messages of one name with their times."""
        return [(t, m) for t, out, m in self.messages if out == outgoing and m.get_type() == name]

    def phase_time(self, text: str) -> float:
        """When a phase was announced."""
        return next(t for t, m in self.all("STATUSTEXT", outgoing=True) if m.text == f"scenario: {text}")


class ScenarioPilot:
    """Flies the session on a mavutil connection; `phases` up to a time can be chosen with `until_s`."""

    def __init__(self, connection: Any, until_s: float = 1e9) -> None:
        self.connection = connection
        self.until_s = until_s
        self.session = Session()
        self.time_s = 0.0
        self.position = (0.0, 0.0, 0.0)
        self.velocity = (0.0, 0.0, 0.0)
        self.yaw = 0.0
        self.streaming: Callable[[], None] | None = None
        self.done = False
        self._script = sorted(self._timeline(), key=lambda item: item[0])
        self._armed_seen = False
        connection.mav.set_send_callback(self._keep_sent)

    def _keep_sent(self, message: Any, *arguments: Any, **named: Any) -> None:
        self.session.messages.append((self.time_s, True, message))

    def run(self, alive: Callable[[], bool] = lambda: True) -> Session:
        """Fly until the end of the script and disarmed, or the endpoint is gone."""
        while not self.done and alive():
            message = self.connection.recv_msg()
            if message is None:
                self.connection.select(0.2)
                continue
            if message.get_type() == "BAD_DATA":
                continue
            self.session.messages.append((self.time_s, False, message))
            self._take(message)
        return self.session

    def _take(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "TIMESYNC" and message.tc1 == 0:
            self.connection.mav.timesync_send(message.ts1 + 1, message.ts1)
        elif kind == "LOCAL_POSITION_NED":
            self.position = (message.x, message.y, message.z)
            self.velocity = (message.vx, message.vy, message.vz)
        elif kind == "HEARTBEAT" and message.autopilot == mavlink.MAV_AUTOPILOT_PX4:
            armed = bool(message.base_mode & 128)
            self._armed_seen |= armed
            if self._armed_seen and not armed:
                self.done = True
        elif kind == "ATTITUDE":
            self.time_s = message.time_boot_ms * 1e-3
            self.yaw = message.yaw
            while self._script and self._script[0][0] <= self.time_s:
                self._script.pop(0)[1]()
            if self.streaming is not None:
                self.streaming()
            if self.time_s > self.until_s:
                self.done = True

    # --- what is sent ------------------------------------------------------------------------------------------
    def mark(self, text: str) -> None:
        self.connection.mav.statustext_send(6, f"scenario: {text}".encode())

    def command(self, number: int, *params: float) -> None:
        filled = [*params, *([0.0] * (7 - len(params)))]
        self.connection.mav.command_long_send(1, 1, number, 0, *filled)

    def attitude(
        self, roll: float, pitch: float, yaw: float, thrust: float, mask: int = ATTITUDE_ONLY
    ) -> None:
        q = list(_quaternion(roll, pitch, yaw))
        self.connection.mav.set_attitude_target_send(int(self.time_s * 1e3), 1, 1, mask, q, 0, 0, 0, thrust)

    def rates(self, p: float, q: float, r: float) -> None:
        self.connection.mav.set_attitude_target_send(
            int(self.time_s * 1e3), 1, 1, RATES_ONLY, [1, 0, 0, 0], p, q, r, self.thrust_for_height()
        )

    def thrust_for_height(self) -> float:
        climb = 0.6 * (-HEIGHT_M - self.position[2]) - 0.9 * self.velocity[2]
        return min(max(HOVER_THRUST - 0.1 * climb, 0.0), 0.9)

    def hold(self, yaw: float = 0.0) -> None:
        """Stay over the origin with attitude setpoints."""
        ax = -0.5 * self.position[0] - 0.8 * self.velocity[0]
        ay = -0.5 * self.position[1] - 0.8 * self.velocity[1]
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        forward, right = c * ax + s * ay, c * ay - s * ax
        pitch, roll = min(max(-forward / 9.81, -0.2), 0.2), min(max(right / 9.81, -0.2), 0.2)
        self.attitude(roll, pitch, yaw, self.thrust_for_height())

    def lemniscate(self, start_s: float) -> None:
        """Position, velocity and acceleration of the report's lemniscate (periods 4 s and 8 s)."""
        t = self.time_s - start_s
        a, b = 2 * math.pi / 4, 2 * math.pi / 8
        x, vx, ax = 0.5 * math.sin(a * t), 0.5 * a * math.cos(a * t), -0.5 * a * a * math.sin(a * t)
        y, vy, ay = math.cos(b * t), -b * math.sin(b * t), -b * b * math.cos(b * t)
        self.connection.mav.set_position_target_local_ned_send(
            int(self.time_s * 1e3), 1, 1, 1, 2048, x, y, -HEIGHT_M, vx, vy, 0, ax, ay, 0, 0, 0
        )

    # --- when --------------------------------------------------------------------------------------------------
    def _timeline(self) -> list[tuple[float, Callable[[], None]]]:
        """(autopilot time, action), the times of the capture."""
        hold, script = self.hold, []

        def at(time_s: float, action: Callable[[], None]) -> None:
            script.append((time_s, action))

        def stream(action: Callable[[], None] | None) -> Callable[[], None]:
            return lambda: setattr(self, "streaming", action)

        def announce(text: str) -> Callable[[], None]:
            return lambda: self.mark(text)

        at(1.59, announce("connected"))
        at(
            1.60,
            lambda: self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
        )
        at(2.08, lambda: self.command(mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1))
        at(2.90, lambda: self.connection.mav.param_request_read_send(1, 1, b"NO_SUCH_PARAM", -1))
        at(3.40, announce("param list"))
        at(3.41, lambda: self.connection.mav.param_request_list_send(1, 1))
        for index, (message_id, interval) in enumerate(INTERVALS.items()):
            at(
                4.20 + 0.06 * index,
                lambda m=message_id, i=interval: self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, m, i),
            )
        at(6.06, announce("mode and arm before ready or without set"))
        at(6.06, lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, *OFFBOARD))
        at(7.06, lambda: self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1))
        at(8.06, lambda: self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0))
        at(8.56, lambda: self.command(31999, 1))
        at(9.06, lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, *AUTO_LOITER))
        at(10.07, announce("prearm ok"))
        at(13.07, announce("stream idle setpoints"))
        at(13.07, stream(lambda: self.attitude(0, 0, 0, 0.0)))
        at(14.27, announce("offboard"))
        at(14.27, lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, *OFFBOARD))
        at(14.87, announce("arm"))
        at(14.87, lambda: self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1))
        at(16.37, announce("takeoff by attitude+thrust"))
        at(16.37, stream(hold))

        def angle_step(time_s: float, name: str, roll: float, pitch: float) -> None:
            at(time_s, announce(f"step {name}"))
            at(time_s, stream(lambda: self.attitude(roll, pitch, 0, self.thrust_for_height())))
            at(time_s + 0.8, announce("back"))
            at(time_s + 0.8, stream(hold))

        angle_step(26.37, "roll +0.2", 0.2, 0)
        angle_step(32.17, "roll -0.2", -0.2, 0)
        angle_step(37.98, "pitch +0.2", 0, 0.2)
        angle_step(43.78, "pitch -0.2", 0, -0.2)
        at(49.60, announce("step yaw +0.8"))
        at(49.60, stream(lambda: hold(0.804)))
        at(53.60, announce("step yaw -0.8"))
        at(53.60, stream(lambda: hold(0.004)))
        for time_s, name, axis in ((57.75, "roll", 0), (63.43, "pitch", 1), (69.23, "yaw", 2)):
            rate = [0.6 if index == axis else 0.0 for index in range(3)]
            at(time_s, announce(f"step {name} rate 0.6"))
            at(time_s, stream(lambda r=rate: self.rates(*r)))
            at(time_s + 0.4, stream(lambda r=rate: self.rates(*(-v for v in r))))
            at(time_s + 0.8, announce("back"))
            at(time_s + 0.8, stream(hold))
        at(75.04, announce("step thrust +0.1"))
        at(75.04, stream(lambda: self.attitude(0, 0, 0, HOVER_THRUST + 0.1)))
        at(75.64, announce("back"))
        at(75.64, stream(hold))
        at(80.64, announce("step thrust -0.1"))
        at(80.64, stream(lambda: self.attitude(0, 0, 0, HOVER_THRUST - 0.1)))
        at(81.25, announce("back"))
        at(81.25, stream(hold))
        at(86.25, announce("mask 64 throttle ignored, short"))
        at(86.25, stream(lambda: self.attitude(0, 0, 0, HOVER_THRUST, NO_THROTTLE)))
        at(86.41, stream(hold))
        at(90.41, announce("position+velocity+acceleration lemniscat"))
        at(90.41, stream(lambda: self.lemniscate(90.41)))
        at(114.4, stream(hold))
        at(119.41, announce("setpoints stop"))
        at(119.41, stream(None))
        at(122.41, announce("regain"))
        at(122.41, stream(hold))
        at(122.92, lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, *OFFBOARD))
        at(128.92, announce("pilot takeover: position hold mode"))
        at(128.92, lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, *POSCTL))
        at(130.92, announce("regain"))
        at(130.92, lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, *OFFBOARD))
        at(134.92, announce("land"))
        at(134.92, lambda: self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, *AUTO_LAND))
        at(134.92, stream(None))
        return script


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def fly_scenario(endpoint: str, until_s: float = 1e9, alive: Callable[[], bool] = lambda: True) -> Session:
    """Fly the session against `endpoint` (pymavlink's spelling) as system 1, component 191, like the capture."""
    connection = mavutil.mavlink_connection(endpoint, source_system=1, source_component=191)
    try:
        return ScenarioPilot(connection, until_s).run(alive)
    finally:
        connection.close()
