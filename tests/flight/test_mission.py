"""A mission of a ground station flown by the law: the plan's places lie where the autopilot's own origin says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from stub_flights import fly_short, lockstep_stub

from companion.mavlink.frames import enu_from_global

pytestmark = pytest.mark.flight


def test_a_plan_is_flown_through_its_places(tmp_path: Path) -> None:
    origin = (47.397742, 8.545594, 489.4)  # PX4's SIH_LOC_LAT0, _LON0, _H0
    places = [
        (origin[0] + north * 1e-5, origin[1] + east * 1e-5, 2.0) for north, east in ((1, 0), (2, 2), (0, 2))
    ]
    items = [
        {"type": "SimpleItem", "command": 16, "frame": 3, "params": [0, 0, 0, None, *place]}
        for place in places
    ]
    path = tmp_path / "field.plan"
    path.write_text(json.dumps({"fileType": "Plan", "mission": {"items": items, "hoverSpeed": 1.5}}))
    wishes = ("flight.duration_s=60", "flight.control_rate_hz=100", "flight.procedure.hold_s=0.5")
    with lockstep_stub() as stub:
        flown = fly_short(stub, tmp_path, settings=wishes, trajectory=str(path), real_time=False)
    assert flown.ended == "completed", flown.result.text
    truth = flown.record.channels["/truth"]["position_enu"]
    for latitude, longitude, height in places:
        there = enu_from_global(latitude, longitude, 0.0, origin)
        there[2] = height
        assert np.linalg.norm(truth - there, axis=1).min() < 0.15
