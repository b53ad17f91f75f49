"""PX4 as a firmware of the stub: identity, commands and messages. 1.17 by default; 1.13 where it differs.

Behaviour follows the capture of PX4 1.17.0 (see `tests/conformance`). Modes and arming are in `commander.py`, own modes
in `navigator.py`, setpoints in `offboard.py`, what it sends in `messages.py`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sitl_stub.firmware.common.autopilot import LOGIC_PERIOD_US, Autopilot
from sitl_stub.firmware.common.commands import HIGHEST_M, Command, Result, is_place, whole
from sitl_stub.firmware.common.parameters import ParameterTable
from sitl_stub.firmware.common.streams import Builder
from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.commander import FORCE_MAGIC, Commander
from sitl_stub.firmware.px4.core import CONTROL_PERIOD_US, FlightCore
from sitl_stub.firmware.px4.events import Event
from sitl_stub.firmware.px4.land_detector import LandDetector
from sitl_stub.firmware.px4.messages import Px4Messages
from sitl_stub.firmware.px4.modes import Mode, mode_named, mode_of, mode_of_custom
from sitl_stub.firmware.px4.navigator import FULL_STICK, Navigator
from sitl_stub.firmware.px4.offboard import OffboardKind, OffboardSetpoint
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import Link

CONTROL_MODE_PERIOD_US = 500_000
ESTIMATE_PERIOD_US = 4000
"""How often PX4's attitude loop runs on the estimate of its simulator (250 Hz)."""


@dataclass(frozen=True, slots=True)
class Px4Version:
    """What differs between releases."""

    name: str
    flight_sw_version: int
    takes_actuator_controls: bool
    """SET_ACTUATOR_CONTROL_TARGET does something (until 1.13)."""
    old_mixers: bool
    """Fixed mixers with 1.13's normalisation."""
    speaks_events: bool
    """Announces with EVENT rather than STATUSTEXT."""
    newer_reports: bool
    """Sends CURRENT_MODE, the way home in seconds, the receiver's integrity and remote identification."""


VERSION_1_17 = Px4Version("px4", 0x011100FF, False, False, True, True)
VERSION_1_13 = Px4Version("px4-1.13", 0x010D03FF, True, True, False, False)


