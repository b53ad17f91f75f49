"""The `gps` preset and the `px4_sih` vehicle against what the PX4 capture shows (figures kept as a fixture)."""

from __future__ import annotations

import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import welch

from sitl_stub.physics.estimator import Estimator, advance_estimate
from sitl_stub.physics.presets import PRESETS
from sitl_stub.physics.rigid_body import advance
from sitl_stub.physics.vehicle import (
    BODY_RATE_FRD,
    ROTOR_SIGNALS,
    ROTOR_THRUSTS,
    calm_environment,
    initial_state,
    load_vehicle,
)

FIXTURE = json.loads((Path(__file__).parent / "fixtures" / "px4_capture_noise.json").read_text())
CAPTURE = Path(__file__).resolve().parents[3] / "shared" / "captures" / "px4_sih_qball2.tlog.gz"
EARTH_RADIUS = 6371000.0
FROM, TO = 35.0, 140.0  # s since boot


def _messages(folder):
    """Rows of the capture by message: time in s, then the numbers wanted."""
    from pymavlink import mavutil

    path = folder / "capture.tlog"
    path.write_bytes(gzip.decompress(CAPTURE.read_bytes()))
    wanted = {
        "GPS_RAW_INT": lambda m: (m.time_usec * 1e-6, m.lat, m.lon, m.alt, m.vel, m.cog),
        "LOCAL_POSITION_NED": lambda m: (m.time_boot_ms * 1e-3, m.x, m.y, m.z, m.vx, m.vy, m.vz),
        "ATTITUDE": lambda m: (m.time_boot_ms * 1e-3, m.rollspeed, m.pitchspeed, m.yawspeed),
        "HIGHRES_IMU": lambda m: (m.time_usec * 1e-6, m.xacc, m.yacc, m.zacc),
        "SERVO_OUTPUT_RAW": lambda m: (
            m.time_usec * 1e-6,
            m.servo1_raw,
            m.servo2_raw,
            m.servo3_raw,
            m.servo4_raw,
        ),
        "GPS_GLOBAL_ORIGIN": lambda m: (0.0, m.latitude, m.longitude, m.altitude),
    }
    rows = {name: [] for name in wanted}
    log = mavutil.mavlink_connection(str(path))
    while (message := log.recv_match(type=list(wanted))) is not None:
        if message.get_srcSystem() == 1:
            rows[message.get_type()].append(wanted[message.get_type()](message))
    log.close()
    return {name: np.array(values) for name, values in rows.items()}


def measured_noise(rows):
    """Errors of the capture's estimate, found without a true state.

    Position, velocity: GPS is the truth plus white noise, so estimate less GPS, multiplied with itself one fix later,
    leaves the estimate's own error. Gyro and accelerometer: what changes from sample to sample while airborne.
    """
    gps, local = rows["GPS_RAW_INT"], rows["LOCAL_POSITION_NED"]
    origin = rows["GPS_GLOBAL_ORIGIN"][0]
    time = gps[:, 0]
    north = np.radians((gps[:, 1] - origin[1]) * 1e-7) * EARTH_RADIUS
    east = (
        np.radians((gps[:, 2] - origin[2]) * 1e-7) * EARTH_RADIUS * math.cos(math.radians(origin[1] * 1e-7))
    )
    position = np.column_stack([north, east, -(gps[:, 3] - origin[3]) * 1e-3])
    course = np.radians(gps[:, 5] * 0.01)
    velocity = np.column_stack([np.cos(course), np.sin(course)]) * gps[:, 4:5] * 0.01
    airborne = (time > FROM) & (time < TO)

    def own_error(column, reference):
        error = (np.interp(time, local[:, 0], local[:, column]) - reference)[airborne]
        error -= error.mean()
        return math.sqrt(abs(np.mean(error[1:] * error[:-1])))

    rates, forces = _airborne(rows["ATTITUDE"]), _airborne(rows["HIGHRES_IMU"])
    grid = np.arange(rates[0, 0], rates[-1, 0], 1 / 125)
    frequency, power = welch(_on(grid, rates), 125.0, nperseg=1024, axis=0)

    def density(low, high):
        return np.sqrt(power[(frequency >= low) & (frequency < high)].mean(axis=0)).tolist()

    return {
        "position_sd_m": [own_error(1 + k, position[:, k]) for k in range(3)],
        "velocity_sd_m_s": [own_error(4 + k, velocity[:, k]) for k in range(2)],
        "gyro_sd_rad_s": (np.diff(rates[:, 1:], axis=0).std(axis=0) / math.sqrt(2)).tolist(),
        "accelerometer_sd_m_s2": (np.diff(forces[:, 1:], axis=0).std(axis=0) / math.sqrt(2)).tolist(),
        "gyro_density_8_to_16_hz": density(8, 16),
        "gyro_density_35_to_50_hz": density(35, 50),
    }


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    if not CAPTURE.exists():
        pytest.skip("the captures are not on this machine")
    return _messages(tmp_path_factory.mktemp("capture"))


