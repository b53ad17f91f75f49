"""MAVSDK 4, a client nobody here wrote, flies the stub: health, parameters, take-off, offboard, land, disconnection."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from sitl_stub import Stub

mavsdk = pytest.importorskip("mavsdk")
from mavsdk.plugins.action import Action  # noqa: E402
from mavsdk.plugins.offboard import Attitude, Offboard, PositionNedYaw  # noqa: E402
from mavsdk.plugins.param import Param  # noqa: E402
from mavsdk.plugins.telemetry import FlightMode, LandedState, Telemetry  # noqa: E402

pytestmark = pytest.mark.flight

SPEED = 3.0


def _until(condition: Callable[[], bool], timeout_s: float = 30.0) -> bool:
    """Ask until it is so; MAVSDK's state is only there to be asked for."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


@pytest.fixture
def connected() -> Iterator[tuple[Stub, Any]]:
    with Stub(speed=SPEED) as stub:
        kind = mavsdk.ComponentType.COMPANION_COMPUTER
        client = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(kind))
        client.add_any_connection(stub.mavsdk_address)
        system = client.first_autopilot(20.0)
        assert system is not None
        yield stub, system
        client.destroy()


def test_mavsdk_flies_a_whole_flight(connected: tuple[Stub, Any]) -> None:
    _, system = connected
    action, telemetry, offboard, param = Action(system), Telemetry(system), Offboard(system), Param(system)
    assert _until(telemetry.health_all_ok)
    assert param.get_param_float("MPC_THR_HOVER") == pytest.approx(0.3658, abs=1e-4)
    assert param.get_param_int("COM_OBL_RC_ACT") == 4
    param.set_param_int("COM_OBL_RC_ACT", 5)
    assert param.get_param_int("COM_OBL_RC_ACT") == 5
    action.set_takeoff_altitude(3.0)
    action.arm()
    action.takeoff()
    assert _until(lambda: telemetry.landed_state() == LandedState.IN_AIR)
    assert telemetry.position().relative_altitude_m == pytest.approx(3.0, abs=0.5)
    offboard.set_position_ned(PositionNedYaw(1.0, 0.0, -3.0, 0.0))
    offboard.start()
    assert _until(lambda: abs(telemetry.position_velocity_ned().position.north_m - 1.0) < 0.2)
    assert telemetry.flight_mode() == FlightMode.OFFBOARD
    offboard.set_attitude(Attitude(0.0, 0.0, 10.0, 0.3658))
    assert _until(lambda: telemetry.attitude_euler().yaw_deg > 7.0)
    action.hold()
    assert _until(lambda: telemetry.flight_mode() == FlightMode.HOLD)
    action.land()
    assert _until(lambda: not telemetry.armed(), 60.0)
    assert telemetry.landed_state() == LandedState.ON_GROUND


def test_mavsdk_that_goes_away_leaves_the_vehicle_to_its_failsafe() -> None:
    with Stub(speed=SPEED, exit_on_disarm=True) as stub:
        kind = mavsdk.ComponentType.COMPANION_COMPUTER
        client = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(kind))
        client.add_any_connection(stub.mavsdk_address)
        system = client.first_autopilot(20.0)
        telemetry, offboard, action = Telemetry(system), Offboard(system), Action(system)
        assert _until(telemetry.health_all_ok)
        offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -2.0, 0.0))
        offboard.start()
        action.arm()
        assert _until(lambda: telemetry.position().relative_altitude_m > 1.5)
        client.destroy()
        assert stub.wait(40.0) == 0  # offboard loss, land, disarm
