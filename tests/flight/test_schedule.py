"""Laws that take turns in one flight, and the autopilot's own controller among them: no bump, one log, analysed apart."""

from __future__ import annotations

import pytest
from engagements import airborne, jumps
from stub_flights import fly_short, lockstep_stub

from companion.analysis.metrics import flight_metrics
from companion.analysis.replay import replay
from companion.autopilot.adapter import Intent
from companion.flight.outcome import Outcome
from companion.mavlink.link import mav

pytestmark = pytest.mark.flight
SCHEDULE = (("tlmbc", 2.0), ("dtlannc", 2.0), ("autopilot", 2.0), ("dtlannc", 2.0))


@pytest.mark.parametrize("firmware", ["px4", "ardupilot"])
def test_laws_take_turns_without_a_bump(tmp_path, firmware):
    settings = ["flight.duration_s=8", "flight.procedure.hold_s=0.5", "flight.controller=tlmbc"]
    with lockstep_stub(*airborne(firmware), firmware=firmware) as stub:
        flown = fly_short(
            stub, tmp_path, None, settings, "attitude", "hover",
            from_air=True, then=Intent.HOLD, schedule=SCHEDULE,
        )  # fmt: skip
    assert flown.result.outcome is Outcome.COMPLETED, flown.result.text
    laws = [event.fields["controller"] for event in flown.record.events_of("law")]
    assert laws == ["tlmbc", "dtlannc", "autopilot", "dtlannc"]
    engaged, changed, to_autopilot, back = jumps(flown.record, "law")
    for off_m, turned_deg in (engaged, changed):
        assert off_m < 0.05 and turned_deg < 3.0
    for off_m, turned_deg in (to_autopilot, back):  # whose integrals begin anew, which is not ours to mend
        assert off_m < 0.15 and turned_deg < 3.5
    assert replay(flown.record).exact
    metrics, _ = flight_metrics(flown.record, None, None)
    assert [part.controller for part in metrics.parts] == laws
    assert [round(part.window_s[0]) for part in metrics.parts] == [0, 2, 4, 6]
    assert all(max(part.position_rms_m) < 0.12 for part in metrics.parts)
    assert all((part.attitude_rms_deg[0] > 0.0) is (part.controller != "autopilot") for part in metrics.parts)
    _, frames = flown.record.mavlink["out"]
    kinds = [frame[7] | frame[8] << 8 | frame[9] << 16 for frame in frames]
    assert kinds.count(mav.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED) == pytest.approx(200, abs=5)
