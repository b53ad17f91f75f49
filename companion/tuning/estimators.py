"""Estimators to tune against beside the stub's own presets: measured on flights of autopilots that are not the stub."""

from __future__ import annotations

from math import pi

from sitl_stub.physics.presets import PRESETS, Channel, EstimatorPreset

# PX4 1.17's own simulator with motion capture fed back as ODOMETRY: estimate − true state over 40 s of the
# lemniscate in three flights, sd on each axis and the time to 1/e of its autocovariance (0.5–0.7 s in position and
# velocity, 1.5–3.5 s in tilt). Velocity errs by more than the derivative of the position's error (correlation 0.1–0.3):
# its corner is therefore lower than its autocovariance says, so that velocity's own error has its measured size.
# What it adds to the IMU while thrusting (gyro, accelerometer: as in the preset gps) makes the roll axis wander,
# and with it the east velocity.
SIH_MOCAP = EstimatorPreset(
    "sih_mocap",
    position=Channel((0.0105, 0.031, 0.019), 1.0),
    velocity=Channel((0.025, 0.079, 0.046), 4.3),
    attitude=Channel((0.0131, 0.005, 0.0028), 0.8),
    gyro=Channel((0.0055, 0.0055, 0.0055), 2 * pi * 35),
    gyro_sd_thrusting=(0.076, 0.037, 0.015),
    accelerometer_sd_thrusting=(0.36, 1.25, 1.0),
    gyro_bias_sd=0.0005,
    delay_s=0.005,
)

ESTIMATORS = {**PRESETS, SIH_MOCAP.name: SIH_MOCAP}
"""What `companion tune --estimator` knows."""
