"""The named estimators: `mocap`, `gps`, `perfect`, and where each of their numbers comes from."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi, radians

from sitl_stub.physics.vehicle import VehicleError

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Channel:
    """Error of one measured vector: standard deviation per axis, and the corner above which it has no power left."""

    sd: Vector = (0.0, 0.0, 0.0)  # m, m/s, rad, rad/s or m/s²
    corner_rad_s: float = 10.0


@dataclass(frozen=True)
class EstimatorPreset:
    """Statistics of an estimator. The velocity error also contains the derivative of the position error, sd · corner."""

    name: str
    position: Channel = field(default_factory=Channel)  # NED
    velocity: Channel = field(default_factory=Channel)  # NED, on top of the derivative of the position error
    attitude: Channel = field(default_factory=Channel)  # small rotation about FRD axes
    gyro: Channel = field(default_factory=Channel)  # FRD, rotors stopped
    accelerometer: Channel = field(default_factory=Channel)  # FRD, rotors stopped
    gyro_sd_thrusting: Vector = (0.0, 0.0, 0.0)  # rad/s, rotors turning
    accelerometer_sd_thrusting: Vector = (0.0, 0.0, 0.0)  # m/s²
    gyro_bias_sd: float = 0.0  # rad/s, what the filter leaves of it
    accelerometer_bias_sd: float = 0.0  # m/s²
    bias_correlation_s: float = 100.0
    delay_s: float = 0.0  # of position, velocity and attitude
    drift_m_s2_per_sqrt_hz: float = 0.02  # dead reckoning: consumer-grade accelerometer and levelling error
    position_timeout_s: float = 5.0  # EKF2_NOAID_TOUT


PERFECT = EstimatorPreset("perfect", drift_m_s2_per_sqrt_hz=0.0)

# The report's laboratory. Position 2 mm, velocity 0.02 m/s, attitude 0.2°, delay 10 ms: from the project's brief. Position
# corner 10 rad/s, because the derivative of the position error is then exactly those 0.02 m/s and no further velocity
# error is needed. Attitude corner 5 rad/s: the optical heading and tilt pass a filter that trusts its gyro for
# some 0.2 s (EKF2 with EKF2_EVA_NOISE 0.1 rad is slower still). Gyro: 0.014 °/s/√Hz (BMI088 data sheet) through 40 Hz
# (IMU_GYRO_CUTOFF) is 0.0017 rad/s; 0.003 with propellers turning. Accelerometer: 175 µg/√Hz (BMI088) through 30 Hz
# (IMU_ACCEL_CUTOFF) is 0.012 m/s²; 0.1 with propellers turning. Biases: what the filter leaves of them.
MOCAP = EstimatorPreset(
    "mocap",
    position=Channel((0.002, 0.002, 0.002), 10.0),
    attitude=Channel((radians(0.2), radians(0.2), radians(0.2)), 5.0),
    gyro=Channel((0.0017, 0.0017, 0.0017), 2 * pi * 40),
    accelerometer=Channel((0.012, 0.012, 0.012), 2 * pi * 30),
    gyro_sd_thrusting=(0.003, 0.003, 0.003),
    accelerometer_sd_thrusting=(0.1, 0.1, 0.1),
    gyro_bias_sd=0.0005,
    accelerometer_bias_sd=0.02,
    delay_s=0.010,
)

# PX4 1.17's own simulator SIH with its default GPS estimator, fitted to px4_sih_qball2.tlog.gz (35–140 s, airborne).
# The capture has no true state, but GPS_RAW_INT is the true position and velocity plus noise that is white from one
# fix to the next: the autocovariance of (LOCAL_POSITION_NED − GPS) at lags of 0.125 s and more is that of the
# estimate's error alone. Found: position 0.11 / 0.19 / 0.18 m, falling to 0.73 and 0.38 of the variance after 2 and 4
# s, which is (1 + ωt) e^(−ωt) with ω = 0.5; velocity 0.13 / 0.26 m/s with ω = 0.65 (in all, so the position's
# derivative is taken off). Other flights gave a position of 0.06–0.16 m; 0.09 / 0.16 / 0.16 is within both. Down
# velocity: between the other two, as SIH's accelerometer noise is. Tilt: horizontal acceleration of GPS_RAW_INT.vel
# over 2 s against that of ATTITUDE, 0.9° with ω = 0.6; yaw: 0.3°, the EKF's heading is the steadiest axis (SIH's yaw
# gyro noise is the least). Gyro: the spectrum of ATTITUDE.rollspeed above 8 Hz, where the vehicle no longer moves, is
# flat and falls as 1/(1 + (f/35 Hz)²)²; sd 0.076 / 0.037 / 0.015 rad/s airborne, 0.0055 on the ground. Accelerometer:
# HIGHRES_IMU is white to its 50 Hz, sd 0.36 / 1.25 / 1.0 m/s² airborne, 0.07 on the ground; the corner of 71 Hz gives
# the measured density of 0.048 m/s²/√Hz on x. tests/unit/test_physics_capture.py does it again.
GPS = EstimatorPreset(
    "gps",
    position=Channel((0.09, 0.16, 0.16), 0.5),
    velocity=Channel((0.11, 0.23, 0.18), 0.65),
    attitude=Channel((radians(0.9), radians(0.9), radians(0.3)), 0.6),
    gyro=Channel((0.0055, 0.0055, 0.0055), 2 * pi * 35),
    accelerometer=Channel((0.07, 0.07, 0.07), 2 * pi * 71),
    gyro_sd_thrusting=(0.076, 0.037, 0.015),
    accelerometer_sd_thrusting=(0.36, 1.25, 1.0),
    gyro_bias_sd=0.0005,
    accelerometer_bias_sd=0.02,
    delay_s=0.005,
)

PRESETS = {preset.name: preset for preset in (MOCAP, GPS, PERFECT)}


def load_preset(name: str) -> EstimatorPreset:
    """The preset of that name. Raises `VehicleError` with the names there are."""
    if name not in PRESETS:
        raise VehicleError(f"unknown estimator preset {name!r}: choose from {', '.join(sorted(PRESETS))}")
    return PRESETS[name]
