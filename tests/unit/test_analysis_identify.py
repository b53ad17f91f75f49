"""Identification against responses integrated here, by another method than the one under test."""

import json

import numpy as np
import pytest

from companion.analysis.identify import first_order, identify, profile_lines, second_order
from companion.cli.main import main
from companion.config.errors import UserError
from companion.flightlog.channels import SETPOINT, STATE
from companion.flightlog.reader import read_log
from companion.flightlog.writer import FlightLog
from tests.unit.synthetic_flight import quaternion

FINE = 0.001


def asked_angle(t):
    """Roll and pitch setpoints with corners and sines: rich in frequencies. Yaw stands still."""
    roll = 0.15 * np.sign(np.sin(1.3 * t)) + 0.05 * np.sin(5.0 * t)
    pitch = 0.1 * np.sign(np.sin(0.9 * t + 1.0)) + 0.04 * np.sin(4.0 * t)
    return np.stack([roll, pitch, np.full_like(t, 0.4)], axis=-1)


def respond(command, dead_s, derivative, order):
    """Integrate ẋ = derivative(x, command(t − dead)) by fine Euler steps; order 1 or 2."""
    shift = round(dead_s / FINE)
    late = np.vstack([np.repeat(command[:1], shift, axis=0), command])[: len(command)]
    x, v = command[0].copy(), np.zeros(3)
    out = np.empty_like(command)
    for k, wanted in enumerate(late):
        out[k] = x
        if order == 2:
            v = v + FINE * derivative(x, v, wanted)
            x = x + FINE * v
        else:
            x = x + FINE * derivative(x, v, wanted)
    return out


def write_flight(path, level, asked, was, fine_s, noise, seed=3):
    """A log at 100 Hz of setpoints and states."""
    random = np.random.default_rng(seed)
    with FlightLog(path, metadata={"level": level, "firmware": "PX4 1.17.0"}) as log:
        setpoints, states = log.define(SETPOINT), log.define(STATE)
        log.event("phase", float(fine_s[0]), phase="climb")
        for k in range(0, len(fine_s), round(0.01 / FINE)):
            t = float(fine_s[k])
            measured = was[k] + random.normal(0.0, noise, 3)
            if level == "attitude":
                q, rate, q_state, rate_state = (
                    quaternion(asked[k]),
                    np.zeros(3),
                    quaternion(measured),
                    np.zeros(3),
                )
            else:
                q, rate, q_state, rate_state = (
                    quaternion(np.zeros(3)),
                    asked[k],
                    quaternion(np.zeros(3)),
                    measured,
                )
            log.record(setpoints, t, 0.0, 10.0, 0.4, q, rate, np.zeros(3))
            log.record(states, t, np.zeros(3), np.zeros(3), q_state, rate_state, 0.0)
    return path


@pytest.mark.parametrize(("dead", "omega", "zeta"), [(0.05, 9.0, 0.65), (0.03, 13.0, 0.95)])
def test_finds_dead_time_frequency_and_damping(tmp_path, dead, omega, zeta):
    t = np.arange(0.0, 12.0, FINE)
    asked = asked_angle(t)
    was = respond(asked, dead, lambda x, v, c: omega**2 * (c - x) - 2 * zeta * omega * v, 2)
    record = read_log(write_flight(tmp_path / "f.mcap", "attitude", asked, was, t, noise=0.003))
    found = identify(record)
    assert [r.axis for r in found] == ["roll", "pitch"]  # yaw did not move
    for r in found:
        # a logged setpoint is held for 10 ms, half of which the fit sees as dead time
        assert r.dead_time_s == pytest.approx(dead, abs=0.010)
        assert r.natural_frequency_rad_s == pytest.approx(omega, rel=0.08)
        assert r.damping == pytest.approx(zeta, rel=0.08)
        assert r.lag_s == pytest.approx(dead + 2 * zeta / omega, rel=0.05)
        assert r.explained > 0.98
    assert "tilt = {" in profile_lines(found, "px4")


def test_finds_the_lag_of_a_rate_loop(tmp_path):
    t = np.arange(0.0, 12.0, FINE)
    asked = 3.0 * asked_angle(t)
    was = respond(asked, 0.02, lambda x, v, c: (c - x) / 0.08, 1)
    found = identify(read_log(write_flight(tmp_path / "f.mcap", "body_rate", asked, was, t, noise=0.02)))
    for r in found[:2]:
        assert 1.0 / r.natural_frequency_rad_s == pytest.approx(0.08, rel=0.1)
        assert r.dead_time_s == pytest.approx(0.02, abs=0.01)


def test_step_response_of_the_models_is_the_textbooks():
    """ζ = 1: 1 − e^{−ωt}(1 + ωt); first order: 1 − e^{−t/T}. Both from dead time on."""
    dt = 0.004
    t = np.arange(0.0, 2.0, dt)
    command = np.ones_like(t)
    late = np.maximum(t - 0.0, 0.0)
    assert second_order(command, 0.0, 6.0, 1.0, 0.0, dt) == pytest.approx(
        1 - np.exp(-6 * late) * (1 + 6 * late), abs=1e-4
    )
    assert first_order(command, 0.0, 5.0, 0.0, dt) == pytest.approx(1 - np.exp(-5 * t), abs=1e-9)


def test_a_vehicle_that_did_not_move_is_refused(tmp_path, capsys):
    t = np.arange(0.0, 6.0, FINE)
    still = np.zeros((len(t), 3))
    path = write_flight(tmp_path / "f.mcap", "attitude", still, still, t, noise=0.001)
    with pytest.raises(UserError, match="no axis moved"):
        identify(read_log(path))
    assert main(["identify", str(path)]) == 2
    assert "no axis moved" in capsys.readouterr().err


def test_command_prints_json(tmp_path, capsys):
    t = np.arange(0.0, 8.0, FINE)
    asked = asked_angle(t)
    was = respond(asked, 0.04, lambda x, v, c: 100.0 * (c - x) - 16.0 * v, 2)
    path = write_flight(tmp_path / "f.mcap", "attitude", asked, was, t, noise=0.001)
    assert main(["identify", str(path), "--json"]) == 0
    body = json.loads(capsys.readouterr().out)
    assert body["autopilot"] == "px4"
    assert {row["axis"] for row in body["axes"]} == {"roll", "pitch"}
