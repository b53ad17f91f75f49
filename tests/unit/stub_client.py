"""A client of a stub inside this process: messages are handed over packed by pymavlink, as a stranger would pack them."""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl_stub.firmware.px4.autopilot import Px4
from sitl_stub.firmware.px4.build import build_px4
from sitl_stub.firmware.px4.modes import Mode
from sitl_stub.mavlink.codec import Received
from sitl_stub.mavlink.links import MemoryLink

LEVEL = [1.0, 0.0, 0.0, 0.0]


def message_id(name: str) -> int:
    """MAVLINK_MSG_ID_`name`."""
    return int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))


class MemoryClient:
    """One autopilot and one link to it."""

    def __init__(
        self, autopilot: Px4 | None = None, role: str = "onboard", mavlink1: bool = False, **build: Any
    ) -> None:
        self.autopilot = autopilot if autopilot is not None else build_px4(**build)
        self.link = MemoryLink(role=role)
        self.autopilot.attach(self.link)
        self.packer = mavlink.MAVLink(None, 255, 190)
        self.mavlink1 = mavlink1
        self.received: list[Received] = []

    def send(self, message: Any) -> None:
        frame = message.pack(self.packer, force_mavlink1=self.mavlink1)
        self.packer.seq = (self.packer.seq + 1) & 0xFF
        for decoded in self.link.reader.read_datagram(bytes(frame)):
            self.autopilot.handle(self.link, decoded)

    def command(self, command: str | int, *params: float) -> list[int]:
        """Results of the acknowledgements of MAV_CMD_`command` (a number where MAVLink has no name) that came at once."""
        number = getattr(mavlink, f"MAV_CMD_{command}") if isinstance(command, str) else command
        filled = [*params, *([0.0] * (7 - len(params)))]
        self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *filled))
        return [m.result for m in self.take("COMMAND_ACK") if m.command == number]

    def set_mode(self, mode: Mode) -> list[int]:
        """DO_SET_MODE of PX4's main and sub mode."""
        return self.command("DO_SET_MODE", 1, mode.value.main, mode.value.sub)

    def attitude(
        self, thrust: float, q: list[float] | None = None, mask: int = 7, rates: Any = (0, 0, 0)
    ) -> None:
        self.send(mavlink.MAVLink_set_attitude_target_message(0, 1, 1, mask, q or LEVEL, *rates, thrust))

    def position(self, x: float, y: float, z: float, mask: int = 0b100111111000, yaw: float = 0.0) -> None:
        self.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, 1, 1, 1, mask, x, y, z, 0, 0, 0, 0, 0, 0, yaw, 0
            )
        )

    def advance(self, seconds: float, every: Any = None, period_s: float = 0.02) -> None:
        """Go on, calling `every()` each period."""
        end = self.autopilot.time_us + round(seconds * 1e6)
        while self.autopilot.time_us < end:
            if every is not None:
                every()
            self.autopilot.advance_to(min(self.autopilot.time_us + round(period_s * 1e6), end))

    def take(self, name: str | None = None) -> list[Received]:
        """Messages since the last take (of that name; the others are kept for nobody)."""
        found = self.link.take()
        return found if name is None else [m for m in found if m.name == name]

    def last(self, name: str) -> Received:
        return self.take(name)[-1]

    def in_the_air(self, height_m: float = 3.0) -> None:
        """Armed in offboard, hovering over the start by position setpoints."""
        self.advance(2.0)
        self.advance(0.5, every=lambda: self.position(0, 0, -height_m))
        assert self.set_mode(Mode.OFFBOARD) == [0, 0]
        assert self.command("COMPONENT_ARM_DISARM", 1) == [0]
        self.advance(8.0, every=lambda: self.position(0, 0, -height_m))
        assert abs(float(self.autopilot.core.state[2]) + height_m) < 0.2

    @property
    def height_m(self) -> float:
        return -float(self.autopilot.core.state[2])

    @property
    def tilt_rad(self) -> float:
        _, x, y, _ = (float(v) for v in self.autopilot.core.state[6:10])
        return math.acos(1 - 2 * (x * x + y * y))
