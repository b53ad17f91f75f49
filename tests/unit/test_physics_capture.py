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
from sitl_stub.physics.vehicle import BODY_RATE_FRD, ROTOR_SIGNALS, initial_state, load_vehicle

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

    def airborne_rows(name):
        return rows[name][(rows[name][:, 0] > FROM) & (rows[name][:, 0] < TO)]

    rates, forces = airborne_rows("ATTITUDE"), airborne_rows("HIGHRES_IMU")
    grid = np.arange(rates[0, 0], rates[-1, 0], 1 / 125)
    even = np.column_stack([np.interp(grid, rates[:, 0], rates[:, k]) for k in (1, 2, 3)])
    frequency, power = welch(even, 125.0, nperseg=1024, axis=0)

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


@pytest.mark.skipif(not CAPTURE.exists(), reason="the captures are not on this machine")
def test_the_fixture_is_what_the_capture_says(tmp_path):
    for name, values in measured_noise(_messages(tmp_path)).items():
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
