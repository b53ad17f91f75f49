"""Missions of ground stations: a QGroundControl `.plan`, or a waypoint file of ArduPilot's world (`QGC WPL 110`).

What is a place is flown: NAV_TAKEOFF, NAV_WAYPOINT, NAV_SPLINE_WAYPOINT, NAV_LOITER_TIME and the other loiters (by their
centre). NAV_DELAY and a waypoint's hold time are stops, CONDITION_YAW (absolute) and a plan's yaw are headings,
DO_CHANGE_SPEED before the first move is the speed. Everything else is passed over and named.

Formats: https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/plan.html and
https://mavlink.io/en/file_formats/ (plain-text waypoints).
"""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from companion.config.errors import UserError
from companion.mavlink.layouts import mav
from companion.reference.mission import GlobalPoint, Mission
from companion.reference.table_file import read_text, say_once

MOST_ITEMS = 2000
LONGEST_HOLD_S = 3600.0
FASTEST_M_S = 50.0
_HEADER = "QGC WPL"
_COMMANDS = mav.enums["MAV_CMD"]
_WAYPOINTS = (mav.MAV_CMD_NAV_WAYPOINT, mav.MAV_CMD_NAV_SPLINE_WAYPOINT)
_LOITERS = (
    mav.MAV_CMD_NAV_LOITER_UNLIM,
    mav.MAV_CMD_NAV_LOITER_TURNS,
    mav.MAV_CMD_NAV_LOITER_TIME,
    mav.MAV_CMD_NAV_LOITER_TO_ALT,
)
_TAKEOFFS = (mav.MAV_CMD_NAV_TAKEOFF, mav.MAV_CMD_NAV_VTOL_TAKEOFF)
_PLACES = (*_TAKEOFFS, *_WAYPOINTS, *_LOITERS)
_ABOVE_HOME = (mav.MAV_FRAME_GLOBAL_RELATIVE_ALT, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
_ABOVE_SEA = (mav.MAV_FRAME_GLOBAL, mav.MAV_FRAME_GLOBAL_INT)
_ABOVE_TERRAIN = (mav.MAV_FRAME_GLOBAL_TERRAIN_ALT, mav.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT)
_HOMEWARD = (mav.MAV_CMD_NAV_RETURN_TO_LAUNCH, mav.MAV_CMD_NAV_LAND, mav.MAV_CMD_NAV_VTOL_LAND)


@dataclass(frozen=True, slots=True)
class Item:
    """One item of a mission, as MISSION_ITEM_INT has it."""

    where: str  # in the file, for people
    command: int
    frame: int
    parameters: tuple[float, float, float, float]  # NaN where the file has null
    latitude_deg: float
    longitude_deg: float
    altitude_m: float


def mission_trajectory(path: Path, speed: float | None = None) -> Mission:
    """Read a mission and return the smooth flight through its places. `speed` replaces the file's, m/s.

    Raises UserError with the place in the file.
    """
    text = read_text(path)
    if text.lstrip().startswith("{"):
        items, speed_m_s, passed = _from_plan(path, text)
    else:
        items, speed_m_s, passed = _from_waypoint_file(path, text), None, Counter[str]()
    if len(items) > MOST_ITEMS:
        raise UserError(f"{path}: {len(items)} items; {MOST_ITEMS} are possible")
    points, own_speed_m_s, more = _points_of(items)
    passed += more
    if passed:
        names = ", ".join(f"{name} ({count})" if count > 1 else name for name, count in passed.items())
        say_once(f"{path}: passed over: {names}")
    if len(points) < 2:
        raise UserError(f"{path}: {len(points)} places to fly to; from 2 are needed")
    chosen = speed if speed is not None else own_speed_m_s or speed_m_s
    if chosen is not None and not 0.0 < chosen <= FASTEST_M_S:
        raise UserError(f"{path}: speed is {chosen:g} m/s; it has to be above 0 and at most {FASTEST_M_S:g}")
    return Mission(str(path), tuple(points), chosen)


def _points_of(items: list[Item]) -> tuple[list[GlobalPoint], float | None, Counter[str]]:
    """Places in order, a speed told before the first move, and what is passed over."""
    points: list[GlobalPoint] = []
    passed: Counter[str] = Counter()
    speed_m_s, yaw_rad = None, math.nan
    for item in items:
        first, second, _, fourth = item.parameters
        if item.command in _PLACES:
            if item.command in _WAYPOINTS and math.isfinite(fourth):
                yaw_rad = math.pi / 2.0 - math.radians(fourth)
            waits = item.command in (mav.MAV_CMD_NAV_WAYPOINT, mav.MAV_CMD_NAV_LOITER_TIME)
            points.append(_point(item, yaw_rad, first if waits else 0.0))
            if item.command in _LOITERS and item.command != mav.MAV_CMD_NAV_LOITER_TIME:
                passed[f"the circling of {_name(item.command)}"] += 1
        elif item.command == mav.MAV_CMD_NAV_DELAY and points and first > 0.0:
            points[-1] = replace(points[-1], hold_s=_hold(item, points[-1].hold_s + first))
        elif item.command == mav.MAV_CMD_CONDITION_YAW and fourth == 0.0 and math.isfinite(first):
            yaw_rad = math.pi / 2.0 - math.radians(first)
        elif item.command == mav.MAV_CMD_DO_CHANGE_SPEED and len(points) < 2 and second > 0.0:
            speed_m_s = second
        elif item.command in _HOMEWARD:
            passed[
                f"{_name(item.command)} (the flight ends above its place of take-off and lands there)"
            ] += 1
        else:
            passed[_name(item.command)] += 1
    return points, speed_m_s, passed


def _point(item: Item, yaw_rad: float, hold_s: float) -> GlobalPoint:
    if item.frame in _ABOVE_TERRAIN:
        raise UserError(
            f"{item.where}: its height is above terrain, which is not known here; plan it above the place of take-off"
        )
    if item.frame not in (*_ABOVE_HOME, *_ABOVE_SEA):
        raise UserError(
            f"{item.where}: frame {item.frame} is not flown; global ones are (MAV_FRAME 0, 3, 5, 6)"
        )
    if not abs(item.altitude_m) <= 1e5:
        raise UserError(f"{item.where}: its altitude is {item.altitude_m:g} m")
    latitude, longitude = item.latitude_deg, item.longitude_deg
    if item.command in _TAKEOFFS and (
        math.isnan(latitude) or math.isnan(longitude) or latitude == longitude == 0.0
    ):
        latitude = longitude = math.nan  # where it stands
    elif not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0) or latitude == longitude == 0.0:
        raise UserError(f"{item.where}: {latitude:g}°, {longitude:g}° is no place to fly to")
    above_home = item.frame in _ABOVE_HOME
    return GlobalPoint(
        item.where, latitude, longitude, item.altitude_m, above_home, yaw_rad, _hold(item, hold_s)
    )


