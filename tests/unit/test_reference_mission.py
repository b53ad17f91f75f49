"""Missions of QGroundControl and of ArduPilot's world as trajectories; places worked out by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from companion.config.errors import UserError
from companion.reference.mission import Mission
from companion.reference.registry import trajectory_from_text

ORIGIN = (47.0, 8.0, 400.0)
NORTH_DEG = math.degrees(10.0 / 6371000.0)  # 10 m on PX4's sphere
EAST_DEG = NORTH_DEG / math.cos(math.radians(47.0))
HOME = np.array([0.5, -0.5, 1.0])


def item(command: int, *params: float | None, frame: int = 3) -> dict[str, object]:
    return {
        "type": "SimpleItem",
        "command": command,
        "frame": frame,
        "params": list(params),
        "autoContinue": True,
    }


def place(
    north: float, east: float, height: float, yaw: float | None = None, hold: float = 0, frame: int = 3
):
    return item(16, hold, 0, 0, yaw, 47.0 + north * NORTH_DEG, 8.0 + east * EAST_DEG, height, frame=frame)


TAKEOFF = item(22, 0, 0, 0, None, 0, 0, 5)


def plan(tmp_path: Path, *items: dict[str, object], **more: object) -> Mission:
    path = tmp_path / "field.plan"
    mission = {"items": list(items), "hoverSpeed": 2.0, "plannedHomePosition": [47, 8, 400]}
    path.write_text(json.dumps({"fileType": "Plan", "version": 1, "mission": mission, **more}))
    found = trajectory_from_text(str(path))
    assert isinstance(found, Mission)
    return found


def passes(trajectory, points: list[list[float]], start_s: float = 0.0) -> list[float]:
    """When each point is passed, in order. Raises AssertionError where one is missed."""
    times = np.arange(start_s, trajectory.duration_s + 0.02, 0.025)
    path = np.array([trajectory.sample(float(t)).position_enu for t in times])
    found, begin = [], 0
    for point in points:
        away = np.linalg.norm(path[begin:] - point, axis=1)
        near = int(np.argmax(away < 0.06))
        assert away[near] < 0.06, f"{point} is missed by {away.min():.2f} m"
        begin += near
        found.append(float(times[begin]))
    return found


def test_a_plan_goes_smoothly_through_its_places_about_the_origin(tmp_path: Path) -> None:
    """Take-off above where it stands to 5 m; then 10 m north, 20 m north and 10 m east, at 2 m/s."""
    mission = plan(tmp_path, TAKEOFF, place(1, 0, 5), place(2, 1, 8), item(20, 0, 0, 0, 0, 0, 0, 0, frame=2))
    flown = mission.located(ORIGIN, HOME, yaw_rad=0.3)
    passes(flown, [[0.5, -0.5, 6.0], [0.0, 10.0, 6.0], [10.0, 20.0, 9.0]])
    states = [flown.sample(float(t)) for t in np.arange(0.0, flown.duration_s, 0.02)]
    assert max(np.linalg.norm(state.velocity_enu) for state in states) == pytest.approx(2.0, rel=0.02)
    assert max(np.linalg.norm(state.acceleration_enu) for state in states) < 1.02
    middle = passes(flown, [[0.0, 10.0, 6.0]])[0]
    assert np.linalg.norm(flown.sample(middle).velocity_enu) > 0.5  # no stop between
    assert {round(state.yaw_rad, 6) for state in states} == {0.3}


def test_heights_are_above_home_or_above_the_sea(tmp_path: Path) -> None:
    """403 m above the sea is 3 m above an origin at 400 m; home, 1 m above it, has no part in that."""
    mission = plan(
        tmp_path,
        place(0, 0, 3),
        place(1, 0, 403, frame=0),
        place(2, 0, 404, frame=5),
        place(3, 0, 2, frame=6),
    )
    passes(mission.located(ORIGIN, HOME, 0.0), [[0, 0, 4], [0, 10, 3], [0, 20, 4], [0, 30, 3]])


def test_heights_go_along_where_the_estimate_wanders_before_take_off(tmp_path: Path) -> None:
    mission = plan(tmp_path, place(0, 0, 3), place(1, 0, 3))
    mission.located(ORIGIN, HOME, 0.0)
    passes(mission.located(ORIGIN, HOME + np.array([0, 0, 0.2]), 0.0), [[0, 0, 4.2], [0, 10, 4.2]])


def test_holds_headings_delays_and_speeds(tmp_path: Path) -> None:
    """Stand 3 s at the second place and 2 s (NAV_DELAY) more; nose east (90°) there, then north by CONDITION_YAW."""
    mission = plan(
        tmp_path,
        item(178, 1, 1.0, -1, 0, 0, 0, 0, frame=2),
        place(0, 0, 3, yaw=0.0),
        place(1, 0, 3, yaw=90.0, hold=3.0),
        item(93, 2, 0, 0, 0, 0, 0, 0, frame=2),
        item(115, 0, 0, 0, 0, 0, 0, 0, frame=2),
        place(1, 1, 3),
    )
    flown = mission.located(ORIGIN, HOME, 0.0)
    arrives = passes(flown, [[0, 10, 4.0]])[0]
    times = np.arange(0.0, flown.duration_s, 0.01)
    still = [float(t) for t in times if np.linalg.norm(flown.sample(float(t)).velocity_enu) < 1e-6]
    inside = [t for t in still if 1.0 < t < flown.duration_s - 1.0]
    assert inside[-1] - inside[0] == pytest.approx(5.0, abs=0.1) and inside[0] >= arrives - 0.5
    assert flown.sample(0.0).yaw_rad == pytest.approx(math.pi / 2)
    assert flown.sample(inside[0]).yaw_rad == pytest.approx(0.0, abs=1e-6)
    assert flown.sample(flown.duration_s).yaw_rad == pytest.approx(math.pi / 2)
    speeds = [np.linalg.norm(flown.sample(float(t)).velocity_enu) for t in times]
    assert max(speeds) == pytest.approx(1.0, rel=0.02)


def test_a_survey_is_flown_by_the_waypoints_in_it(tmp_path: Path) -> None:
    survey = {
        "type": "ComplexItem", "complexItemType": "survey",
        "TransectStyleComplexItem": {"Items": [place(0, 0, 5), item(206, 0, 0, 1, 1, 0, 0, 0, frame=2), place(1, 0, 5)]},
    }  # fmt: skip
    passes(plan(tmp_path, survey).located(ORIGIN, HOME, 0.0), [[0, 0, 6], [0, 10, 6]])


def test_what_is_passed_over_is_named_once(tmp_path: Path, capsys) -> None:
    fence = {"circles": [{"circle": {"radius": 50}}], "polygons": []}
    items = [
        TAKEOFF,
        place(1, 0, 5),
        item(203, 0, 0, 0, 0, 1, 0, 0, frame=2),
        item(18, 2, 0, 10, 0, 47, 8, 5),
    ]
    plan(tmp_path, *items, item(21, 0, 0, 0, None, 47, 8, 0), geoFence=fence)
    trajectory_from_text(str(tmp_path / "field.plan"))
    said = capsys.readouterr().err.splitlines()
    assert said == [
        f"{tmp_path}/field.plan: passed over: its fence (flight.safety.fence counts), DO_DIGICAM_CONTROL, the circling of "
        "NAV_LOITER_TURNS, NAV_LAND (the flight ends above its place of take-off and lands there)"
    ]


WPL = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t47.0\t8.0\t400.0\t1
1\t0\t3\t22\t0\t0\t0\t0\t0.0\t0.0\t4.0\t1
2\t0\t3\t16\t0\t0\t0\t0\t{north}\t8.0\t4.0\t1
3\t0\t3\t19\t2\t0\t0\t0\t{north}\t{east}\t4.0\t1
4\t0\t3\t16\t0\t0\t0\t0\t47.0\t{east}\t4.0\t1
5\t0\t0\t20\t0\t0\t0\t0\t0\t0\t0\t1
"""


