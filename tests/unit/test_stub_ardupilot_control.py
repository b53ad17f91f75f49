"""How the ArduCopter stub flies: GUIDED's rules, ways down, and its controllers against numbers worked out here."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ardupilot_client import BRAKE, GUIDED, HOVER, LAND, LOITER, RTL, THRUST_AS_THRUST, ArduPilotClient
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl_stub.firmware.ardupilot import layout as at
from sitl_stub.firmware.ardupilot.build import build_ardupilot
from sitl_stub.firmware.ardupilot.core import ArduPilotCore
from sitl_stub.firmware.ardupilot.mixing import mix, motor_factors
from sitl_stub.firmware.ardupilot.parameters import fitted_parameters
from sitl_stub.firmware.ardupilot.shaping import (
    from_rotation_vector,
    inverse_sqrt_controller,
    multiply,
    rotate,
    sqrt_controller,
    to_rotation_vector,
)
from sitl_stub.physics.vehicle import load_vehicle

TILT = 0.2
ROLLED = [math.cos(TILT / 2), math.sin(TILT / 2), 0.0, 0.0]


@pytest.fixture
def flying() -> ArduPilotClient:
    """Hovering in GUIDED at 5 m with attitude + thrust targets."""
    client = ArduPilotClient(parameters=THRUST_AS_THRUST)
    client.in_the_air()
    client.advance(1.0, every=client.hover)
    return client


# --- leaving the ground --------------------------------------------------------------------------------------------
def test_off_the_ground_2_7_seconds_after_arming_and_the_first_target() -> None:
    client = ArduPilotClient(parameters=THRUST_AS_THRUST)
    client.advance(2.0)
    client.command("DO_SET_MODE", 1, GUIDED)
    client.command("COMPONENT_ARM_DISARM", 1)
    start = client.autopilot.time_us
    while client.height_m < 0.02:
        client.attitude(0.48)
        client.advance(0.01)
    # 2 s arming delay, 0.5 s to idle, then the climb itself
    assert (client.autopilot.time_us - start) * 1e-6 == pytest.approx(2.7, abs=0.15)


def test_armed_without_a_target_it_disarms_after_ten_seconds() -> None:
    client = ArduPilotClient()
    client.advance(2.0)
    client.command("DO_SET_MODE", 1, GUIDED)
    client.command("COMPONENT_ARM_DISARM", 1)
    client.advance(9.8)
    assert client.autopilot.armed
    client.advance(0.4)
    assert not client.autopilot.armed
    assert client.texts()[-1] == "Disarming motors"


def test_hover_thrust_is_not_what_the_parameter_says(flying: ArduPilotClient) -> None:
    assert flying.autopilot.parameters["MOT_THST_HOVER"] == pytest.approx(0.39)
    # 3 kg · 9.80665 / (4 · 19.93 N), the capture's 0.369
    ratio = 3.0 * 9.80665 / (4 * 19.93)
    start, speed = flying.height_m, float(flying.autopilot.core.state[5])
    flying.advance(2.0, every=lambda: flying.attitude(ratio))
    assert flying.height_m - start == pytest.approx(-2.0 * speed, abs=0.02)


# --- GUIDED's rules ------------------------------------------------------------------------------------------------
def test_after_the_timeout_it_levels_and_holds_height_still_in_guided(flying: ArduPilotClient) -> None:
    flying.advance(0.5, every=lambda: flying.attitude(HOVER, ROLLED))
    tilted = flying.tilt_rad
    flying.advance(2.9)
    still_tilted = flying.tilt_rad
    flying.advance(2.0)
    height = flying.height_m
    flying.advance(3.0)
    assert tilted == pytest.approx(TILT, rel=0.05)
    assert still_tilted == pytest.approx(TILT, rel=0.05)
    assert flying.tilt_rad < 0.01
    assert flying.height_m == pytest.approx(height, abs=0.2)
    assert flying.last("HEARTBEAT").custom_mode == GUIDED


@pytest.mark.parametrize(
    ("mask", "quaternion"),
    [(64 | 7, None), (0b011, None), (0b100, None), (7, [1.0, 0.1, 0.0, 0.0])],
    ids=["throttle ignored", "yaw rate alone", "yaw rate missing", "quaternion off unit length"],
)
def test_what_is_not_well_formed_brakes_to_a_halt(
    flying: ArduPilotClient, mask: int, quaternion: list[float] | None
) -> None:
    flying.advance(1.5, every=lambda: flying.attitude(HOVER, ROLLED))
    assert float(np.linalg.norm(flying.autopilot.core.state[3:5])) > 1.5
    flying.attitude(0.6, quaternion, mask)
    height = flying.height_m
    flying.advance(6.0)
    assert float(np.linalg.norm(flying.autopilot.core.state[3:6])) < 0.1
    assert flying.height_m == pytest.approx(height, abs=0.7)
    assert flying.last("HEARTBEAT").base_mode == 217  # the position controller has it


def test_quaternion_within_a_thousandth_is_taken(flying: ArduPilotClient) -> None:
    long = [value * 1.0004 for value in ROLLED]
    flying.advance(0.8, every=lambda: flying.attitude(HOVER, long))
    assert flying.tilt_rad == pytest.approx(TILT, rel=0.05)


def test_mask_0_takes_body_rates_as_if_they_were_the_earths(flying: ArduPilotClient) -> None:
    """Facing east (yaw 90°) a body roll rate of 0.3 rad/s is rotated into a pitch rate: the trap of mask 0."""
    east = [math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)]
    flying.advance(6.0, every=lambda: flying.attitude(HOVER, east))
    core = flying.autopilot.core
    flying.attitude(HOVER, east, mask=0, rates=(0.3, 0.0, 0.0))
    flying.advance(0.3)
    target = core.memory[at.TARGET_RATES : at.TARGET_RATES + 3]
    assert target[1] == pytest.approx(0.3, abs=0.03)
    assert abs(target[0]) < 0.03


def test_body_rates_alone_turn_about_the_bodys_axes(flying: ArduPilotClient) -> None:
    flying.advance(0.3, every=lambda: flying.attitude(HOVER, mask=128, rates=(0.6, 0.0, 0.0)))
    assert float(flying.autopilot.core.state[10]) == pytest.approx(0.6, rel=0.1)
    assert flying.tilt_rad == pytest.approx(0.6 * 0.3, rel=0.2)


@pytest.mark.parametrize("boost", [0.0, 1.0])
def test_angle_boost_multiplies_thrust_by_one_over_the_cosine(flying: ArduPilotClient, boost: float) -> None:
    lean = 0.4
    q = [math.cos(lean / 2), math.sin(lean / 2), 0.0, 0.0]
    flying.autopilot.parameters.set("ATC_ANGLE_BOOST", boost)
    flying.autopilot.core.use_parameters(flying.autopilot.parameters)
    flying.advance(1.0, every=lambda: flying.attitude(HOVER, q))
    given = float(flying.autopilot.core.memory[at.THROTTLE_OUT])
    assert given == pytest.approx(HOVER / math.cos(lean) if boost else HOVER, rel=0.01)


def test_velocity_targets_stop_after_the_timeout() -> None:
    client = ArduPilotClient()
    client.in_the_air()
    client.advance(4.0, every=lambda: client.velocity(0.0, 1.0, 0.0))
    assert float(client.autopilot.core.state[4]) == pytest.approx(1.0, abs=0.1)
    client.advance(2.8)
    assert float(client.autopilot.core.state[4]) == pytest.approx(1.0, abs=0.1)
    client.advance(3.0)
    assert abs(float(client.autopilot.core.state[4])) < 0.1


def test_position_target_is_reached_as_by_the_same_build() -> None:
    """5 m north from a hover: the real one passed 2.87 m after 2.0 s and overshot to 5.24 m (real time, stock)."""
    client = ArduPilotClient()
    client.in_the_air()
    client.position(5.0, 0.0, -5.0)
    client.advance(2.0)
    passing = float(client.autopilot.core.state[0])
    furthest = 0.0
    for _ in range(40):
        client.advance(0.1)
        furthest = max(furthest, float(client.autopilot.core.state[0]))
    assert passing == pytest.approx(2.87, abs=0.25)
    assert furthest == pytest.approx(5.24, abs=0.15)
    client.advance(6.0)
    assert client.autopilot.core.state[:2] == pytest.approx([5.0, 0.0], abs=0.05)


# --- ways down -----------------------------------------------------------------------------------------------------
def test_land_comes_down_at_land_speed_and_disarms_two_seconds_after_touch_down(
    flying: ArduPilotClient,
) -> None:
    flying.command("DO_SET_MODE", 1, LAND)
    flying.advance(4.0)
    assert float(flying.autopilot.core.state[5]) == pytest.approx(0.5, abs=0.03)
    while flying.height_m > 0.005:
        flying.advance(0.02)
    touched = flying.autopilot.time_us
    while flying.autopilot.armed:
        flying.advance(0.02)
    assert (flying.autopilot.time_us - touched) * 1e-6 == pytest.approx(2.1, abs=0.4)
    assert any(text.startswith("SIM Hit ground at 0.") for text in flying.texts())


def test_a_landed_vehicle_held_off_its_place_gives_that_up(flying: ArduPilotClient) -> None:
    """The ground holds it, so the place goes to where it is, and the integral does not grow meanwhile."""
    flying.command("DO_SET_MODE", 1, LAND)
    while not flying.autopilot.land_detector.maybe:
        flying.advance(0.02)
    memory = flying.autopilot.core.memory
    integral = float(memory[at.VELOCITY_INTEGRAL])
    memory[at.DESIRED_POSITION] += 0.2
    flying.advance(0.16)
    assert memory[at.DESIRED_POSITION] == pytest.approx(0.2 * math.exp(-1.0), abs=0.02)
    flying.advance(0.4)
    assert abs(float(memory[at.VELOCITY_INTEGRAL]) - integral) < 1e-3
    flying.advance(1.5)
    assert not flying.autopilot.armed


def test_loiter_without_a_radio_comes_down_because_the_stick_is_down(flying: ArduPilotClient) -> None:
    """The capture fell 1.39 m in the first 1.4 s: a throttle at 1000 asks for PILOT_SPEED_UP downwards."""
    flying.command("DO_SET_MODE", 1, LOITER)
    start = flying.height_m
    flying.advance(1.4)
    assert start - flying.height_m == pytest.approx(1.39, abs=0.15)
    flying.autopilot.state.sticks.throttle = 0.5
    flying.advance(3.0)
    height = flying.height_m
    flying.advance(2.0)
    assert flying.height_m == pytest.approx(height, abs=0.05)


def test_brake_stops_whatever_the_stick(flying: ArduPilotClient) -> None:
    flying.advance(1.5, every=lambda: flying.attitude(HOVER, ROLLED))
    flying.command("DO_SET_MODE", 1, BRAKE)
    flying.advance(4.0)
    assert float(np.linalg.norm(flying.autopilot.core.state[3:6])) < 0.1


def test_return_climbs_goes_home_waits_and_lands() -> None:
    client = ArduPilotClient()
    client.in_the_air()
    client.position(6.0, 0.0, -5.0)
    client.advance(8.0)
    client.command("DO_SET_MODE", 1, RTL)
    highest = 0.0
    for _ in range(700):
        client.advance(0.1)
        highest = max(highest, client.height_m)
        if not client.autopilot.armed:
            break
    assert highest == pytest.approx(15.0, abs=0.3)  # RTL_ALT; 3 · 6 m of cone is higher
    assert not client.autopilot.armed
    assert np.linalg.norm(client.autopilot.core.state[:2]) < 0.3


# --- controllers ---------------------------------------------------------------------------------------------------
@given(error=st.floats(0.0, 50.0), p=st.floats(0.1, 10.0), limit=st.floats(0.1, 50.0))
@settings(max_examples=100, deadline=None)
def test_square_root_controller_and_its_inverse(error: float, p: float, limit: float) -> None:
    rate = sqrt_controller(error, p, limit, 1e-6)
    assert rate <= p * error + 1e-9
    assert rate * rate <= 2 * limit * error + 1e-9  # can be stopped in the way that is left
    assert inverse_sqrt_controller(rate, p, limit) == pytest.approx(error, rel=1e-9, abs=1e-12)


@given(st.tuples(*[st.floats(-1.8, 1.8)] * 3))
@settings(max_examples=60, deadline=None)
def test_rotation_vectors_there_and_back(v: tuple[float, float, float]) -> None:
    q = from_rotation_vector(v)
    if np.linalg.norm(v) < math.pi - 1e-6:
        assert to_rotation_vector(q) == pytest.approx(v, abs=1e-9)
    assert rotate(q, v) == pytest.approx(v, abs=1e-9)  # its own axis stays
    assert multiply(q, (q[0], -q[1], -q[2], -q[3])) == pytest.approx((1, 0, 0, 0), abs=1e-12)


def mixed(roll: float, pitch: float, yaw: float, throttle: float) -> tuple[np.ndarray, np.ndarray]:
    """Thrust of each motor of the capture's frame (0..1), and the memory, for one wish."""
    vehicle = load_vehicle("arducopter")
    parameters = fitted_parameters(vehicle)
    parameters.set("MOT_THST_EXPO", 0.0)
    memory = np.zeros(at.MEMORY_SIZE)
    memory[at.SPOOL_STATE] = at.STATE_UNLIMITED
    memory[at.THRUST_MAX] = 1.0
    memory[at.OUT_TORQUE : at.OUT_TORQUE + 3] = roll, pitch, yaw
    memory[at.THROTTLE] = memory[at.THROTTLE_AVERAGE_MAX] = throttle
    mix(motor_factors(vehicle), at.gains_from_parameters(parameters), memory, 0.0025)
    return memory[at.OUT_MOTORS : at.OUT_MOTORS + 4].copy(), memory


