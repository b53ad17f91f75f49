"""A flight that was never flown, with errors known in closed form: what the analysis has to find.

Reference at 125 Hz, truth at 100 Hz and never at the same moments. The vehicle lags the lemniscate of
control_laws.md section 7 by e_p = (A sin 2πt/5, B cos 2πt/10, C) and stays e_η behind the wanted attitude.
Over whole periods the RMS are A/√2, B/√2, C.
"""

import numpy as np

from companion.control.packing import TERMS
from companion.flightlog.channels import (
    REFERENCE,
    SETPOINT,
    STATE,
    TIMING,
    TRUTH,
    packed_channel,
    weights_channel,
)
from companion.flightlog.writer import FlightLog

BOOT_S = 12.5  # autopilot time when the log begins
TRACK_FROM_S = BOOT_S + 5.0
UTC_OFFSET_NS = 1_700_000_000_000_000_000
ERROR_M = np.array([0.05, 0.03, 0.02])
ATTITUDE_ERROR_RAD = np.radians([1.0, -2.0, 0.5])
ESTIMATE_OFF_M = np.array([0.001, -0.002, 0.004])


def lemniscate(t):
    """Position, velocity (3,) at t seconds of tracking; held at its start before."""
    t = max(t, 0.0)
    a, b = 2 * np.pi / 4, 2 * np.pi / 8
    moving = 1.0 if t > 0 else 0.0
    position = np.array([0.5 * np.sin(a * t), np.cos(b * t), 1.0])
    return position, moving * np.array([0.5 * a * np.cos(a * t), -b * np.sin(b * t), 0.0])


def position_error(t):
    return ERROR_M * np.array([np.sin(2 * np.pi * t / 5), np.cos(2 * np.pi * t / 10), 1.0])


def wanted_euler(t):
    return np.array([0.1 * np.sin(t), 0.08 * np.cos(0.7 * t), 0.3])


def quaternion(euler):
    half = 0.5 * np.asarray(euler)
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def write(
    path, *, seconds=20.0, controller="dtlannc", seed=1, truth=True, track=True, level="attitude", scale=1.0
):
    """Write the flight's log to `path`; `scale` stretches the position error."""
    facts = {
        "controller": controller,
        "level": level,
        "firmware": "px4",
        "trajectory": "lemniscate",
        "mass_ratio": "0.7",
        "seed": str(seed),
    }
    rng = np.random.default_rng(seed)
    with FlightLog(
        path,
        facts,
        {"settings.toml": "[law]\nN = 2.0\n", "profile.toml": "mass_kg = 1.79\n"},
        utc_offset_ns=UTC_OFFSET_NS,
    ) as log:
        state, reference, setpoint = log.define(STATE), log.define(REFERENCE), log.define(SETPOINT)
        timing = log.define(TIMING)
        terms = log.define(packed_channel("/terms", TERMS))
        weights = log.define(weights_channel("position", 6))
        true_state = log.define(TRUTH) if truth else None
        log.metadata("versions", {"companion": "0.1.0", "python": "3.11"})
        log.metadata("wall", {"started": str(rng.integers(1 << 40))})
        log.event("phase", BOOT_S, phase="take off")
        log.event("phase", BOOT_S + 3.0, phase="hold")
        log.event("mode", BOOT_S + 0.5, mode="OFFBOARD")
        packed = np.zeros((), TERMS)[()]
        end = TRACK_FROM_S + (seconds if track else 0.0)

        def flown(time, off):
            t = time - TRACK_FROM_S
            position, velocity = lemniscate(t)
            if time < BOOT_S + 3.0:
                position = position * [1, 1, (time - BOOT_S) / 3.0]
            euler = wanted_euler(t) - ATTITUDE_ERROR_RAD
            return np.concatenate(
                (position - scale * position_error(t) + off, velocity, quaternion(euler), np.zeros(3))
            )

        for time in np.arange(BOOT_S, end, 0.008):
            t = time - TRACK_FROM_S
            tracking = track and t >= 0
            position, velocity = lemniscate(t)
            log.record(state, time, flown(time, ESTIMATE_OFF_M), 0.01)
            motion = np.concatenate((position, velocity, np.zeros(9)))
            log.record(reference, time, motion, 0.3, 0.0, 0.0, t if tracking else np.nan)
            log.record(
                setpoint,
                time,
                0.0,
                17.5 + np.sin(t),
                0.5,
                quaternion(wanted_euler(t)),
                np.zeros(3),
                np.zeros(3),
            )
            packed["euler_desired"] = wanted_euler(t)
            packed["position"]["proportional_term"] = np.sin([t, 2 * t, 3 * t])
            packed["position"]["network_term"] = np.cos([t, 2 * t, 3 * t]) * 0.5
            packed["position"]["weight_norm"] = 1 - np.exp(-0.2 * (time - BOOT_S))
            packed["attitude"]["weight_norm"] = 0.2 * (1 - np.exp(-0.4 * (time - BOOT_S)))
            packed["position"]["lyapunov"] = abs(np.sin(t)) * 0.01
            packed["attitude"]["lyapunov"] = abs(np.cos(t)) * 0.001
            log.record(terms, time, packed.copy())
            log.record(weights, time, np.full((6, 3), t))
            log.record(timing, time, 0.008 + 1e-4 * rng.random(), 3e-4 + 1e-4 * rng.random(), 5e-6, 3.0)
            log.mavlink("in", time, b"\xfd\x01" + bytes(8))
        if track:
            log.event("layout", BOOT_S, heading_rad=0.0, origin_enu=[0.0, 0.0, 0.0])
            log.event("phase", TRACK_FROM_S, phase="track")
        if true_state is not None:
            for time in np.arange(BOOT_S + 0.0013, end, 0.01):
                log.record(true_state, time, flown(time, 0.0))
        log.event("phase", end, phase="land")
        log.event("ended", end + 0.5, outcome="completed", wall_seconds=rng.random())
        log.mavlink("out", end + 0.5, b"\xfd\x02" + bytes(8))
    return path
