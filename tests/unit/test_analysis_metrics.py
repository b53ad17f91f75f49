"""Errors found in a log against errors known in closed form."""

import argparse
import json

import numpy as np
import pytest
import synthetic_flight
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from companion.analysis.interpolation import hermite, inside, strictly_rising
from companion.analysis.metrics import flight_metrics
from companion.analysis.rotation import euler_from_quaternions, wrap_angle
from companion.analysis.tracking import tracking_errors, tracking_span
from companion.cli import analyze, export, recover
from companion.config.errors import UserError
from companion.flightlog.channels import REFERENCE, STATE, STREAMS, TRUTH
from companion.flightlog.reader import read_log
from companion.flightlog.writer import FlightLog


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return synthetic_flight.write(tmp_path_factory.mktemp("log") / "flight.mcap")


def test_rms_maximum_and_95_percent_are_those_of_the_sines(flight):
    metrics, _ = flight_metrics(read_log(flight))
    a, b, c = synthetic_flight.ERROR_M
    assert metrics.get("rms", "position_truth_m") == pytest.approx((a / 2**0.5, b / 2**0.5, c), rel=1e-3)
    assert metrics.get("max", "position_truth_m") == pytest.approx((a, b, c), rel=1e-4)
    p95 = np.sin(0.95 * np.pi / 2)  # of |sin| over whole periods
    assert metrics.get("p95", "position_truth_m") == pytest.approx((a * p95, b * p95, c), rel=1e-3)
    assert metrics.get("rms", "attitude_deg") == pytest.approx((1.0, 2.0, 0.5), rel=1e-4)
    assert metrics.get("rms", "yaw_deg") == pytest.approx((0.5,), rel=1e-6)
    assert metrics.window_s == pytest.approx((0.0, 20.0), abs=0.01)


def test_signs_are_desired_minus_flown(flight):
    tracking = tracking_errors(read_log(flight))
    truth, estimate = tracking.series["truth"], tracking.series["estimate"]
    t = truth.tracking_time_s
    expected = np.array([synthetic_flight.position_error(x) for x in t])
    assert np.abs(truth.position_m - expected).max() < 1e-7  # the interpolation's share of it
    assert np.degrees(truth.attitude_rad.mean(axis=0)) == pytest.approx([1.0, -2.0, 0.5], abs=1e-4)
    assert estimate.position_m[:, 2] == pytest.approx(0.02 - 0.004)


def test_the_window_is_in_seconds_of_tracking(flight):
    record = read_log(flight)
    _, tracking = flight_metrics(record, 5.0, 10.0)
    times = tracking.series["truth"].tracking_time_s
    assert tracking.window_s == (5.0, 10.0)
    assert 5.0 <= times.min() < 5.011 and 9.989 < times.max() <= 10.0 + 1e-9
    assert tracking_span(record)[0] == pytest.approx(synthetic_flight.TRACK_FROM_S, abs=1e-9)


@pytest.mark.parametrize(
    ("window", "says"), [((-1, 5), "0 or later"), ((5, 5), "not be empty"), ((30, 40), "for 19.99 s")]
)
def test_windows_outside_the_tracking_are_refused(flight, window, says):
    with pytest.raises(UserError, match=says):
        flight_metrics(read_log(flight), *window)


def test_a_window_that_ends_late_is_cut_and_said(flight):
    metrics, _ = flight_metrics(read_log(flight), 0.0, 60.0)
    assert metrics.window_s[1] < 20.1 and any("--to 60" in note for note in metrics.notes)


def test_without_truth_the_estimate_judges_and_it_is_said(tmp_path):
    metrics, _ = flight_metrics(
        read_log(synthetic_flight.write(tmp_path / "a.mcap", seconds=5.0, truth=False))
    )
    assert metrics.judged_by == "estimate" and metrics.get("rms", "position_truth_m") is None
    assert any("no truth" in note for note in metrics.notes)
    out = metrics.to_json()
    assert out["rms"]["position_truth_m"] is None and out["rms"]["attitude_deg"] == pytest.approx(
        [1.0, 2.0, 0.5]
    )


def test_without_tracking_there_are_no_figures_and_it_is_said(tmp_path):
    metrics, tracking = flight_metrics(read_log(synthetic_flight.write(tmp_path / "a.mcap", track=False)))
    assert tracking is None and metrics.window_s is None
    assert metrics.to_json()["rms"]["position_truth_m"] is None
    assert any("never tracked" in note for note in metrics.notes)