def waypoints(tmp_path: Path, text: str = WPL, options: str = ""):
    path = tmp_path / "field.waypoints"
    path.write_text(text.format(north=47.0 + NORTH_DEG, east=8.0 + EAST_DEG))
    return trajectory_from_text(f"{path}{options}")


def test_a_waypoint_file_of_ardupilot_is_flown(tmp_path: Path) -> None:
    """Its first line is home; 2 s of loitering at the third place; heading kept, whatever its fourth column says."""
    flown = waypoints(tmp_path, options=",speed=1.5").located(ORIGIN, HOME, 1.0)
    passes(flown, [[0.5, -0.5, 5], [0, 10, 5], [10, 10, 5], [10, 0, 5]])
    assert flown.sample(flown.duration_s).yaw_rad == pytest.approx(1.0)
    named = tmp_path / "field.txt"
    named.write_text((tmp_path / "field.waypoints").read_text())
    assert trajectory_from_text(f"mission:{named}").duration_s > 10.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("QGC WPL 110", "QGC XPL"), "neither a QGroundControl plan"),
        (("\t{east}\t4.0\t1\n5", "\t{east}\t4.0\n5"), "waypoints:6: 11 columns; a waypoint has 12"),
        (("19\t2\t", "19\ttwo\t"), "waypoints:5: a column is not a number"),
        (("2\t0\t3\t16", "2\t0\t10\t16"), "waypoints:4: its height is above terrain"),
        (("2\t0\t3\t16", "2\t0\t1\t16"), "waypoints:4: frame 1 is not flown"),
        (("{north}\t8.0\t4.0", "97.0\t8.0\t4.0"), "waypoints:4: 97°, 8° is no place"),
        (("19\t2\t", "19\t-2\t"), "waypoints:5: holds for -2 s"),
        (("8.0\t4.0", "8.0\tnan"), "waypoints:4: a column is not a finite number"),
    ],
)
def test_mistakes_in_a_waypoint_file_are_told_with_their_line(tmp_path: Path, change, words: str) -> None:
    with pytest.raises(UserError, match=words):
        waypoints(tmp_path, WPL.replace(*change, 1))


