"""MAVSDK 4, a client nobody here wrote, flies the stub: health, parameters, take-off, offboard, land, disconnection."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


def _ask_for_health(telemetry: Any) -> None:
    """What health_all_ok is made of: ArduPilot sends none of it until asked."""
    telemetry.set_rate_health(5.0)
    telemetry.set_rate_position(10.0)


@contextmanager
def client_of(stub: Stub, address: str = "") -> Iterator[Any]:
    """A MAVSDK of its own and the system it found; `address`: where the stub is not at its own."""
    kind = mavsdk.ComponentType.COMPANION_COMPUTER
    client = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(kind))
    try:
        client.add_any_connection(address or stub.mavsdk_address)
        system = client.first_autopilot(60.0)
        assert system is not None
        yield system
    finally:
        client.destroy()


@pytest.fixture
def connected() -> Iterator[tuple[Stub, Any]]:
    with Stub(speed=SPEED) as stub, client_of(stub) as system:
        yield stub, system


@pytest.fixture
def copter() -> Iterator[Any]:
    with ardupilot_for_mavsdk() as stub, client_of(stub) as system:
        yield system


def ardupilot_for_mavsdk() -> Stub:
    """With the bit by which thrust means thrust: MAVSDK's attitude setpoints carry a thrust."""
    settings = {"GUID_OPTIONS": 8.0, "ATC_ANGLE_BOOST": 0.0}
    return Stub("ardupilot", speed=SPEED, ready_after_s=2.0, parameters=settings)


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
        with client_of(stub) as system:
            telemetry, offboard, action = Telemetry(system), Offboard(system), Action(system)
            assert _until(telemetry.health_all_ok)
            offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -2.0, 0.0))
            offboard.start()
            action.arm()
            assert _until(lambda: telemetry.position().relative_altitude_m > 1.5)
        assert stub.wait(40.0) == 0  # offboard loss, land, disarm


def test_mavsdk_flies_ardupilot_too(copter: Any) -> None:
    """Telemetry, health, parameters (floats on this firmware), arm, take-off, offboard position and attitude, land."""
    action, telemetry, offboard, param = (
        Action(copter),
        Telemetry(copter),
        Offboard(copter),
        Param(copter),
    )
    telemetry.set_rate_position_velocity_ned(10.0)
    telemetry.set_rate_attitude_euler(10.0)
    _ask_for_health(telemetry)
    assert _until(telemetry.health_all_ok)
    assert param.get_param_float("ATC_ANG_RLL_P") == pytest.approx(4.5, abs=0.5)
    param.set_param_float("ATC_ANG_RLL_P", 5.0)
    assert param.get_param_float("ATC_ANG_RLL_P") == pytest.approx(5.0)
    assert param.get_param_int("GUID_OPTIONS") == 8
    action.set_takeoff_altitude(3.0)
    action.arm()
    action.takeoff()
    assert _until(lambda: telemetry.position().relative_altitude_m > 2.5)
    offboard.set_position_ned(PositionNedYaw(1.0, 0.0, -3.0, 0.0))
    offboard.start()
    assert _until(lambda: abs(telemetry.position_velocity_ned().position.north_m - 1.0) < 0.3)
    offboard.set_attitude(Attitude(0.0, 0.0, 15.0, 0.369))
    assert _until(lambda: 10.0 < telemetry.attitude_euler().yaw_deg < 20.0)
    offboard.set_position_ned(PositionNedYaw(1.0, 0.0, -3.0, 0.0))
    action.land()
    assert _until(lambda: not telemetry.armed(), 60.0)


@pytest.mark.parametrize("firmware", ["px4", "ardupilot"])
def test_mavsdk_comes_back(firmware: str) -> None:
    """One client goes; the next, on the same port, gets everything again."""
    with Stub(firmware, speed=SPEED, ready_after_s=2.0) as stub:
        for _ in range(2):
            with client_of(stub) as system:
                telemetry, param = Telemetry(system), Param(system)
                _ask_for_health(telemetry)
                assert _until(telemetry.health_all_ok)
                name = "MPC_XY_P" if firmware == "px4" else "ATC_ANG_RLL_P"
                assert param.get_param_float(name) > 0.5
        assert stub.running


def test_mavsdk_notices_that_the_stub_is_gone_and_back() -> None:
    """Its connection state falls after three seconds without a HEARTBEAT, and rises with a new stub at the address."""
    with Stub() as first, client_of(first) as system:
        assert _until(system.is_connected)
        local, remote = first.ready["links"][0]["local"][1], first.endpoint.rpartition(":")[2]
        first.stop()
        assert _until(lambda: not system.is_connected())
        with Stub(arguments=["--udp", f"127.0.0.1:{remote}@{local}"]):
            assert _until(system.is_connected)


def test_mavsdk_plans_fences_circles_and_lists_logs() -> None:
    """What MAVSDK's examples do with a PX4: geofence, mission up, down, flown with its progress, orbit, return, logs."""
    from mavsdk.plugins.action import OrbitYawBehavior
    from mavsdk.plugins.geofence import FenceType, Geofence, GeofenceData, Point, Polygon
    from mavsdk.plugins.log_files import LogFiles
    from mavsdk.plugins.mission import Mission, MissionItem, MissionPlan

    with Stub(speed=SPEED) as stub, client_of(stub) as system:
        action, telemetry, mission = Action(system), Telemetry(system), Mission(system)
        assert _until(telemetry.health_all_ok)
        home = telemetry.position()

        def at(north_m: float, east_m: float) -> tuple[float, float]:
            north, east = north_m / 111_195.0, east_m / 111_195.0 / math.cos(math.radians(home.latitude_deg))
            return home.latitude_deg + north, home.longitude_deg + east

        corners = [Point(*at(x, y)) for x, y in ((-50, -50), (50, -50), (50, 50), (-50, 50))]
        Geofence(system).upload_geofence(GeofenceData([Polygon(corners, FenceType.INCLUSION)], []))
        items = [
            MissionItem(
                *at(*place),
                relative_altitude_m=4.0,
                speed_m_s=3.0,
                is_fly_through=True,
                gimbal_pitch_deg=math.nan,
                gimbal_yaw_deg=math.nan,
                camera_action=MissionItem.CameraAction.NONE,
                loiter_time_s=math.nan,
                camera_photo_interval_s=math.nan,
                acceptance_radius_m=1.0,
                yaw_deg=math.nan,
                camera_photo_distance_m=math.nan,
                vehicle_action=MissionItem.VehicleAction.NONE,
            )
            for place in ((6.0, 0.0), (6.0, 6.0))
        ]
        mission.upload_mission(MissionPlan(items))
        assert len(mission.download_mission().mission_items) == 2
        action.arm()
        mission.start_mission()
        assert _until(lambda: telemetry.flight_mode() == FlightMode.MISSION)
        assert _until(mission.is_mission_finished, 60.0), mission.mission_progress()
        progress = mission.mission_progress()
        assert progress.current == progress.total == 2
        centre = at(6.0, 0.0)
        around = OrbitYawBehavior.HOLD_FRONT_TO_CIRCLE_CENTER
        action.do_orbit(5.0, 2.0, around, *centre, home.absolute_altitude_m + 4.0)
        assert _until(lambda: telemetry.position_velocity_ned().position.east_m < -3.0), (
            telemetry.flight_mode()
        )
        action.return_to_launch()
        assert _until(lambda: not telemetry.armed(), 90.0)
        assert len(LogFiles(system).get_entries()) == 1