def test_plus_frame_mixes_by_hand() -> None:
    # motors: right, left (anticlockwise), front, rear (clockwise); factors ±0.5
    motors, _ = mixed(0.2, 0.1, 0.04, 0.4)
    expected = [0.4 - 0.1 + 0.02, 0.4 + 0.1 + 0.02, 0.4 + 0.05 - 0.02, 0.4 - 0.05 - 0.02]
    assert motors == pytest.approx(expected, abs=1e-12)


@given(*[st.floats(-1.0, 1.0)] * 3, st.floats(0.0, 1.0))
@settings(max_examples=200, deadline=None)
def test_motors_stay_in_range_and_saturation_is_told(
    roll: float, pitch: float, yaw: float, throttle: float
) -> None:
    motors, memory = mixed(roll, pitch, yaw, throttle)
    assert (motors >= 0).all() and (motors <= 1).all()
    factors = motor_factors(load_vehicle("arducopter"))
    for axis, wanted in enumerate((roll, pitch, yaw)):
        given_torque = float(motors @ factors[:, axis] / (factors[:, axis] @ factors[:, axis]))
        if memory[at.LIMIT_TORQUE + axis] == 0.0:
            assert given_torque == pytest.approx(wanted, abs=1e-9)
        else:
            assert abs(given_torque) <= abs(wanted) + 1e-9


