"""One cell judged by the truth: what rose, tilted and hit the ground, who had it when, and whether the words are so."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass

import numpy as np
from campaign.evidence import OUTCOMES
from campaign.flying import Flown
from campaign.tape import ARMED, MODE, POSITION, QUATERNION, TIME, VELOCITY, FloatArray
from campaign.wire import is_ours

from handover.cells import ENDS, Cell

RISE_M = 0.5
RISE_UNHEARD_M = 1.0
"""Below attitude level, where nothing more reaches the autopilot: a companion killed, a link that stays lost."""
PLAN_TOP_M = 0.9
"""Of the trajectory flown, with its take-off height of 0.8 m."""
TILT_DEG = 35.0
TILT_SLACK_DEG = 1.0
SINK_M_S = 1.5
OURS_STILL_S = 0.3
"""After somebody else has the vehicle, what it does for so long is what we left it with."""
NEAR_GROUND_M = 0.05


@dataclass(frozen=True, slots=True)
class Verdict:
    """A cell as flown. NaN: not reached, not judged."""

    cell: Cell
    rise_m: float
    """Greatest height above where it was when the end came, or above the plan where that is higher."""
    tilt_deg: float
    sink_m_s: float
    """When it met the ground."""
    taken_s: float
    """From the end to when our mode was left or the vehicle disarmed."""
    outcome: str
    text: str
    code: int | None
    broken: tuple[str, ...]

    def to_line(self) -> str:
        """JSON."""
        return json.dumps(asdict(self), ensure_ascii=False)


def judge(cell: Cell, flown: Flown) -> Verdict:
    """Judge by the stub's black box, or by the truth in the log where the endpoint is somebody else's."""
    end, box, struck_s = ENDS[cell.end], flown.box, flown.struck_at_s
    outcome, text = _last_word(flown)
    broken = _words(cell, flown, outcome, text)
    if not struck_s or not len(box):
        return _verdict(cell, flown, outcome, text, (*broken, "the moment never came"), (math.nan,) * 4)
    time_s, height = box[:, TIME], box[0, POSITION][2] - box[:, POSITION][:, 2]
    first = max(0, int(np.searchsorted(time_s, struck_s, "right")) - 1)
    ours = np.array([is_ours(cell.firmware, int(mode)) for mode in box[:, MODE]]) & (box[:, ARMED] > 0.0)
    left = np.flatnonzero(~ours[first:] & (np.cumsum(ours)[first:] > 0 if ours[: first + 1].any() else True))
    taken = first + int(left[0]) if len(left) else len(box) - 1
    taken_s = float(time_s[taken] - struck_s) if len(left) else math.nan
    last = int(np.searchsorted(time_s, time_s[taken] + OURS_STILL_S))
    span = slice(first, max(first + 1, last))
    goes_on = outcome == "completed"
    limit = max(float(height[first]), PLAN_TOP_M if goes_on else 0.0)
    rise = float(np.max(height[span])) - limit
    tilts = _tilt_deg(box[span])
    sink = _sink_at_ground(box, height, first)
    # the last thrust stands until the autopilot's own timeout
    unheard = cell.end.startswith("killed") or cell.end == "link lost"
    if rise > (RISE_UNHEARD_M if unheard and cell.level != "attitude" else RISE_M):
        broken = (*broken, f"rose {rise:.2f} m")
    if not end.falls and float(np.max(tilts)) > TILT_DEG + TILT_SLACK_DEG:
        broken = (*broken, f"tilted {float(np.max(tilts)):.0f}°")
    if not end.falls and sink > SINK_M_S:
        broken = (*broken, f"met the ground at {sink:.1f} m/s")
    if ours[-1] and not _left_to_autopilot(cell):
        broken = (*broken, "armed in our mode at the end: nobody has it")
    if "landed and disarmed" in text and (box[-1, ARMED] or height[-1] > 0.3):
        broken = (*broken, "says landed and disarmed, and is not")
    return _verdict(cell, flown, outcome, text, broken, (rise, float(np.max(tilts)), sink, taken_s))


def _verdict(
    cell: Cell,
    flown: Flown,
    outcome: str,
    text: str,
    broken: tuple[str, ...],
    numbers: tuple[float, float, float, float],
) -> Verdict:
    return Verdict(cell, *numbers, outcome, text, flown.code, broken)


def _left_to_autopilot(cell: Cell) -> bool:
    """ArduCopter that hears nobody levels and holds its height in GUIDED: its own action, and there is no other."""
    return cell.firmware == "ardupilot" and cell.end.startswith(("link lost", "killed"))


def _last_word(flown: Flown) -> tuple[str, str]:
    for line in reversed(flown.words):
        outcome, colon, text = line.partition(": ")
        if colon and outcome in OUTCOMES:
            return outcome, text
    return "", ""


def _words(cell: Cell, flown: Flown, outcome: str, text: str) -> tuple[str, ...]:
    """Exit code and last word against what was done."""
    if cell.end.startswith("killed"):
        return () if flown.code == -9 else (f"exit code {flown.code} of a killed companion",)
    if cell.end == "dead terminal":
        return () if flown.code == 0 else (f"exit code {flown.code} where nobody could read",)
    wanted = ENDS[cell.end].outcomes
    if cell.phase == "land" or (cell.phase == "prove setpoints" and cell.end == "autopilot restarts"):
        # what came too late, or too early, to change anything
        wanted = (*wanted, "completed")
    if outcome not in wanted:
        return (f"last word {outcome or 'missing'}: {text}",)
    return () if OUTCOMES[outcome] == flown.code else (f"exit code {flown.code} of {outcome}",)


def _tilt_deg(box: FloatArray) -> FloatArray:
    _, x, y, _ = box[:, QUATERNION].T
    degrees: FloatArray = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))
    return degrees


def _sink_at_ground(box: FloatArray, height: FloatArray, first: int) -> float:
    """Greatest speed downwards within NEAR_GROUND_M of the ground, after it was above; NaN where it was never above."""
    low = height[first:] < NEAR_GROUND_M
    if not (~low).any():
        return math.nan
    down = low & (np.cumsum(~low) > 0)
    return float(np.max(box[first:, VELOCITY][down][:, 2], initial=0.0))
