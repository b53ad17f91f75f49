"""The protocol side of PX4: which commands and messages it takes, and what it answers."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from sitl_stub.firmware.common.commands import (
    HIGHEST_M,
    Command,
    CommandHandler,
    CommandProtocol,
    MessageHandler,
    Result,
    is_place,
    whole,
)
from sitl_stub.firmware.common.mavlink_ids import MavCommand, ModeFlag
from sitl_stub.firmware.common.plans import PlanProtocol
from sitl_stub.firmware.common.streams import StreamTable
from sitl_stub.firmware.px4.commander import FORCE_MAGIC, Commander
from sitl_stub.firmware.px4.modes import Mode, mode_of, mode_of_custom
from sitl_stub.firmware.px4.navigator import Navigator
from sitl_stub.firmware.px4.offboard import OffboardControl
from sitl_stub.firmware.px4.state import Px4State
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link


class Px4Protocol:
    """Handlers of one vehicle."""

    def __init__(
        self,
        state: Px4State,
        navigator: Navigator,
        control: OffboardControl,
        commander: Commander,
        streams: StreamTable,
        command_protocol: CommandProtocol,
        plan_protocol: PlanProtocol,
    ) -> None:
        self.state = state
        self.navigator = navigator
        self.control = control
        self.commander = commander
        self.streams = streams
        self.command_protocol = command_protocol
        self.plan_protocol = plan_protocol

    def commands(self) -> Mapping[int, CommandHandler]:
        """MAV_CMD number to handler."""
        shared = self.command_protocol
        return {
            MavCommand.NAV_RETURN_TO_LAUNCH: lambda link, command: self._mode_command(Mode.RTL),
            MavCommand.NAV_LAND: lambda link, command: self._mode_command(Mode.LAND),
            MavCommand.NAV_TAKEOFF: self._takeoff,
            MavCommand.DO_SET_MODE: self._do_set_mode,
            MavCommand.DO_CHANGE_SPEED: self._change_speed,
            MavCommand.DO_SET_HOME: self._set_home,
            MavCommand.DO_REPOSITION: self._reposition,
            MavCommand.DO_ORBIT: self._orbit,
            MavCommand.DO_SET_MISSION_CURRENT: self._choose_item,
            MavCommand.MISSION_START: self._start_mission,
            MavCommand.PREFLIGHT_CALIBRATION: shared.ignore,
            MavCommand.PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            MavCommand.COMPONENT_ARM_DISARM: self._arm,
            MavCommand.GET_HOME_POSITION: shared.ignore,
            MavCommand.GET_MESSAGE_INTERVAL: shared.get_message_interval,
            MavCommand.SET_MESSAGE_INTERVAL: shared.set_message_interval,
            MavCommand.REQUEST_MESSAGE: shared.request_message,
            MavCommand.REQUEST_AUTOPILOT_CAPABILITIES: self._request_capabilities,
        }

    def messages(self) -> Mapping[str, MessageHandler]:
        """Message name to handler."""
        return {
            "SET_ATTITUDE_TARGET": self._set_attitude_target,
            "SET_POSITION_TARGET_LOCAL_NED": self._set_position_target,
            "SET_ACTUATOR_CONTROL_TARGET": self._set_actuator_control_target,
            "SET_MODE": self._set_mode,
            "MANUAL_CONTROL": self._manual_control,
        }

    # --- setpoints and sticks ----------------------------------------------------------------------------------
    def _set_attitude_target(self, link: Link, message: Received) -> None:
        if self.control.setpoint.take_attitude(message, self.state.clock.time_us):
            self.control.apply()

    def _set_position_target(self, link: Link, message: Received) -> None:
        if self.control.setpoint.take_position(message, self.state.core.yaw, self.state.clock.time_us):
            self.control.apply()

    def _set_actuator_control_target(self, link: Link, message: Received) -> None:
        if self.control.setpoint.take_actuators(message, self.state.clock.time_us):
            self.control.apply()

    def _manual_control(self, link: Link, message: Received) -> None:
        if self.state.accepts_joystick:
            self.state.sticks.take_manual_control(message.values)
            self.state.sticks.last_us = self.state.clock.time_us

    # --- commands ----------------------------------------------------------------------------------------------
    def _do_set_mode(self, link: Link, command: Command) -> Result | None:
        # Two acknowledgements, as in the capture: one for the command having arrived, one for its outcome.
        self.command_protocol.acknowledge(link, command, Result.ACCEPTED)
        if max(whole(command.params[0]), 0) & ModeFlag.CUSTOM_MODE_ENABLED:
            mode = mode_of(whole(command.params[1]), whole(command.params[2]))
        else:
            mode = None
        self.command_protocol.acknowledge(link, command, self.commander.request_mode(mode))
        return None

    def _mode_command(self, mode: Mode) -> Result:
        return self.commander.request_mode(mode)

    def _takeoff(self, link: Link, command: Command) -> Result | None:
        altitude = command.params[6]
        if abs(altitude) <= HIGHEST_M and altitude != 0.0:
            height = altitude - self.state.origin.altitude_of(float(self.state.home_ned[2]))
            if height > 0.5:
                self.navigator.takeoff_altitude_m = height
        return self._mode_command(Mode.TAKEOFF)

    def _reposition(self, link: Link, command: Command) -> Result | None:
        latitude, longitude, altitude = command.params[4:7]
        result = self.commander.request_mode(Mode.LOITER)
        if result is Result.ACCEPTED:
            target = np.array(self.navigator.target)
            if is_place(latitude, longitude, 0.0) and (latitude or longitude):
                target[:2] = self.state.origin.local(latitude, longitude)
            if abs(altitude) <= HIGHEST_M:
                target[2] = self.state.origin.altitude_of(altitude)
            if math.isfinite(command.params[3]):
                self.navigator.yaw = command.params[3]
            self.navigator.reposition = target
        return result

    def _orbit(self, link: Link, command: Command) -> Result | None:
        """Centre, radius and speed are the vehicle's place and the last ones where they are not given."""
        result = self.commander.request_mode(Mode.ORBIT)
        if result is Result.ACCEPTED:
            self.navigator.orbit.begin(command.params)
        return result

    def _choose_item(self, link: Link, command: Command) -> Result | None:
        chosen = self.plan_protocol.choose(whole(command.params[0]))
        return Result.ACCEPTED if chosen else Result.DENIED

    def _start_mission(self, link: Link, command: Command) -> Result | None:
        if not self.navigator.mission.valid:
            return Result.DENIED
        return self.commander.request_mode(Mode.MISSION)

    def _change_speed(self, link: Link, command: Command) -> Result | None:
        if command.params[1] > 0:
            self.state.parameters.set(
                "MPC_XY_CRUISE", min(command.params[1], self.state.parameters["MPC_XY_VEL_MAX"])
            )
        return Result.ACCEPTED

    def _set_home(self, link: Link, command: Command) -> Result | None:
        if command.params[0] >= 0.5:
            self.commander.set_home_here()
        else:
            if not is_place(*command.params[4:7]):
                return Result.DENIED
            north, east = self.state.origin.local(command.params[4], command.params[5])
            self.commander.set_home(np.array([north, east, self.state.origin.altitude_of(command.params[6])]))
        return Result.ACCEPTED

    def _reboot(self, link: Link, command: Command) -> Result | None:
        return Result.DENIED if self.state.armed else Result.ACCEPTED

    def _arm(self, link: Link, command: Command) -> Result | None:
        wanted = round(command.params[0]) if math.isfinite(command.params[0]) else -1
        if wanted not in (0, 1):
            return Result.UNSUPPORTED
        return self.commander.request_arm(wanted == 1, command.params[1] == FORCE_MAGIC)

    def _request_capabilities(self, link: Link, command: Command) -> Result | None:
        self.streams.send_named(link, "AUTOPILOT_VERSION")
        return Result.ACCEPTED

    def _set_mode(self, link: Link, message: Received) -> None:
        v = message.values
        if v["base_mode"] & ModeFlag.CUSTOM_MODE_ENABLED:
            self.commander.request_mode(mode_of_custom(v["custom_mode"]))