def test_the_motors_of_the_capture_turn_our_vehicle_as_they_turned_px4s(capture):
    """SERVO_OUTPUT_RAW through our rotors, lag and geometry gives the capture's own turning and lift.

    Motor signals were logged at 20 Hz only and are noisy in roll and pitch (SIH's gyro noise goes through the rate loop),
    so those two show sign and size; yaw, all but free of noise, is good to a few per cent.
    """
    vehicle, dt = load_vehicle("px4_sih"), 0.004
    servo, rates, imu = (_airborne(capture[name]) for name in ("SERVO_OUTPUT_RAW", "ATTITUDE", "HIGHRES_IMU"))
    time = np.arange(servo[0, 0], servo[-1, 0], dt)
    signals = _on(time, servo) / 1000.0 - 1.0  # 1000 µs stopped, 2000 µs full
    rate, force = _on(time, rates), _on(time, imu)
    state, p, environment = (
        initial_state(vehicle, (0.0, 0.0, -1e6)),
        vehicle.packed(),
        calm_environment(vehicle),
    )
    state[ROTOR_SIGNALS][:4] = signals[0]
    thrusts = np.empty((time.size, 4))
    for row, command in zip(thrusts, signals, strict=True):
        advance(state, command, p, environment, dt, 1)
        row[:] = state[ROTOR_THRUSTS][:4]
    wrench = thrusts @ vehicle.allocation_frd().T
    turning = (
        np.cumsum((wrench[:, 1:] - vehicle.angular_drag_kg_m2_s * rate) / vehicle.inertia_kg_m2, axis=0) * dt
    )
    window = 100  # 0.4 s
    expected, seen = turning[window:] - turning[:-window], rate[window:] - rate[:-window]
    agreement = [np.corrcoef(expected[:, k], seen[:, k])[0, 1] for k in range(3)]
    size = (expected * seen).sum(axis=0) / (seen * seen).sum(
        axis=0
    )  # noise is in `expected`: regress it on `seen`
    assert agreement[2] > 0.99 and min(agreement[:2]) > 0.2
    assert size[2] == pytest.approx(1.0, abs=0.03)
    assert (size[:2] > 0.65).all() and (size[:2] < 1.1).all()
    box = np.ones(125) / 125  # half a second
    lift, felt = (np.convolve(x, box, "valid") for x in (-wrench[:, 0] / vehicle.mass_kg, force[:, 2]))
    assert lift.mean() == pytest.approx(felt.mean(), rel=0.005)
    assert np.polyfit(lift, felt, 1)[0] == pytest.approx(1.0, abs=0.05)


def _airborne(rows):
    return rows[(rows[:, 0] > FROM) & (rows[:, 0] < TO)]


def _on(time, rows):
    return np.column_stack([np.interp(time, rows[:, 0], rows[:, k]) for k in range(1, rows.shape[1])])


def test_the_fixture_is_what_the_capture_says(capture):
    for name, values in measured_noise(capture).items():
        np.testing.assert_allclose(values, FIXTURE[name], rtol=0.02, err_msg=name)


def test_the_gps_preset_errs_as_the_capture_does():
    """Slow errors are known to a third from a hundred seconds of flight; fast ones to a few per cent."""
    preset = PRESETS["gps"]
    np.testing.assert_allclose(preset.position.sd, FIXTURE["position_sd_m"], rtol=0.33)
    velocity = np.hypot(np.array(preset.position.sd) * preset.position.corner_rad_s, preset.velocity.sd)
    np.testing.assert_allclose(velocity[:2], FIXTURE["velocity_sd_m_s"], rtol=0.33)
    np.testing.assert_allclose(preset.accelerometer_sd_thrusting, FIXTURE["accelerometer_sd_m_s2"], rtol=0.1)


def test_the_gps_presets_gyro_has_the_captures_spectrum():
    vehicle = load_vehicle("px4_sih")
    state = initial_state(vehicle)
    state[ROTOR_SIGNALS][:4] = 0.5
    estimator = Estimator("gps", seed=2)
    rates = np.empty((60_000, 3))
    for row in rates:
        advance_estimate(*estimator.arguments, state)
        row[:] = estimator.estimate.array[BODY_RATE_FRD]
    frequency, power = welch(rates, 250.0, nperseg=2048, axis=0)
    for name, low, high in (("gyro_density_8_to_16_hz", 8, 16), ("gyro_density_35_to_50_hz", 35, 50)):
        seen = np.sqrt(power[(frequency >= low) & (frequency < high)].mean(axis=0))
        # the capture was read at uneven times, which costs its upper band some power
        np.testing.assert_allclose(seen, FIXTURE[name], rtol=0.25, err_msg=name)
