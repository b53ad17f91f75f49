"""A client of an ArduCopter stub inside this process."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stub_client import MemoryClient

from sitl_stub.firmware.ardupilot.autopilot import ArduPilot
from sitl_stub.firmware.ardupilot.build import build_ardupilot

GUIDED, LOITER, LAND, RTL, BRAKE, GUIDED_NOGPS = 4, 5, 9, 6, 17, 20
THRUST_AS_THRUST = {"GUID_OPTIONS": 8.0, "ATC_ANGLE_BOOST": 0.0}
HOVER = 0.369


class ArduPilotClient(MemoryClient):
    """One ArduCopter with a perfect estimator, ready after a second unless told otherwise."""

    autopilot: ArduPilot  # type: ignore[assignment]

    def __init__(self, ready_after_s: float = 1.0, **build: Any) -> None:
        build = {"estimator": "perfect", **build}
        super().__init__(build_ardupilot(ready_after_s=ready_after_s, **build))  # type: ignore[arg-type]

    def texts(self) -> list[str]:
        """STATUSTEXTs since the last take, chunks put together."""
        self.advance(0.02)
        joined: list[str] = []
        for message in self.take("STATUSTEXT"):
            if message.chunk_seq:
                joined[-1] += message.text
            else:
                joined.append(message.text)
        return joined

    def answers(self, command: str | int, *params: float) -> tuple[list[int], list[str]]:
        """Results of the acknowledgements, and the texts that explain them."""
        return self.command(command, *params), self.texts()

    def velocity(self, vx: float, vy: float, vz: float) -> None:
        mask = 0b110111000111
        self.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                0, 1, 1, 1, mask, 0, 0, 0, vx, vy, vz, 0, 0, 0, 0, 0
            )
        )

    def in_the_air(self, height_m: float = 5.0) -> None:
        """Armed in GUIDED and taken off by command; hovering."""
        self.advance(2.0)
        assert self.command("DO_SET_MODE", 1, GUIDED) == [0]
        assert self.command("COMPONENT_ARM_DISARM", 1) == [0]
        assert self.command("NAV_TAKEOFF", 0, 0, 0, 0, 0, 0, height_m) == [0]
        self.advance(12.0)
        assert abs(self.height_m - height_m) < 0.1

    def hover(self) -> None:
        """One setpoint of hover thrust."""
        self.attitude(HOVER)
