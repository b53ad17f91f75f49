"""Fuzz targets that are files and words of the user: configuration, trajectories, logs, and the stub's scenarios.

Whatever is in them, the only thing raised is `UserError` (of the stub `FaultError`), and what is accepted can be flown.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

MOST_FAULTS = 20  # of an input that are made to happen


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
            log.record(state, 0.01 * k, np.arange(14.0))
            log.record(weights, 0.01 * k, np.zeros((2, 3)))
            log.mavlink("in", 0.01 * k, b"\xfd\x01" + bytes(8))
        log.event("phase", 0.02, phase="track")
    data = path.read_bytes()
    return [data, data[: len(data) // 2], data[:-9], data[:40]]


def scenarios() -> Callable[[bytes], None]:
    """A scenario's TOML; first byte: odd for ArduPilot. What is accepted happens, all at once, as it boots."""
    from sitl_stub.faults.director import FaultDirector
    from sitl_stub.faults.fault import FaultError
    from sitl_stub.faults.scenario import Target, read_scenario
    from sitl_stub.firmware.ardupilot.build import build_ardupilot
    from sitl_stub.firmware.px4.build import build_px4
    from sitl_stub.mavlink.links import MemoryLink
    from sitl_stub.physics.vehicle import load_vehicle

    folder = Path(tempfile.mkdtemp())
    vehicle = load_vehicle("qball2")
    builds = {"px4": build_px4, "ardupilot": build_ardupilot}

    def take(data: bytes) -> None:
        firmware = "ardupilot" if data[:1] and data[0] & 1 else "px4"
        try:
            scenario = read_scenario(_file(folder, "faults.toml", data[1:]), Target(firmware, vehicle))
        except FaultError as error:
            assert error.problems and all(error.problems)
            return
        autopilot, link = builds[firmware](vehicle=vehicle), MemoryLink()
        autopilot.attach(link)
        now = [replace(entry, after="start", at_s=0.0) for entry in scenario.entries[:MOST_FAULTS]]
        director = FaultDirector(autopilot, replace(scenario, entries=tuple(now)))
        autopilot.advance_to(100_000)
        director.clear()
        autopilot.advance_to(autopilot.time_us + 20_000)
        assert np.isfinite(autopilot.core.state).all(), "the vehicle's true state is not finite"

    return take


def scenario_seeds() -> list[bytes]:
    """Every kind of fault with its defaults and with the ends of its ranges, alone and all in one."""
    from sitl_stub.faults.registry import KINDS, toml_value

    seeds = []
    for name, kind in KINDS.items():
        head = f'[[fault]]\nkind = "{name}"\nat_s = 0.0\n'
        plain = head + "".join(f"{key} = {toml_value(value)}\n" for key, value in kind.defaults().items())
        ends = {key: (facts.least, facts.most) for key, facts in kind.parameters().items()}
        extreme = [
            head + "".join(f"{key} = {pair[end]:g}\n" for key, pair in ends.items() if pair != (0.0, 0.0))
            for end in (0, 1)
        ]
        lasting = "" if kind.momentary else "for_s = 0.05\n"
        seeds += [text.encode() for text in (plain + lasting, *extreme)]
    top = b"seed = 7\nannounce = true\n\n"
    seeds.append(top + b"\n".join(seeds[:12:3]))
    return [bytes((firmware,)) + seed for seed in seeds for firmware in (0, 1)]