def test_yaw_gives_way_before_roll_and_pitch() -> None:
    # roll takes the left motor to 0.4 + 0.3, so that yaw has (1 − 0.7) / 0.5 left there
    motors, memory = mixed(0.6, 0.0, 1.0, 0.4)
    factors = motor_factors(load_vehicle("arducopter"))
    assert memory[at.LIMIT_TORQUE + 2] == 1.0
    assert float(motors @ factors[:, 0]) / 0.5 == pytest.approx(0.6, abs=1e-9)
    assert float(motors @ factors[:, 2]) == pytest.approx(0.6, abs=1e-9)


def test_target_moves_with_the_acceleration_of_the_parameter() -> None:
    core = ArduPilotCore(load_vehicle("arducopter"), fitted_parameters(load_vehicle("arducopter")), "perfect")
    core.setpoint[at.SPOOL] = at.SPOOL_UNLIMITED
    core.setpoint[at.LATERAL] = at.LATERAL_RATES
    core.setpoint[at.RATES] = 3.0
    core.advance_to(100_000)
    # 40 steps of 2.5 ms at 110,000 centidegrees/s²
    assert core.target_rates[0] == pytest.approx(0.1 * math.radians(1100.0), rel=1e-9)


def test_other_vehicles_turn_alike() -> None:
    def time_to_63_percent(name: str) -> float:
        vehicle = load_vehicle(name)
        core = ArduPilotCore(vehicle, fitted_parameters(vehicle), "perfect")
        s = core.setpoint
        ratio = vehicle.mass_kg * vehicle.gravity_m_s2 / float(vehicle.max_thrust_newton.sum())
        s[at.SPOOL], s[at.LATERAL], s[at.THRUST] = at.SPOOL_UNLIMITED, at.LATERAL_QUATERNION, 1.1 * ratio
        s[at.THROTTLE_MIX] = 2.0
        core.advance_to(3_000_000)
        s[at.QUATERNION : at.QUATERNION + 4] = ROLLED
        start = core.time_us
        while float(core.state[7]) < math.sin(0.63 * TILT / 2):
            core.advance_to(core.time_us + 2500)
            assert core.time_us < start + 1_000_000
        return (core.time_us - start) * 1e-6

    reference = time_to_63_percent("arducopter")
    assert time_to_63_percent("px4_sih") == pytest.approx(reference, rel=0.3)


def test_the_same_seed_gives_the_same_bits() -> None:
    def fly(seed: int) -> bytes:
        autopilot = build_ardupilot(estimator="mocap", seed=seed, ready_after_s=1.0)
        autopilot.advance_to(2_000_000)
        autopilot.commander.request_mode(GUIDED)
        autopilot.commander.request_arm(False)
        autopilot.commander.request_take_off(3.0)
        autopilot.advance_to(8_000_000)
        return autopilot.core.state.tobytes()

    assert fly(3) == fly(3)
    assert fly(3) != fly(4)