@pytest.mark.parametrize(
    ("items", "words"),
    [
        ([TAKEOFF], "1 places to fly to; from 2"),
        (
            [place(0, 0, 5), {"type": "ComplexItem", "complexItemType": "StructureScan"}],
            "waypoints of a StructureScan",
        ),
        (
            [place(0, 0, 5), {"type": "SimpleItem", "command": "16", "params": []}],
            "item 2: command and frame",
        ),
        ([place(0, 0, 5), item(16, 0, 0)], "item 2: params have to be seven numbers"),
        ([place(0, 0, 5), item(16, 0, 0, 0, 0, "47", 8, 5)], "item 2: params have to be numbers or null"),
        ([place(0, 0, 5), item(16, 0, 0, 0, 0, None, None, 5)], "item 2: nan°, nan° is no place"),
        ([place(0, 0, 5), item(16, 0, 0, 0, 0, 47, 8, None)], "item 2: its altitude is nan m"),
        ([place(0, 0, 5), 7], "item 2: not an object"),
    ],
)
def test_mistakes_in_a_plan_are_told_with_their_item(tmp_path: Path, items, words: str) -> None:
    with pytest.raises(UserError, match=words):
        plan(tmp_path, *items)


def test_files_that_are_no_plans_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "no.plan"
    for text, words in (
        ("{", "not valid JSON"),
        ('{"fileType": "Parameters"}', "not a plan"),
        ("{}", "not a plan"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=words):
            trajectory_from_text(str(path))
    mission = plan(tmp_path, place(0, 0, 5), place(0, 0, 5))
    with pytest.raises(UserError, match="all its places are one"):
        mission.located(ORIGIN, HOME, 0.0)