def _hold(item: Item, hold_s: float) -> float:
    if math.isnan(hold_s):
        return 0.0
    if not 0.0 <= hold_s <= LONGEST_HOLD_S:
        raise UserError(f"{item.where}: holds for {hold_s:g} s; from 0 to {LONGEST_HOLD_S:g} s are possible")
    return hold_s


def _name(command: int) -> str:
    known = _COMMANDS.get(command)
    return known.name.removeprefix("MAV_CMD_") if known is not None else f"command {command}"


# A waypoint file ------------------------------------------------------------------------------------------------


def _from_waypoint_file(path: Path, text: str) -> list[Item]:
    """`QGC WPL <version>`, then: index, current, frame, command, four params, latitude, longitude, altitude, continue."""
    lines = text.splitlines()
    if not lines or not lines[0].startswith(_HEADER):
        raise UserError(
            f"{path}: neither a QGroundControl plan (JSON) nor a waypoint file (it begins with {_HEADER})"
        )
    items = []
    for number, line in enumerate(lines[1:], start=2):
        where, words = f"{path}:{number}", line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != 12:
            raise UserError(f"{where}: {len(words)} columns; a waypoint has 12")
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise UserError(f"{where}: a column is not a number") from None
        if not all(math.isfinite(value) for value in (*values[:4], *values[8:11])):
            raise UserError(f"{where}: a column is not a finite number")
        _, _, frame, command, p1, p2, p3, p4, latitude, longitude, altitude, _ = values
        if int(command) in _WAYPOINTS:
            p4 = (
                math.nan
            )  # ArduCopter does not look at it: WP_YAW_BEHAVIOR and CONDITION_YAW turn the vehicle
        items.append(Item(where, int(command), int(frame), (p1, p2, p3, p4), latitude, longitude, altitude))
    if items and items[0].command == mav.MAV_CMD_NAV_WAYPOINT and items[0].frame in _ABOVE_SEA:
        del items[0]  # the home position of when it was planned
    return items