class Px4(Autopilot):
    """One PX4."""

    core: FlightCore
    hash_leads_list = True
    has_distance_sensor = False
    """Whether landing slows to MPC_LAND_CRWL near the ground; the capture's did not."""

    def __init__(
        self,
        core: FlightCore,
        parameters: ParameterTable,
        version: Px4Version = VERSION_1_17,
        ready_after_s: float = 4.2,
    ) -> None:
        self.version = version
        self.ready_after_us = int(ready_after_s * 1e6)
        self.estimator_after_us = int(0.75 * self.ready_after_us)
        self.home_after_us = int(0.55 * self.ready_after_us)
        self.say_messages = Px4Messages(self)
        super().__init__(core, parameters)
        self.power_up()
        self.commands.update(
            {
                20: lambda link, command: self._mode_command(Mode.RTL),
                21: lambda link, command: self._mode_command(Mode.LAND),
                22: self._takeoff,
                176: self._do_set_mode,
                178: self._change_speed,
                179: self._set_home,
                192: self._reposition,
                241: self.command_protocol.ignore,
                246: self._reboot,
                400: self._arm,
                520: self._request_capabilities,
            }
        )
        self.messages.update(
            {
                "SET_ATTITUDE_TARGET": self._set_attitude_target,
                "SET_POSITION_TARGET_LOCAL_NED": self._set_position_target,
                "SET_ACTUATOR_CONTROL_TARGET": self._set_actuator_control_target,
                "SET_MODE": self._set_mode,
                "MANUAL_CONTROL": self._manual_control,
            }
        )

    def power_up(self) -> None:
        """Everything as it is when the firmware starts."""
        self.home_ned = np.zeros(3)
        self.home_quaternion = (1.0, 0.0, 0.0, 0.0)
        self.home_set_us = 0
        self.armed_at_us = 0
        self.event_sequence = 0xFFF9
        self._latched_kind = OffboardKind.NONE
        self._latched_us = 0
        self._latched_state: tuple[bool, Mode] = (False, Mode.LOITER)
        self.land_detector = LandDetector()
        self.offboard = OffboardSetpoint(self.version.takes_actuator_controls)
        self.navigator = Navigator(self)
        self.commander = Commander(self)
        self.navigator.enter(Mode.LOITER)

    # --- state -------------------------------------------------------------------------------------------------
    @property
    def armed(self) -> bool:
        """Whether the rotors may turn."""
        return self.commander.armed

    @property
    def takes_setpoints(self) -> bool:
        """Whether OFFBOARD flies."""
        return self.commander.mode is Mode.OFFBOARD

    @property
    def estimator_ready(self) -> bool:
        """Whether the estimate has converged."""
        return self.uptime_us >= self.estimator_after_us

    @property
    def system_ready(self) -> bool:
        """Whether everything but the mode's own needs is there for arming."""
        return self.uptime_us >= self.ready_after_us and bool(self.core.estimate[18] > 0.0)

    @property
    def home_known(self) -> bool:
        """Whether HOME_POSITION has been set."""
        return self.uptime_us >= self.home_after_us

    def set_home_here(self) -> None:
        """Home is where the vehicle is (PX4 sets it on arming)."""
        self.home_ned = np.array(self.core.position_ned)
        w, x, y, z = (float(value) for value in self.core.quaternion)
        self.home_quaternion = (w, x, y, z)
        self.home_set_us = self.clock_us

    def announce(
        self,
        severity: int,
        text: str,
        event: Event | None = None,
        arguments: bytes = b"",
        old_text: str | None = None,
    ) -> None:
        """Tell clients what happened: as EVENT where the release does that, else as STATUSTEXT (`old_text`, if other)."""
        if not self.version.speaks_events:
            self.say(severity, text if old_text is None else old_text)
            return
        self.on_text(text)
        if event is None:
            return
        self.event_sequence = (self.event_sequence + 1) & 0xFFFF
        self.broadcast(
            "EVENT",
            id=event.number,
            event_time_boot_ms=self.clock_us // 1000,
            sequence=self.event_sequence,
            log_levels=event.log_levels,
            arguments=arguments,
        )

    # --- the loop ----------------------------------------------------------------------------------------------
    def run_logic(self) -> None:
        """Everything that happens a hundred times a second."""
        core = self.core
        thrust = float(core.memory[at.OUT_THRUST])
        commander = self.commander
        self.land_detector.update(
            core.time_us, commander.armed, thrust, core.velocity_ned, core.body_rate_frd, self.parameters
        )
        commander.update()
        latched = self._latch_offboard_kind()
        core.integrate = commander.armed and not self.land_detector.landed
        if not commander.armed or self.killed:
            core.idle()
        elif commander.mode is Mode.OFFBOARD:
            if latched:
                self._apply_offboard()
        else:
            self.navigator.update(LOGIC_PERIOD_US * 1e-6)

    def _latch_offboard_kind(self) -> bool:
        """PX4's commander publishes which controllers run when the mode or arming changes, and else twice a second.

        Until then a setpoint of another kind meets the controllers of the old one (seen in the capture).
        """
        commander = self.commander
        state = (commander.armed, commander.mode)
        if state != self._latched_state or self.time_us - self._latched_us >= CONTROL_MODE_PERIOD_US:
            self._latched_state = state
            self._latched_us = self.time_us
            self._latched_kind = self.offboard.kind
            return True
        return False

    @property
    def attitude_loop_runs_offboard(self) -> bool:
        """Whether the setpoints in force use the attitude loop (HEARTBEAT's stabilise bit in OFFBOARD)."""
        return self._latched_kind not in (OffboardKind.NONE, OffboardKind.RATES, OffboardKind.ACTUATORS)

    def _apply_offboard(self) -> None:
        if not (self.commander.armed and self.commander.mode is Mode.OFFBOARD) or self.killed:
            return
        packed, setpoint = self.offboard.packed, self.core.setpoint
        if (
            setpoint[at.KIND] == at.KIND_IDLE
            or self.offboard.kind.controllers == self._latched_kind.controllers
        ):
            setpoint[:] = packed
        elif self._latched_kind is OffboardKind.ATTITUDE and self.offboard.kind is OffboardKind.RATES:
            # the attitude loop still runs and overwrites each rate setpoint with its own, one estimate later
            setpoint[at.OVERRIDE_RATES : at.OVERRIDE_RATES + 3] = packed[at.RATES : at.RATES + 3]
            setpoint[at.OVERRIDE_THRUST] = packed[at.THRUST]
            setpoint[at.OVERRIDE_PERIODS] = ESTIMATE_PERIOD_US // CONTROL_PERIOD_US

    # --- setpoints ---------------------------------------------------------------------------------------------
    def _set_attitude_target(self, link: Link, message: Received) -> None:
        if self.offboard.take_attitude(message, self.time_us):
            self._apply_offboard()

    def _set_position_target(self, link: Link, message: Received) -> None:
        if self.offboard.take_position(message, self.core.yaw, self.time_us):
            self._apply_offboard()

    def _set_actuator_control_target(self, link: Link, message: Received) -> None:
        if self.offboard.take_actuators(message, self.time_us):
            self._apply_offboard()

    def _manual_control(self, link: Link, message: Received) -> None:
        v = message.values
        if int(self.parameters["COM_RC_IN_MODE"]) in (0, 4) and not self.accepts_joystick:
            return
        sticks = self.navigator.sticks
        sticks.pitch = min(max(v["x"] / FULL_STICK, -1.0), 1.0)
        sticks.roll = min(max(v["y"] / FULL_STICK, -1.0), 1.0)
        sticks.throttle = min(max(v["z"] / FULL_STICK, 0.0), 1.0)
        sticks.yaw = min(max(v["r"] / FULL_STICK, -1.0), 1.0)
        sticks.last_us = self.time_us

    @property
    def accepts_joystick(self) -> bool:
        """COM_RC_IN_MODE: 0 takes radio sticks only, 4 none; the rest take MANUAL_CONTROL."""
        return int(self.parameters["COM_RC_IN_MODE"]) not in (0, 4)

    # --- the pilot ---------------------------------------------------------------------------------------------
    def pilot_mode(self, name: str) -> None:
        """The pilot, sticks centred, switches to the mode of that name."""
        self._hold_sticks(0.0, 0.0, 0.0, 0.5)
        self.commander.request_mode(mode_named(name))

    @property
    def mode_name(self) -> str:
        """Name of the mode that flies."""
        return self.commander.mode.name

    def pilot_sticks(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        """The pilot moves the sticks: −1..1 (pitch forward positive), throttle 0..1."""
        before, after = self.sticks_now, (roll, pitch, yaw, throttle)
        scale = (1.0, 1.0, 1.0, 2.0)
        moved = max(abs(b - a) * s for a, b, s in zip(before, after, scale, strict=True))
        self._hold_sticks(*after)
        self.commander.override_by_sticks(moved)

    def _hold_sticks(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        sticks = self.navigator.sticks
        sticks.roll, sticks.pitch, sticks.yaw, sticks.throttle = roll, pitch, yaw, throttle
        sticks.radio = True

    @property
    def sticks_now(self) -> tuple[float, float, float, float]:
        """Roll, pitch, yaw, throttle as `pilot_sticks` takes them."""
        sticks = self.navigator.sticks
        return sticks.roll, sticks.pitch, sticks.yaw, sticks.throttle

    def pilot_disarm(self, forced: bool) -> None:
        """The pilot disarms; not in the air unless `forced`."""
        self.commander.request_arm(False, forced)

    def estimate_jumped(self, jump_ned: tuple[float, float, float], yaw_rad: float) -> None:
        """The estimator has been reset: own modes take their setpoints along."""
        self.navigator.target += jump_ned
        self.navigator.follower.position += jump_ned
        self.navigator.yaw += yaw_rad

    # --- commands ----------------------------------------------------------------------------------------------
    def _do_set_mode(self, link: Link, command: Command) -> Result | None:
        # Two acknowledgements, as in the capture: one for the command having arrived, one for its outcome.
        self.command_protocol.acknowledge(link, command, Result.ACCEPTED)
        if max(whole(command.params[0]), 0) & 1:
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
            height = altitude - self.say_messages.altitude_of(float(self.home_ned[2]))
            if height > 0.5:
                self.navigator.takeoff_altitude_m = height
        return self._mode_command(Mode.TAKEOFF)

    def _reposition(self, link: Link, command: Command) -> Result | None:
        latitude, longitude, altitude = command.params[4:7]
        result = self.commander.request_mode(Mode.LOITER)
        if result is Result.ACCEPTED:
            target = np.array(self.navigator.target)
            if is_place(latitude, longitude, 0.0) and (latitude or longitude):
                target[:2] = self.say_messages.local_of(latitude, longitude)
            if abs(altitude) <= HIGHEST_M:
                target[2] = self.say_messages.down_of(altitude)
            if math.isfinite(command.params[3]):
                self.navigator.yaw = command.params[3]
            self.navigator.reposition = target
        return result

    def _change_speed(self, link: Link, command: Command) -> Result | None:
        if command.params[1] > 0:
            self.parameters.set("MPC_XY_CRUISE", min(command.params[1], self.parameters["MPC_XY_VEL_MAX"]))
        return Result.ACCEPTED

    def _set_home(self, link: Link, command: Command) -> Result | None:
        if command.params[0] >= 0.5:
            self.set_home_here()
        else:
            if not is_place(*command.params[4:7]):
                return Result.DENIED
            north, east = self.say_messages.local_of(command.params[4], command.params[5])
            self.home_ned = np.array([north, east, self.say_messages.down_of(command.params[6])])
        return Result.ACCEPTED

    def _reboot(self, link: Link, command: Command) -> Result | None:
        return Result.DENIED if self.commander.armed else Result.ACCEPTED

    def _arm(self, link: Link, command: Command) -> Result | None:
        wanted = round(command.params[0]) if math.isfinite(command.params[0]) else -1
        if wanted not in (0, 1):
            return Result.UNSUPPORTED
        return self.commander.request_arm(wanted == 1, command.params[1] == FORCE_MAGIC)

    def _request_capabilities(self, link: Link, command: Command) -> Result | None:
        self.streams.build(link, 148)
        return Result.ACCEPTED

    def _set_mode(self, link: Link, message: Received) -> None:
        v = message.values
        if v["base_mode"] & 1:
            self.commander.request_mode(mode_of_custom(v["custom_mode"]))

    def stream_definitions(self) -> Sequence[tuple[str, Builder, Mapping[str, float]]]:
        """As on PX4's onboard and ground-station links."""
        return self.say_messages.definitions()
