"""What a file of another program is, in words, where one of ours was expected."""

from __future__ import annotations

from pathlib import Path

_BEGINNINGS: tuple[tuple[bytes, str], ...] = (
    (b"ULog\x01\x12\x35", "a PX4 log (ULog); this program reads the logs that `companion fly` writes"),
    (b"\xa3\x95\x80", "an ArduPilot dataflash log; this program reads the logs that `companion fly` writes"),
    (b"#ROSBAG", "a ROS 1 bag; this program reads the MCAP files that `companion fly` writes"),
    (b"SQLite format 3", "a database (a ROS 2 bag of kind sqlite3?), not a file of this program"),
    (b"\x1f\x8b", "a gzip archive; unpack it first"),
    (b"PK\x03\x04", "a zip archive (or a spreadsheet); unpack it, or export it as CSV"),
    (b"\x89MCAP0\r\n", "an MCAP log; look at it with `companion analyze`"),
    (b"QGC WPL", "a MAVLink mission: fly it with `companion fly --trajectory`"),
)
_PARAMETERS = "a file of autopilot parameters: load it into the autopilot with your ground station"
_ENDINGS = {
    ".ulg": _BEGINNINGS[0][1],
    ".params": _PARAMETERS,
    ".parm": _PARAMETERS,
    ".param": _PARAMETERS,
    ".plan": "a QGroundControl plan: fly it with `companion fly --trajectory`",
    ".waypoints": _BEGINNINGS[-1][1],
    ".mission": _BEGINNINGS[-1][1],
    ".tlog": "a telemetry log of MAVLink; this program writes such files (`companion export`), it reads MCAP",
    ".html": "a web page",
}


def kind_of_file(path: Path, data: bytes = b"") -> str:
    """What `path`, which begins with `data`, is: a sentence without its end. Says so where nobody knows."""
    for beginning, words in _BEGINNINGS:
        if data.startswith(beginning):
            return f"it is {words}"
    if path.suffix.lower() in _ENDINGS:
        return f"it is {_ENDINGS[path.suffix.lower()]}"
    return "it does not begin as an MCAP file does"


def known_foreign(path: Path) -> str | None:
    """`kind_of_file` by the ending alone; None where it says nothing."""
    words = _ENDINGS.get(path.suffix.lower())
    return f"it is {words}" if words else None