# A plan of QGroundControl ---------------------------------------------------------------------------------------


def _from_plan(path: Path, text: str) -> tuple[list[Item], float | None, Counter[str]]:
    """Items, the plan's hover speed, and what is passed over."""
    try:
        plan = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON: {error}") from None
    mission = plan.get("mission") if isinstance(plan, dict) and plan.get("fileType") == "Plan" else None
    entries = mission.get("items") if isinstance(mission, dict) else None
    if not isinstance(entries, list):
        raise UserError(
            f"{path}: not a plan of QGroundControl (no fileType Plan with a mission and its items)"
        )
    passed: Counter[str] = Counter()
    for name, words in (
        ("geoFence", "its fence (flight.safety.fence counts)"),
        ("rallyPoints", "its rally points"),
    ):
        part = plan.get(name)
        if isinstance(part, dict) and any(part.get(key) for key in ("circles", "polygons", "points")):
            passed[words] += 1
    items: list[Item] = []
    for number, entry in enumerate(entries, start=1):
        _add_entry(f"{path}: item {number}", entry, items)
    speed = mission.get("hoverSpeed") if isinstance(mission, dict) else None
    return items, float(speed) if isinstance(speed, int | float) and 0.0 < speed < 1e3 else None, passed


def _add_entry(where: str, entry: Any, items: list[Item]) -> None:
    if not isinstance(entry, dict):
        raise UserError(f"{where}: not an object")
    if entry.get("type") == "SimpleItem":
        items.append(_simple_item(where, entry))
        return
    kind = str(entry.get("complexItemType", entry.get("type")))[:40]
    transects = entry.get("TransectStyleComplexItem")
    inner = transects.get("Items") if isinstance(transects, dict) else None
    if not isinstance(inner, list):
        raise UserError(
            f"{where}: the waypoints of a {kind} are not in the file; make a mission of simple items of it"
        )
    for number, each in enumerate(inner, start=1):
        _add_entry(f"{where} ({kind}), {number}", each, items)


def _simple_item(where: str, entry: dict[str, Any]) -> Item:
    command, frame, given = (
        entry.get("command"),
        entry.get("frame", mav.MAV_FRAME_MISSION),
        entry.get("params"),
    )
    if not isinstance(command, int) or not isinstance(frame, int):
        raise UserError(f"{where}: command and frame have to be whole numbers")
    if not isinstance(given, list) or len(given) != 7:
        raise UserError(f"{where}: params have to be seven numbers")
    values = []
    for value in given:
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise UserError(f"{where}: params have to be numbers or null")
        try:
            values.append(math.nan if value is None else float(value))
        except OverflowError:
            raise UserError(f"{where}: a number of params is too large") from None
    p1, p2, p3, p4, latitude, longitude, altitude = values
    return Item(where, command, frame, (p1, p2, p3, p4), latitude, longitude, altitude)
