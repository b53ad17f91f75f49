"""Fuzz targets that are files and words of the user: configuration, trajectories, logs.

Whatever is in them, the only thing raised is `UserError`, and what is accepted can be flown.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np


def _file(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def configuration() -> Callable[[bytes], None]:
    """A profile's TOML, or (first byte odd) lines of --set."""
    from companion.config.errors import UserError
    from companion.config.load import known_keys, shipped_profiles
    from companion.config.profile import VehicleProfile
    from companion.config.settings import load_settings

    folder = Path(tempfile.mkdtemp())
    assert known_keys(VehicleProfile, {}) and shipped_profiles()

    def take(data: bytes) -> None:
        try:
            if data[:1] == b"\1":
                words = data[1:].decode("utf-8", "surrogateescape").split("\n")[:8]
                settings = load_settings("qball2", {}, words)
            else:
                settings = load_settings(str(_file(folder, "profile.toml", data[1:])), {})
        except UserError as error:
            assert str(error)
            return
        assert np.isfinite(settings.flight.rate_hz) and settings.profile.mass_kg > 0.0
        settings.as_tables()

    return take


def configuration_seeds() -> list[bytes]:
    """The shipped profiles, and overrides of every kind."""
    from companion.config.load import find_profile, known_keys, shipped_profiles
    from companion.config.settings import FlightSettings

    profiles = [b"\0" + find_profile(name).read_bytes() for name in shipped_profiles()]
    keys = [f"flight.{key}" for key in known_keys(FlightSettings, {})]
    values = ("1", "-1.5", "nan", "inf", "1e400", '"x"', "true", "[1, 2, 3]", "{ a = 1 }", "1979-05-27", "")
    words = [f"{key}={values[index % len(values)]}" for index, key in enumerate(keys)]
    words += ["gains.position_loop.K_U=[2, 2, 12]", "profile.mass_kg=1.2", "=", "a.b.c=1", "profile.name.x=1"]
    return profiles + [b"\1" + word.encode() for word in words]


def trajectories() -> Callable[[bytes], None]:
    """First byte: 0 sampled CSV, 1 waypoints in CSV, 2 waypoints in TOML, 3 the word given to --trajectory."""
    from companion.config.errors import UserError
    from companion.reference.csv_file import csv_trajectory
    from companion.reference.minimum_snap import waypoint_trajectory
    from companion.reference.registry import trajectory_from_text

    folder = Path(tempfile.mkdtemp())

    def take(data: bytes) -> None:
        kind, body = (data[0] if data else 0) % 4, data[1:]
        try:
            if kind == 0:
                found = csv_trajectory(_file(folder, "a.csv", body))
            elif kind == 1:
                found = waypoint_trajectory(_file(folder, "w.csv", body))
            elif kind == 2:
                found = waypoint_trajectory(_file(folder, "w.toml", body))
            else:
                found = trajectory_from_text(body.decode("utf-8", "surrogateescape"))
        except UserError as error:
            assert str(error)
            return
        duration = found.duration_s
        for time_s in (0.0, 0.37, min(duration, 1e6) / 2, min(duration, 1e6), min(duration, 1e6) + 1.0):
            sample = found.sample(time_s)
            assert np.isfinite(sample.position_enu).all() and np.isfinite(sample.yaw_rad), f"{sample}"

    return take


def trajectory_seeds() -> list[bytes]:
    """Good files of each kind, and every name of the catalogue."""
    rows = "\n".join(f"{0.1 * k:.1f},{0.05 * k},{0.02 * k * k:.3f},1.0,{3 * k}" for k in range(12))
    points = "0,0,1,0\n1,0,1,90\n1,1,1.5,180\n0,1,1,270"
    toml = "[limits]\nspeed_m_s = 1.5\n" + "".join(
        f"[[waypoint]]\nposition = [{x}.0, {y}.0, 1.0]\nyaw_deg = {90 * x}.0\n"
        for x, y in ((0, 0), (1, 0), (1, 1))
    )
    words = (
        "lemniscate,scale=0.5",
        "hover",
        "circle,radius_m=1,speed_m_s=1",
        "step",
        "circle,radius=nan",
        "csv:",
    )
    files = [
        b"\0t,x,y,z,yaw_deg\n" + rows.encode(),
        b"\0t,x,y,z,vx,vy,vz\n" + "\n".join(f"{k},{k},0,1,1,0,0" for k in range(6)).encode(),
        b"\1x,y,z,yaw_deg\n" + points.encode(),
        b"\1t,x,y,z\n0,0,0,1\n2,1,0,1\n5,1,1,1",
        b"\2" + toml.encode(),
    ]
    return files + [b"\3" + word.encode() for word in words]


def logs() -> Callable[[bytes], None]:
    """A log's bytes: read, read raw, recovered, and the recovered one read to the same end."""
    from companion.analysis.metrics import flight_metrics
    from companion.config.errors import UserError
    from companion.flightlog.reader import read_log
    from companion.flightlog.recovery import recover

    folder = Path(tempfile.mkdtemp())

    def take(data: bytes) -> None:
        path, whole = _file(folder, "a.mcap", data), folder / "b.mcap"
        whole.unlink(missing_ok=True)
        try:
            record = read_log(path)
            saved = recover(path, whole)
        except UserError as error:
            assert str(error)
            return
        again = read_log(whole)
        assert again.cut == "", again.cut
        assert saved.messages >= sum(len(channel) for channel in record.channels.values())
        try:
            flight_metrics(record)
        except UserError as error:
            assert str(error)

    return take


def log_seeds() -> list[bytes]:
    """Tiny logs: whole, cut, and with every kind of record."""
    from companion.flightlog.channels import STATE, weights_channel
    from companion.flightlog.writer import FlightLog

    path = Path(tempfile.mkdtemp()) / "seed.mcap"
    with FlightLog(path, {"seed": "1"}, {"settings.json": "{}"}, channels=[STATE], utc_offset_ns=0) as log:
        state, weights = log.define(STATE), log.define(weights_channel("position", 2))
        for k in range(4):
            log.record(state, 0.01 * k, np.arange(15.0))
            log.record(weights, 0.01 * k, np.zeros((2, 3)))
            log.mavlink("in", 0.01 * k, b"\xfd\x01" + bytes(8))
        log.event("phase", 0.02, phase="track")
    data = path.read_bytes()
    return [data, data[: len(data) // 2], data[:-9], data[:40]]
