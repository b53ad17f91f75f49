"""The protocol side of ArduCopter: which commands and messages it takes, and what it answers.

Targets (SET_ATTITUDE_TARGET, SET_POSITION_TARGET_...) are never acknowledged, and dropped silently outside GUIDED.
"""

from __future__ import annotations

import math

import numpy as np

from sitl_stub.firmware.ardupilot.commander import Commander
from sitl_stub.firmware.ardupilot.guided import IGNORE_POSITION, IGNORE_YAW, Guided
from sitl_stub.firmware.ardupilot.messages import STREAM_GROUPS
from sitl_stub.firmware.ardupilot.modes import Mode
from sitl_stub.firmware.ardupilot.state import ArduPilotState
from sitl_stub.firmware.ardupilot.voice import ArduPilotVoice
from sitl_stub.firmware.common.commands import (
    Command,
    CommandHandler,
    CommandProtocol,
    MessageHandler,
    Result,
    is_place,
    whole,
)
from sitl_stub.firmware.common.mavlink_ids import MavCommand, ModeFlag, Severity
from sitl_stub.firmware.common.plans import PlanProtocol
from sitl_stub.firmware.common.streams import StreamTable
from sitl_stub.mavlink.codec import LAYOUTS, Received
from sitl_stub.mavlink.links import Link

SET_MODE_ID = LAYOUTS["SET_MODE"].message_id
FORCE_ARM, FORCE_DISARM = 2989.0, 21196.0
SHORTEST_INTERVAL_MS = 3
"""80 % of SCHED_LOOP_RATE 400 in whole milliseconds: 333 Hz is granted, 400 Hz is not."""
LONGEST_INTERVAL_US = 60_000_000
PWM_MIDDLE, PWM_HALF, PWM_LEAST, PWM_RANGE = 1500.0, 500.0, 1000.0, 1000.0
FASTEST_M_S = 100.0
ABOVE_HOME_FRAMES = (3, 6, 10, 11)
"""MAV_FRAME_GLOBAL_RELATIVE_ALT, ..._RELATIVE_ALT_INT, GLOBAL_TERRAIN_ALT, ..._TERRAIN_ALT_INT."""


