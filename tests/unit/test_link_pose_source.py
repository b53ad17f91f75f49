"""Poses out of a simulator's true state: what goes in as MAVLink comes out in ENU/FLU, whatever else is on the wire."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from companion.mavlink.pose_source import true_poses

LATITUDE, LONGITUDE, ALTITUDE_M = 47.3977, 8.5456, 488.0
EARTH_RADIUS_M = 6371000.0


class Wire:
    """A transport with datagrams that lie ready."""

    datagrams = True

    def __init__(self, *datagrams: bytes) -> None:
        self.waiting = list(datagrams)
        self.sent: list[bytes] = []
        self.believed = 0

    def wait(self, seconds: float) -> bool:
        return bool(self.waiting)

    sender = None

    def receive(self) -> list[bytes]:
        ready, self.waiting = self.waiting, []
        return ready

    def send(self, data: bytes) -> None:
        self.sent.append(bytes(data))

    def believe_sender(self) -> None:
        self.believed += 1


def true_state(north_m: float, east_m: float, up_m: float, heading_rad: float = 0.0) -> bytes:
    codec = mavlink.MAVLink(None, srcSystem=4, srcComponent=1)
    latitude = LATITUDE + math.degrees(north_m / EARTH_RADIUS_M)
    longitude = LONGITUDE + math.degrees(east_m / EARTH_RADIUS_M / math.cos(math.radians(LATITUDE)))
    message = mavlink.MAVLink_hil_state_quaternion_message(
        time_usec=0,
        attitude_quaternion=[math.cos(heading_rad / 2), 0.0, 0.0, math.sin(heading_rad / 2)],
        rollspeed=0.0,
        pitchspeed=0.0,
        yawspeed=0.0,
        lat=round(latitude * 1e7),
        lon=round(longitude * 1e7),
        alt=round((ALTITUDE_M + up_m) * 1e3),
        vx=100,
        vy=200,
        vz=300,
        ind_airspeed=0,
        true_airspeed=0,
        xacc=0,
        yacc=0,
        zacc=0,
    )
    return bytes(message.pack(codec))


def test_true_states_become_poses_about_the_first() -> None:
    spoilt = bytearray(true_state(5.0, 5.0, 5.0))
    spoilt[20] ^= 0xFF
    wire = Wire(true_state(0, 0, 0), bytes(spoilt), b"no frame", true_state(3.0, -2.0, 1.5, math.pi / 2))
    source = true_poses(wire, rate_hz=100.0)  # type: ignore[arg-type]
    first, second = next(source), next(source)
    assert first is not None and second is not None
    assert first.position_enu == pytest.approx([0, 0, 0])
    assert second.position_enu == pytest.approx([-2.0, 3.0, 1.5], abs=0.02)  # 1e-7 degrees are a centimetre
    # north, level: the nose points along ENU's y, a quarter turn from its x
    assert np.abs(first.quaternion_wxyz) == pytest.approx([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])
    # east: along x
    assert np.abs(second.quaternion_wxyz) == pytest.approx([1, 0, 0, 0], abs=1e-7)
    assert second.velocity_enu == pytest.approx([2.0, 1.0, -3.0])
    assert next(source) is None
    assert wire.believed == 1


def test_the_true_state_is_asked_for_of_the_system_that_is_there() -> None:
    wire = Wire(true_state(0, 0, 0))
    source = true_poses(wire, rate_hz=50.0)  # type: ignore[arg-type]
    next(source)
    next(source)
    next(source)
    asked = [mavlink.MAVLink(None).decode(bytearray(frame)) for frame in wire.sent]
    assert [m.target_system for m in asked] == [1, 4]
    assert {(m.command, m.param1, m.param2) for m in asked} == {(511, 115.0, 20000.0)}
