"""The protocol side of ArduCopter: which commands and messages it takes, and what it answers.

Targets (SET_ATTITUDE_TARGET, SET_POSITION_TARGET_...) are never acknowledged, and dropped silently outside GUIDED.
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING

from sitl_stub.firmware.ardupilot.messages import STREAM_GROUPS
from sitl_stub.firmware.ardupilot.modes import Mode
from sitl_stub.firmware.common.commands import (
    Command,
    CommandHandler,
    MessageHandler,
    Result,
    is_place,
    whole,
)
from sitl_stub.firmware.common.parameters import ParameterError
from sitl_stub.mavlink.codec import LAYOUTS, Received
from sitl_stub.mavlink.links import Link

if TYPE_CHECKING:
    from sitl_stub.firmware.ardupilot.autopilot import ArduPilot

FORCE_ARM, FORCE_DISARM = 2989.0, 21196.0
NO_INDEX = 65535
SHORTEST_INTERVAL_MS = 3
"""80 % of SCHED_LOOP_RATE 400 in whole milliseconds: 333 Hz is granted, 400 Hz is not."""
LONGEST_INTERVAL_US = 60_000_000
FULL_STICK = 1000.0
PWM_MIDDLE, PWM_HALF, PWM_LEAST, PWM_RANGE = 1500.0, 500.0, 1000.0, 1000.0
INFO = 6
FASTEST_M_S = 100.0


class ArduPilotCommands:
    """Handlers of one vehicle."""

    def __init__(self, autopilot: ArduPilot) -> None:
        self.autopilot = autopilot

    def commands(self) -> dict[int, CommandHandler]:
        """MAV_CMD number to handler."""
        return {
            17: lambda link, command: self._to_mode(Mode.LOITER),
            20: lambda link, command: self._to_mode(Mode.RTL),
            21: lambda link, command: self._to_mode(Mode.LAND),
            22: self._take_off,
            115: self._condition_yaw,
            176: self._do_set_mode,
            178: self._change_speed,
            179: self._set_home,
            192: self._reposition,
            246: self._reboot,
            400: self._arm,
            410: self._get_home,
            510: self._get_message_interval,
            511: self._set_message_interval,
            520: self._request_capabilities,
        }

    def messages(self) -> dict[str, MessageHandler]:
        """Message name to handler."""
        return {
            "SET_ATTITUDE_TARGET": self._attitude_target,
            "SET_POSITION_TARGET_LOCAL_NED": self._position_target,
            "SET_POSITION_TARGET_GLOBAL_INT": self._global_target,
            "SET_MODE": self._set_mode,
            "MANUAL_CONTROL": self._manual_control,
            "RC_CHANNELS_OVERRIDE": self._rc_override,
            "REQUEST_DATA_STREAM": self._request_data_stream,
            "PARAM_REQUEST_LIST": self._param_request_list,
            "PARAM_REQUEST_READ": self._param_request_read,
            "PARAM_SET": self._param_set,
        }

    # --- commands ----------------------------------------------------------------------------------------------
    def _to_mode(self, mode: Mode) -> Result:
        return Result.ACCEPTED if self.autopilot.request_mode(mode.number) else Result.FAILED

    def _do_set_mode(self, link: Link, command: Command) -> Result | None:
        return self._custom_mode(max(whole(command.params[0]), 0), whole(command.params[1]))

    def _custom_mode(self, base_mode: int, number: int) -> Result:
        if not base_mode & 1:
            return Result.DENIED
        return Result.ACCEPTED if self.autopilot.request_mode(number) else Result.FAILED

    def _set_mode(self, link: Link, message: Received) -> None:
        v = message.values
        result = self._custom_mode(v["base_mode"], v["custom_mode"])
        # ArduPilot acknowledges the message SET_MODE as if it were command 11
        link.send("COMMAND_ACK", command=11, result=int(result))

    def _arm(self, link: Link, command: Command) -> Result | None:
        wanted, magic = command.params[:2]
        if wanted == 1.0:
            return self.autopilot.request_arm(magic in (FORCE_ARM, FORCE_DISARM))
        if wanted == 0.0:
            return self.autopilot.request_disarm(magic == FORCE_DISARM)
        return Result.UNSUPPORTED

    def _take_off(self, link: Link, command: Command) -> Result | None:
        granted = self.autopilot.request_take_off(command.params[6])
        return Result.ACCEPTED if granted else Result.FAILED

    def _condition_yaw(self, link: Link, command: Command) -> Result | None:
        a = self.autopilot
        angle, _, direction, relative = command.params[:4]
        if not 0.0 <= angle <= 360.0 or relative not in (0.0, 1.0):
            return Result.FAILED
        if a.mode is Mode.GUIDED:
            turn = math.radians(angle)
            a.guided.turn_to(a.core.yaw + math.copysign(turn, direction) if relative else turn)
        return Result.ACCEPTED

    def _change_speed(self, link: Link, command: Command) -> Result | None:
        kind, speed = command.params[:2]
        names = {0: "WPNAV_SPEED", 1: "WPNAV_SPEED", 2: "WPNAV_SPEED_UP", 3: "WPNAV_SPEED_DN"}
        if not 0.0 < speed < FASTEST_M_S or whole(kind) not in names:
            return Result.FAILED
        self.autopilot.parameters.set(names[whole(kind)], 100.0 * speed)
        return Result.ACCEPTED

    def _set_home(self, link: Link, command: Command) -> Result | None:
        a = self.autopilot
        if not a.home_known:
            return Result.FAILED
        if command.params[0] == 1.0:
            a.home_ned = a.core.position_ned.copy()
        else:
            if not is_place(*command.params[4:7]):
                return Result.DENIED
            north, east = a.say_messages.origin.local(command.params[4], command.params[5])
            a.home_ned[:] = (north, east, a.say_messages.origin.altitude_m - command.params[6])
        for other in a.links:
            a.streams.build(other, 242)
        return Result.ACCEPTED

    def _reposition(self, link: Link, command: Command) -> Result | None:
        a = self.autopilot
        latitude, longitude, altitude = command.params[4:7]
        if not is_place(latitude, longitude, altitude):
            return Result.DENIED
        if a.mode is not Mode.GUIDED:
            if not max(whole(command.params[1]), 0) & 1:
                return Result.DENIED
            if not a.request_mode(Mode.GUIDED.number):
                return Result.FAILED
        north, east = a.say_messages.origin.local(latitude, longitude)
        height = altitude - float(a.home_ned[2])
        a.guided.go_to((north, east, height))
        return Result.ACCEPTED

    def _reboot(self, link: Link, command: Command) -> Result | None:
        return Result.FAILED if self.autopilot.armed else Result.ACCEPTED

    def _get_home(self, link: Link, command: Command) -> Result | None:
        a = self.autopilot
        if not a.home_known:
            return Result.FAILED
        a.streams.build(link, 242)
        a.streams.build(link, 49)
        return Result.ACCEPTED

    def _request_capabilities(self, link: Link, command: Command) -> Result | None:
        if command.params[0] != 1.0:
            return Result.FAILED
        self.autopilot.streams.build(link, 148)
        return Result.ACCEPTED

    # --- streams -----------------------------------------------------------------------------------------------
    def _set_message_interval(self, link: Link, command: Command) -> Result | None:
        a = self.autopilot
        number, interval_us = whole(command.params[0]) & 0xFFFFFFFF, command.params[1]
        if number not in a.streams.definitions:
            a.say_to(link, INFO, f"No ap_message for mavlink id ({number})")
            return Result.DENIED
        interval_us = float(math.trunc(interval_us)) if math.isfinite(interval_us) else -2.0
        if interval_us < -1.0:
            return Result.DENIED
        if interval_us > 0.0:
            whole_ms = max(int(min(interval_us, LONGEST_INTERVAL_US)) // 1000, 1)
            if whole_ms < SHORTEST_INTERVAL_MS:
                text = f"Requested rate for message ID {number} too fast. Increase SCHED_LOOP_RATE"
                a.say_to(link, INFO, text)
                return Result.DENIED
            interval_us = whole_ms * 1000.0
        a.streams.set_interval(link, number, interval_us, a.time_us)
        return Result.ACCEPTED

    def _get_message_interval(self, link: Link, command: Command) -> Result | None:
        a = self.autopilot
        number = whole(command.params[0])
        stream = a.streams.of(link).streams.get(number)
        interval = 0
        if stream is not None:
            interval = round(stream.interval_us) if stream.interval_us > 0 else -1
        link.send("MESSAGE_INTERVAL", message_id=number & 0xFFFF, interval_us=interval)
        return Result.FAILED if stream is None else Result.ACCEPTED

    def _request_data_stream(self, link: Link, message: Received) -> None:
        a = self.autopilot
        v = message.values
        wanted = v["req_stream_id"]
        groups = STREAM_GROUPS.values() if wanted == 0 else [STREAM_GROUPS.get(wanted, ())]
        rate = v["req_message_rate"] if v["start_stop"] else 0
        interval_us = -1.0
        if rate > 0:
            interval_us = 1000.0 * max(1000 // rate, SHORTEST_INTERVAL_MS)
        for names in groups:
            for name in names:
                number = LAYOUTS[name].message_id if name in LAYOUTS else -1
                a.streams.set_interval(link, number, interval_us, a.time_us)

    # --- targets and sticks ------------------------------------------------------------------------------------
    def _attitude_target(self, link: Link, message: Received) -> None:
        if self.autopilot.mode.value.takes_targets:
            self.autopilot.guided.take_attitude(message)

    def _position_target(self, link: Link, message: Received) -> None:
        if self.autopilot.mode is Mode.GUIDED:
            self.autopilot.guided.take_position(message)

    def _global_target(self, link: Link, message: Received) -> None:
        a = self.autopilot
        v = message.values
        if a.mode is not Mode.GUIDED or v["type_mask"] & 0b111:
            return
        north, east = a.say_messages.origin.local(v["lat_int"] * 1e-7, v["lon_int"] * 1e-7)
        above_home = v["coordinate_frame"] in (3, 6, 10, 11)
        height = float(v["alt"]) - (float(a.home_ned[2]) if above_home else a.say_messages.origin.altitude_m)
        heading = None if v["type_mask"] & (1 << 10) else float(v["yaw"])
        known = is_place(v["lat_int"] * 1e-7, v["lon_int"] * 1e-7, float(v["alt"]))
        if known and (heading is None or math.isfinite(heading)):
            a.guided.go_to((north, east, height), heading)

    def _from_ground_station(self, message: Received) -> bool:
        return message.system == int(self.autopilot.parameters["MAV_GCS_SYSID"])

    def _manual_control(self, link: Link, message: Received) -> None:
        v = message.values
        if not self._from_ground_station(message):
            return
        sticks = self.autopilot.flight.sticks
        sticks.pitch = -min(max(v["x"] / FULL_STICK, -1.0), 1.0)
        sticks.roll = min(max(v["y"] / FULL_STICK, -1.0), 1.0)
        sticks.throttle = min(max(v["z"] / FULL_STICK, 0.0), 1.0)
        sticks.yaw = min(max(v["r"] / FULL_STICK, -1.0), 1.0)

    def _rc_override(self, link: Link, message: Received) -> None:
        if not self._from_ground_station(message):
            return
        sticks = self.autopilot.flight.sticks
        for channel, name in ((1, "roll"), (2, "pitch"), (3, "throttle"), (4, "yaw")):
            pwm = message.values[f"chan{channel}_raw"]
            if pwm == 65535:
                continue  # left as it is
            if name == "throttle":
                value = (pwm - PWM_LEAST) / PWM_RANGE if pwm else 0.0
                sticks.throttle = min(max(value, 0.0), 1.0)
            else:
                value = (pwm - PWM_MIDDLE) / PWM_HALF if pwm else 0.0
                setattr(sticks, name, min(max(value, -1.0), 1.0))

    # --- parameters --------------------------------------------------------------------------------------------
    def _send(self, link: Link, name: str, index: int) -> None:
        p = self.autopilot.parameters
        number = struct.pack("<f", p[name])
        payload = number + struct.pack("<HH16sB", len(p), index, name.encode(), p.kind(name))
        link.send_payload(LAYOUTS["PARAM_VALUE"], payload)

    def _param_request_list(self, link: Link, message: Received) -> None:
        a = self.autopilot
        for text in (
            "ArduCopter V4.7.0-dev (2598e9d4)",
            "3d1219c7c4c5404aaa1f6d2a48adfda4",
            "Frame: QUAD/PLUS",
        ):
            a.say_to(link, INFO, text)
        link.firmware_data.parameters_waiting = list(range(len(a.parameters) - 1, -1, -1))

    def _param_request_read(self, link: Link, message: Received) -> None:
        """By name the answer carries no index; an unknown name or index gets no answer."""
        index = message.values["param_index"]
        p = self.autopilot.parameters
        name = message.values["param_id"] if index < 0 else p.name_at(index)
        if name is not None and name in p:
            self._send(link, name, NO_INDEX if index < 0 else index)

    def _param_set(self, link: Link, message: Received) -> None:
        """The value that was taken is told to everybody, without its index; an unknown name gets no answer."""
        a = self.autopilot
        name = message.values["param_id"]
        if name not in a.parameters:
            return
        try:
            a.parameters.set(name, float(message.values["param_value"]))
        except ParameterError as error:
            a.on_text(str(error))
            return
        self.announce_parameter(name)

    def announce_parameter(self, name: str) -> None:
        """PARAM_VALUE to everybody, without its index."""
        for link in self.autopilot.links:
            self._send(link, name, NO_INDEX)
