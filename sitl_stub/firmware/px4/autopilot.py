"""PX4 as a firmware of the stub: its parts, and what it does a hundred times a second. 1.17; 1.13 where it differs.

Behaviour follows the capture of PX4 1.17.0 (see `tests/conformance`). Modes and arming are in `commander.py`, own modes
in `navigator.py`, setpoints in `offboard.py`, what it takes in `protocol.py`, what it sends in `messages.py`.
"""

from __future__ import annotations

from sitl_stub.firmware.common.autopilot import LOGIC_PERIOD_US, Autopilot
from sitl_stub.firmware.common.clock import Clock
from sitl_stub.firmware.common.globe import LocalOrigin
from sitl_stub.firmware.common.parameters import ParameterTable
from sitl_stub.firmware.px4 import layout as at
from sitl_stub.firmware.px4.commander import Commander
from sitl_stub.firmware.px4.core import FlightCore
from sitl_stub.firmware.px4.land_detector import LandDetector
from sitl_stub.firmware.px4.messages import Px4Messages
from sitl_stub.firmware.px4.modes import Mode, mode_named
from sitl_stub.firmware.px4.navigator import Navigator
from sitl_stub.firmware.px4.offboard import OffboardControl, OffboardSetpoint
from sitl_stub.firmware.px4.parameter_protocol import Px4ParameterProtocol
from sitl_stub.firmware.px4.protocol import Px4Protocol
from sitl_stub.firmware.px4.state import VERSION_1_17, Px4State, Px4Version
from sitl_stub.firmware.px4.voice import Px4Voice


class Px4(Autopilot):
    """One PX4."""

    core: FlightCore
    voice: Px4Voice
    state: Px4State

    def __init__(
        self,
        core: FlightCore,
        parameters: ParameterTable,
        version: Px4Version = VERSION_1_17,
        ready_after_s: float = 4.2,
    ) -> None:
        self.version = version
        self.ready_after_us = int(ready_after_s * 1e6)
        clock = Clock(core)
        super().__init__(core, parameters, clock, Px4Voice(clock, version.speaks_events))

    def make_parts(self) -> None:
        """Everything as it is when the firmware starts."""
        p = self.parameters
        origin = LocalOrigin(p["SIH_LOC_LAT0"], p["SIH_LOC_LON0"], p["SIH_LOC_H0"])
        self.state = state = Px4State(
            core=self.core,
            parameters=p,
            clock=self.clock,
            radio=self.radio,
            origin=origin,
            version=self.version,
            ready_after_us=self.ready_after_us,
        )
        self.parameter_protocol = Px4ParameterProtocol(p, self.voice)
        self.land_detector = LandDetector()
        self.offboard = OffboardSetpoint(self.version.takes_actuator_controls)
        self.control = OffboardControl(state, self.offboard)
        self.navigator = Navigator(state)
        self.commander = Commander(state, self.voice, self.offboard, self.navigator)
        self.navigator.enter(Mode.LOITER)
        sent = Px4Messages(state, self.voice, self.navigator, self.control, self.commander)
        self.streams.define(sent.definitions())
        taken = Px4Protocol(
            state, self.navigator, self.control, self.commander, self.streams, self.command_protocol
        )
        self.command_protocol.handlers.update(taken.commands())
        self.messages.update(taken.messages())

    @property
    def takes_setpoints(self) -> bool:
        """Whether OFFBOARD flies."""
        return self.state.mode is Mode.OFFBOARD

    @property
    def mode_name(self) -> str:
        """Name of the mode that flies."""
        return self.state.mode.name

    # --- the loop ----------------------------------------------------------------------------------------------
    def run_logic(self) -> None:
        """Everything that happens a hundred times a second."""
        core, state = self.core, self.state
        thrust = float(core.memory[at.OUT_THRUST])
        state.ground = self.land_detector.update(
            core.time_us, state.armed, thrust, core.velocity_ned, core.body_rate_frd, self.parameters
        )
        self.commander.update()
        latched = self.control.latch()
        core.integrate = state.armed and not state.ground.landed
        if not state.armed or state.killed:
            core.idle()
        elif state.mode is Mode.OFFBOARD:
            if latched:
                self.control.apply()
        elif self.navigator.update(LOGIC_PERIOD_US * 1e-6):
            self.commander.takeoff_done()

    def take_off_alone(self, height_m: float) -> None:
        """TAKEOFF as a ground station asks for it; then LOITER."""
        commander = self.commander
        self.run_until(lambda: commander.arming_refusal() is None, 120.0, "not ready to arm")
        commander.request_arm(True, forced=False)
        self.navigator.takeoff_altitude_m = height_m
        commander.request_mode(Mode.TAKEOFF)
        self.run_until(lambda: self.state.mode is Mode.LOITER, 120.0, f"not at {height_m:g} m")
        self.run_until(lambda: self.hovers_at(height_m), 30.0, f"not at rest at {height_m:g} m")

    # --- the pilot ---------------------------------------------------------------------------------------------
    def pilot_mode(self, name: str) -> None:
        """The pilot, sticks centred, switches to the mode of that name."""
        self._hold_sticks(0.0, 0.0, 0.0, 0.5)
        self.commander.request_mode(mode_named(name))

    def pilot_sticks(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        """The pilot moves the sticks: −1..1 (pitch forward positive), throttle 0..1."""
        before, after = self.sticks_now, (roll, pitch, yaw, throttle)
        scale = (1.0, 1.0, 1.0, 2.0)
        moved = max(abs(b - a) * s for a, b, s in zip(before, after, scale, strict=True))
        self._hold_sticks(*after)
        self.commander.override_by_sticks(moved)

    def _hold_sticks(self, roll: float, pitch: float, yaw: float, throttle: float) -> None:
        self.state.sticks.put(roll, pitch, yaw, throttle)
        self.state.sticks.radio = True

    def pilot_disarm(self, forced: bool) -> None:
        """The pilot disarms; not in the air unless `forced`."""
        self.commander.request_arm(False, forced)

    def estimate_jumped(self, jump_ned: tuple[float, float, float], yaw_rad: float) -> None:
        """The estimator has been reset: own modes take their setpoints along."""
        self.navigator.target += jump_ned
        self.navigator.follower.position += jump_ned
        self.navigator.yaw += yaw_rad
