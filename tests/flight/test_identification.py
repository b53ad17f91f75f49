"""What a flight finds out about its autopilot, on the stub with the vehicle and parameters of PX4's capture.

One flight with a hover thrust parameter that is a fifth too high. What was found is compared with the stub's true state,
by other means than those under test.
"""

from __future__ import annotations

import numpy as np
import pytest
from stub_flights import Watching, lockstep_stub

from companion.analysis.identify import identify
from companion.analysis.rotation import euler_from_quaternions
from companion.config.settings import load_settings
from companion.flight.outcome import Outcome
from companion.flight.session import SessionOptions, fly
from companion.flightlog.reader import FlightRecord, read_log
from companion.mavlink.connection import Connection
from companion.mavlink.endpoint import parse_endpoint

pytestmark = pytest.mark.flight
TRUE_HOVER = 1.79 * 9.80665 / (4 * 8.78)  # SIH_MASS, four of SIH_T_MAX: 0.4998
TOLD = 1.2 * TRUE_HOVER


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> FlightRecord:
    log = tmp_path_factory.mktemp("identified") / "flight.mcap"
    settings = load_settings(
        "px4_sih",
        {"trajectory": "lemniscate,scale=1.5", "duration_s": 16.0},
        ["flight.procedure.connect_timeout_s=120", "flight.procedure.hold_s=1", "profile.mass_ratio=1.0"],
    )
    with lockstep_stub("--vehicle", "px4_sih", "--param", f"MPC_THR_HOVER={TOLD:.4f}") as stub:
        result = fly(settings, SessionOptions(Connection(parse_endpoint(stub.endpoint)), log), Watching({}))
    assert result.outcome is Outcome.COMPLETED, result.text
    return read_log(log)


def test_hover_thrust_is_found_within_3_percent_in_5_s(record: FlightRecord) -> None:
    estimates = record.channel("/estimates")
    assert estimates is not None
    began = next(e.time_s for e in record.events_of("phase") if e.fields["phase"] == "climb")
    found = np.interp(began + 5.0, estimates.time_s, estimates["hover_thrust"])
    before = np.interp(began - 1.0, estimates.time_s, estimates["hover_thrust"])
    assert before == pytest.approx(TOLD, rel=1e-3)  # nothing is learned on the ground
    assert found == pytest.approx(TRUE_HOVER, rel=0.03)
    assert estimates["hover_thrust"][-1] == pytest.approx(TRUE_HOVER, rel=0.03)


def test_the_attitude_loops_lag_is_identified_within_15_percent(record: FlightRecord) -> None:
    """Dead time and lag together, against the shift in time at which true tilt and setpoint fit best."""
    setpoint, truth = record.channel("/setpoint"), record.channel("/truth")
    assert setpoint is not None and truth is not None
    tracking = [e.time_s for e in record.events_of("tracking")]
    time_s = np.arange(tracking[0] + 1.0, tracking[1] - 1.0, 0.01)
    held = np.searchsorted(setpoint.time_s, time_s, side="right") - 1
    asked = np.unwrap(euler_from_quaternions(setpoint["quaternion_wxyz"]), axis=0)[held]
    was = np.unwrap(euler_from_quaternions(truth["quaternion_wxyz"]), axis=0)
    found = {response.axis: response for response in identify(record)}
    for i, axis in enumerate(("roll", "pitch")):
        shifts = np.arange(0.0, 0.6, 0.005)
        moved = [np.interp(time_s + s, truth.time_s, was[:, i]) for s in shifts]
        misfit = [np.std(m - asked[:, i]) for m in moved]
        late_s = shifts[int(np.argmin(misfit))]
        assert found[axis].lag_s == pytest.approx(late_s, rel=0.15)