def test_a_cut_log_is_measured_up_to_the_cut(flight, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(flight.read_bytes()[: flight.stat().st_size // 2])
    metrics, _ = flight_metrics(read_log(cut))
    expected = synthetic_flight.ERROR_M[2] - 0.004
    assert metrics.get("rms", "position_estimate_m")[2] == pytest.approx(expected)
    assert metrics.ended == "log cut" and any("was cut" in note for note in metrics.notes)


def test_json_holds_what_is_promised(flight, capsys):
    assert command(analyze, ["analyze", str(flight), "--from", "5", "--to", "15", "--json"]) == 0
    out = json.loads(capsys.readouterr().out)
    for name in ("position_truth_m", "position_estimate_m", "attitude_deg"):
        assert len(out["rms"][name]) == 3
    facts = {"controller": "dtlannc", "level": "attitude", "firmware": "px4", "mass_ratio": 0.7, "seed": 1}
    assert {key: out[key] for key in facts} == facts
    assert out["window_s"] == [5.0, 15.0] and out["ended"] == "completed"


def test_the_table_shows_the_reports_figures_beside_ours(flight, capsys):
    assert command(analyze, ["analyze", str(flight)]) == 0
    rows = {line.split()[1]: line.split() for line in capsys.readouterr().out.splitlines() if "e_" in line}
    assert {"0.0354", "0.0448"} <= set(rows["e_x"]) and {"0.0212", "0.0216"} <= set(rows["e_y"])


def test_recover_and_export_run_from_the_command_line(flight, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(flight.read_bytes()[:-5000])
    assert command(recover, ["recover", str(cut), "-o", str(tmp_path / "whole.mcap")]) == 0
    assert command(export, ["export", str(cut), "-o", str(tmp_path / "a.tlog")]) == 0
    out = capsys.readouterr().out
    assert "saved" in out and "frames in" in out and "was cut" in out
    assert (tmp_path / "a.tlog").stat().st_size > 0 and read_log(tmp_path / "whole.mcap").cut == ""


def command(module, words):
    parser = argparse.ArgumentParser()
    module.add_parser(parser.add_subparsers())
    arguments = parser.parse_args(words)
    return arguments.run(arguments)


def test_yaw_that_turns_past_half_a_turn_makes_no_false_error(tmp_path):
    """Reference yaw grows through π and is logged wrapped; the vehicle is 0.05 rad behind; truth falls between."""
    with FlightLog(tmp_path / "a.mcap", channels=[REFERENCE, TRUTH, STATE], utc_offset_ns=0) as log:
        reference, truth = log.define(REFERENCE), log.define(TRUTH)
        for t in np.arange(0.0, 4.0, 0.02):
            yaw = float(wrap_angle(2.0 + t))
            log.record(reference, t, np.zeros(15), yaw, 1.0, 0.0, t)
            late = t + 0.007
            euler = [0.0, 0.0, 2.0 + late - 0.05]
            log.record(truth, late, np.zeros(6), synthetic_flight.quaternion(euler), np.zeros(3))
    tracking = tracking_errors(read_log(tmp_path / "a.mcap"))
    assert any("x is east, y is north" in note for note in tracking.notes)
    series = tracking.series["truth"]
    assert series.yaw_rad == pytest.approx(0.05, abs=1e-9)


def test_errors_are_along_the_trajectorys_own_axes(tmp_path):
    """Laid out along north: its x is local y, its y is local -x."""
    with FlightLog(tmp_path / "a.mcap", channels=[REFERENCE, TRUTH], utc_offset_ns=0) as log:
        log.event("layout", 0.0, heading_rad=np.pi / 2, origin_enu=[5.0, 6.0, 0.0])
        for t in np.arange(0.0, 2.0, 0.01):
            log.record(log.define(REFERENCE), t, np.zeros(15), np.pi / 2, 0.0, 0.0, t)
            flown = np.array(
                [-0.3, -0.1, -0.2, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0]
            )  # e = (0.3, 0.1, 0.2) east, north, up
            log.record(log.define(TRUTH), t, flown)
    tracking = tracking_errors(read_log(tmp_path / "a.mcap"))
    assert tracking.series["truth"].position_m == pytest.approx(np.tile([0.1, -0.3, 0.2], (200, 1)))
    assert not any("laid out" in note for note in tracking.notes)


def test_nothing_is_interpolated_across_a_gap_in_the_reference(tmp_path):
    with FlightLog(tmp_path / "a.mcap", channels=[REFERENCE, TRUTH], utc_offset_ns=0) as log:
        reference, truth = log.define(REFERENCE), log.define(TRUTH)
        for t in np.arange(0.0, 4.0, 0.01):
            if not 1.0 < t < 2.0:
                log.record(reference, t, np.zeros(18), t)
            log.record(truth, t + 0.003, np.array([0, 0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0]))
    times = tracking_errors(read_log(tmp_path / "a.mcap")).series["truth"].tracking_time_s
    assert not ((times > 1.02) & (times < 1.98)).any() and (times < 1.0).any() and (times > 2.0).any()


@settings(max_examples=60, deadline=None)
@given(
    arrays(np.float64, 12, elements=st.floats(0.004, 0.2)),
    arrays(np.float64, (12, 3), elements=st.floats(-10, 10)),
    arrays(np.float64, (12, 3), elements=st.floats(-10, 10)),
    arrays(np.float64, 9, elements=st.floats(0, 1)),
)
def test_hermite_is_scipys(steps, value, rate, where):
    time = np.cumsum(steps)
    at = time[0] + where * (time[-1] - time[0])
    assert np.allclose(hermite(time, value, rate, at), CubicHermiteSpline(time, value, rate)(at), atol=1e-9)


def test_interpolating_the_lemniscate_costs_micrometres_where_the_nearest_sample_costs_millimetres():
    time = np.arange(0.0, 8.0, 0.02)  # a slow loop: 50 Hz
    rows = [synthetic_flight.lemniscate(t + 1e-9) for t in time]
    value, rate = (np.array(column) for column in zip(*rows, strict=True))
    at = np.random.default_rng(4).uniform(0.0, 7.9, 2000)
    exact = np.array([synthetic_flight.lemniscate(t + 1e-9)[0] for t in at])
    assert np.abs(hermite(time, value, rate, at) - exact).max() < 1e-6
    nearest = value[np.abs(time[None, :] - at[:, None]).argmin(axis=1)]
    assert np.abs(nearest - exact).max() > 5e-3


def test_samples_that_come_twice_or_late_are_left_out():
    assert strictly_rising(np.array([])).tolist() == [] and strictly_rising(
        np.array([np.nan, 1.0])
    ).tolist() == [1]
    assert strictly_rising(np.array([0.0, 1.0, 1.0, 0.5, 2.0, np.nan, 3.0])).tolist() == [0, 1, 4, 6]
    assert inside(np.array([0.0, 0.1, 1.0]), np.array([-0.1, 0.05, 0.5, 1.0, 1.1])).tolist() == [
        False,
        True,
        False,
        False,
        False,
    ]


@settings(max_examples=200, deadline=None)
@given(arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_euler_angles_are_scipys(q):
    q = q / np.linalg.norm(q)
    euler = euler_from_quaternions(q[None, :])[0]
    if abs(euler[1]) > 1.5:
        return  # roll and yaw are not told apart there
    yaw, pitch, roll = Rotation.from_quat(q[[1, 2, 3, 0]]).as_euler("ZYX")
    assert np.abs(wrap_angle(euler - [roll, pitch, yaw])).max() < 1e-6


@given(st.floats(-50, 50))
def test_wrapped_angles_are_the_same_angles_within_half_a_turn(angle):
    wrapped = float(wrap_angle(np.array(angle)))
    assert -np.pi < wrapped <= np.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle), abs=1e-9)


def test_streams_are_summed_up_over_the_flight(tmp_path):
    with FlightLog(tmp_path / "a.mcap", {"controller": "dtlannc"}) as log:
        streams = log.define(STREAMS)
        for second, age_s in enumerate((0.01, 0.02, 0.09)):
            log.record(streams, float(second), 31.0, 100.0, 0.001, age_s, 2.0 * age_s)
            log.record(streams, float(second), 32.0, 30.0, np.nan, np.nan, np.nan)
    found = flight_metrics(read_log(tmp_path / "a.mcap"))[0].to_json()["streams"]
    assert found == {
        "ATTITUDE_QUATERNION": {"rate_hz": 100.0, "jitter_s": 0.001, "age_s": 0.02, "age_95_s": 0.04},
        "LOCAL_POSITION_NED": {"rate_hz": 30.0, "jitter_s": None, "age_s": None, "age_95_s": None},
    }