class ArduPilotProtocol:
    """Handlers of one vehicle."""

    def __init__(
        self,
        state: ArduPilotState,
        voice: ArduPilotVoice,
        guided: Guided,
        commander: Commander,
        streams: StreamTable,
        command_protocol: CommandProtocol,
        plan_protocol: PlanProtocol,
    ) -> None:
        self.state = state
        self.voice = voice
        self.guided = guided
        self.commander = commander
        self.streams = streams
        self.command_protocol = command_protocol
        self.plan_protocol = plan_protocol

    def commands(self) -> dict[int, CommandHandler]:
        """MAV_CMD number to handler."""
        return {
            MavCommand.NAV_LOITER_UNLIM: lambda link, command: self._to_mode(Mode.LOITER),
            MavCommand.NAV_RETURN_TO_LAUNCH: lambda link, command: self._to_mode(Mode.RTL),
            MavCommand.NAV_LAND: lambda link, command: self._to_mode(Mode.LAND),
            MavCommand.NAV_TAKEOFF: self._take_off,
            MavCommand.CONDITION_YAW: self._condition_yaw,
            MavCommand.DO_SET_MODE: self._do_set_mode,
            MavCommand.DO_CHANGE_SPEED: self._change_speed,
            MavCommand.DO_SET_HOME: self._set_home,
            MavCommand.DO_REPOSITION: self._reposition,
            MavCommand.DO_SET_MISSION_CURRENT: self._choose_item,
            MavCommand.PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            MavCommand.COMPONENT_ARM_DISARM: self._arm,
            MavCommand.GET_HOME_POSITION: self._get_home,
            MavCommand.GET_MESSAGE_INTERVAL: self._get_message_interval,
            MavCommand.SET_MESSAGE_INTERVAL: self._set_message_interval,
            MavCommand.REQUEST_MESSAGE: self.command_protocol.request_message,
            MavCommand.REQUEST_AUTOPILOT_CAPABILITIES: self._request_capabilities,
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
        }

    # --- commands ----------------------------------------------------------------------------------------------
    def _to_mode(self, mode: Mode) -> Result:
        return Result.ACCEPTED if self.commander.request_mode(mode.custom_mode) else Result.FAILED

    def _do_set_mode(self, link: Link, command: Command) -> Result | None:
        return self._custom_mode(max(whole(command.params[0]), 0), whole(command.params[1]))

    def _custom_mode(self, base_mode: int, number: int) -> Result:
        if not base_mode & ModeFlag.CUSTOM_MODE_ENABLED:
            return Result.DENIED
        return Result.ACCEPTED if self.commander.request_mode(number) else Result.FAILED

    def _set_mode(self, link: Link, message: Received) -> None:
        v = message.values
        result = self._custom_mode(v["base_mode"], v["custom_mode"])
        # ArduPilot acknowledges the message SET_MODE as if its id were a command
        link.send("COMMAND_ACK", command=SET_MODE_ID, result=int(result))

    def _arm(self, link: Link, command: Command) -> Result | None:
        wanted, magic = command.params[:2]
        if wanted == 1.0:
            return self.commander.request_arm(magic in (FORCE_ARM, FORCE_DISARM))
        if wanted == 0.0:
            return self.commander.request_disarm(magic == FORCE_DISARM)
        return Result.UNSUPPORTED

    def _take_off(self, link: Link, command: Command) -> Result | None:
        granted = self.commander.request_take_off(command.params[6])
        return Result.ACCEPTED if granted else Result.FAILED

    def _condition_yaw(self, link: Link, command: Command) -> Result | None:
        a = self.state
        angle, _, direction, relative = command.params[:4]
        if not 0.0 <= angle <= 360.0 or relative not in (0.0, 1.0):
            return Result.FAILED
        if a.mode is Mode.GUIDED:
            turn = math.radians(angle)
            self.guided.turn_to(a.core.yaw + math.copysign(turn, direction) if relative else turn)
        return Result.ACCEPTED

    def _change_speed(self, link: Link, command: Command) -> Result | None:
        kind, speed = command.params[:2]
        names = {0: "WPNAV_SPEED", 1: "WPNAV_SPEED", 2: "WPNAV_SPEED_UP", 3: "WPNAV_SPEED_DN"}
        if not 0.0 < speed < FASTEST_M_S or whole(kind) not in names:
            return Result.FAILED
        self.state.parameters.set(names[whole(kind)], 100.0 * speed)
        return Result.ACCEPTED

    def _set_home(self, link: Link, command: Command) -> Result | None:
        a = self.state
        if not a.home_known:
            return Result.FAILED
        if command.params[0] == 1.0:
            self.commander.set_home(a.core.position_ned)
        else:
            if not is_place(*command.params[4:7]):
                return Result.DENIED
            north, east = a.origin.local(command.params[4], command.params[5])
            down = a.origin.altitude_of(command.params[6])
            self.commander.set_home(np.array((north, east, down)))
        for other in self.voice.links:
            self.streams.send_named(other, "HOME_POSITION")
        return Result.ACCEPTED

    def _reposition(self, link: Link, command: Command) -> Result | None:
        a = self.state
        latitude, longitude, altitude = command.params[4:7]
        if not is_place(latitude, longitude, altitude):
            return Result.DENIED
        if a.mode is not Mode.GUIDED:
            if not max(whole(command.params[1]), 0) & 1:
                return Result.DENIED
            if not self.commander.request_mode(Mode.GUIDED.custom_mode):
                return Result.FAILED
        north, east = a.origin.local(latitude, longitude)
        height = altitude - float(a.home_ned[2])
        self.guided.go_to((north, east, height))
        return Result.ACCEPTED

    def _choose_item(self, link: Link, command: Command) -> Result | None:
        return Result.ACCEPTED if self.plan_protocol.choose(whole(command.params[0])) else Result.FAILED

    def _reboot(self, link: Link, command: Command) -> Result | None:
        return Result.FAILED if self.state.armed else Result.ACCEPTED

    def _get_home(self, link: Link, command: Command) -> Result | None:
        a = self.state
        if not a.home_known:
            return Result.FAILED
        self.streams.send_named(link, "HOME_POSITION", "GPS_GLOBAL_ORIGIN")
        return Result.ACCEPTED

    def _request_capabilities(self, link: Link, command: Command) -> Result | None:
        if command.params[0] != 1.0:
            return Result.FAILED
        self.streams.send_named(link, "AUTOPILOT_VERSION")
        return Result.ACCEPTED

    # --- streams -----------------------------------------------------------------------------------------------
    def _set_message_interval(self, link: Link, command: Command) -> Result | None:
        a = self.state
        number, interval_us = whole(command.params[0]) & 0xFFFFFFFF, command.params[1]
        if number not in self.streams.definitions:
            self.voice.say_to(link, Severity.INFO, f"No ap_message for mavlink id ({number})")
            return Result.DENIED
        interval_us = float(math.trunc(interval_us)) if math.isfinite(interval_us) else -2.0
        if interval_us < -1.0:
            return Result.DENIED
        if interval_us > 0.0:
            whole_ms = max(int(min(interval_us, LONGEST_INTERVAL_US)) // 1000, 1)
            if whole_ms < SHORTEST_INTERVAL_MS:
                text = f"Requested rate for message ID {number} too fast. Increase SCHED_LOOP_RATE"
                self.voice.say_to(link, Severity.INFO, text)
                return Result.DENIED
            interval_us = whole_ms * 1000.0
        self.streams.set_interval(link, number, interval_us, a.clock.time_us)
        return Result.ACCEPTED

    def _get_message_interval(self, link: Link, command: Command) -> Result | None:
        number = whole(command.params[0])
        stream = self.streams.of(link).streams.get(number)
        interval = 0
        if stream is not None:
            interval = round(stream.interval_us) if stream.interval_us > 0 else -1
        link.send("MESSAGE_INTERVAL", message_id=number & 0xFFFF, interval_us=interval)
        return Result.FAILED if stream is None else Result.ACCEPTED

    def _request_data_stream(self, link: Link, message: Received) -> None:
        a = self.state
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
                self.streams.set_interval(link, number, interval_us, a.clock.time_us)

    # --- targets and sticks ------------------------------------------------------------------------------------
    def _attitude_target(self, link: Link, message: Received) -> None:
        if self.state.mode.value.takes_targets:
            self.guided.take_attitude(message)

    def _position_target(self, link: Link, message: Received) -> None:
        if self.state.mode is Mode.GUIDED:
            self.guided.take_position(message)

    def _global_target(self, link: Link, message: Received) -> None:
        a = self.state
        v = message.values
        if a.mode is not Mode.GUIDED or v["type_mask"] & IGNORE_POSITION:
            return
        north, east = a.origin.local(v["lat_int"] * 1e-7, v["lon_int"] * 1e-7)
        above_home = v["coordinate_frame"] in ABOVE_HOME_FRAMES
        height = float(v["alt"]) - (float(a.home_ned[2]) if above_home else a.origin.altitude_m)
        heading = None if v["type_mask"] & IGNORE_YAW else float(v["yaw"])
        known = is_place(v["lat_int"] * 1e-7, v["lon_int"] * 1e-7, float(v["alt"]))
        if known and (heading is None or math.isfinite(heading)):
            self.guided.go_to((north, east, height), heading)

    def _from_ground_station(self, message: Received) -> bool:
        return message.system == int(self.state.parameters["MAV_GCS_SYSID"])

    def _manual_control(self, link: Link, message: Received) -> None:
        if not self._from_ground_station(message):
            return
        self.state.sticks.take_manual_control(message.values)

    def _rc_override(self, link: Link, message: Received) -> None:
        if not self._from_ground_station(message):
            return
        sticks = self.state.sticks
        for channel, name in ((1, "roll"), (2, "pitch"), (3, "throttle"), (4, "yaw")):
            pwm = message.values[f"chan{channel}_raw"]
            if pwm == 65535:
                continue  # left as it is
            if name == "throttle":
                value = (pwm - PWM_LEAST) / PWM_RANGE if pwm else 0.0
                sticks.throttle = min(max(value, 0.0), 1.0)
            else:
                value = (pwm - PWM_MIDDLE) / PWM_HALF if pwm else 0.0
                value = -value if name == "pitch" else value  # nose up positive on channel 2
                setattr(sticks, name, min(max(value, -1.0), 1.0))
