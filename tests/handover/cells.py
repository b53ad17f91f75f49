"""What the matrix is made of: moments, ends, firmwares, levels, headings."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator
from dataclasses import dataclass

from campaign.draw import WIDE_M, PlannedFlight, Variation

FIRMWARES = ("px4", "ardupilot")
LEVELS = ("attitude", "body_rate", "actuator")
HEADINGS_DEG = (0.0, 90.0, 180.0)
MIDDLE_S = {
    "prove setpoints": 0.5,
    "engage": 0.0,
    "arm": 0.0,
    "lift-off": 0.0,
    "climb": 0.5,
    "go to start": 0.4,
    "hold": 0.5,
    "run-in": 0.4,
    "track": 1.0,
    "run-out": 0.4,
    "return": 0.5,
    "land": 0.5,
}
"""Phases, and how long after its beginning the middle of each is, s of simulated time."""
LIFT_OFF_HOVERS = {"middle": 0.7, "leaving": 1.05}
"""Lift-off goes by thrust: moments, and the thrust at which they are, in hover thrusts."""
FLOWN_BY_LAW = ("climb", "go to start", "hold", "run-in", "track", "run-out", "return")
SUPERVISED = ("lift-off", *FLOWN_BY_LAW)


@dataclass(frozen=True, slots=True)
class End:
    """One way for a flight to end."""

    outcomes: tuple[str, ...]
    """Last words that are true of it."""
    phases: tuple[str, ...] = tuple(MIDDLE_S)
    """Where it can happen."""
    needs_stub: bool = False
    falls: bool = False
    """Motors stop, or somebody else flies: tilt and sink rate are not ours."""


_STOP = ("interrupted",)
_PILOT = ("pilot took over", "refused", "aborted")
ENDS: dict[str, End] = {
    "ctrl-c": End(_STOP),
    "ctrl-c twice": End(("handed back", "interrupted")),
    "sigterm": End(_STOP),
    "sighup": End(("completed",)),
    "dead terminal": End(("completed",)),
    "supervisor lands": End(("aborted",), SUPERVISED),
    "supervisor holds": End(("aborted",), SUPERVISED),
    "supervisor hands back": End(("handed back", "aborted"), SUPERVISED),
    "law refuses": End(("aborted",), FLOWN_BY_LAW),
    "exception in the law": End(("aborted",), FLOWN_BY_LAW),
    "mode frame lost once": End(_STOP),
    "mode frame lost three times": End(_STOP),
    "hold frame lost three times": End(("handed back", "aborted"), SUPERVISED),
    "ack lost": End(_STOP),
    "link lost": End(("link lost",)),
    "link lost and back": End(("link lost",)),
    "killed and started again": End(("killed",), needs_stub=True),
    "pilot by mode": End(_PILOT, ("arm", *SUPERVISED, "land"), needs_stub=True, falls=True),
    "pilot by sticks": End(_PILOT, ("arm", *SUPERVISED, "land"), needs_stub=True, falls=True),
    "pilot disarms": End(_PILOT, (*SUPERVISED, "land"), needs_stub=True, falls=True),
    "pilot kills": End(("pilot took over", "refused", "aborted", "handed back"), needs_stub=True, falls=True),
    "autopilot restarts": End(
        ("pilot took over", "refused", "aborted", "link lost"), needs_stub=True, falls=True
    ),
}


@dataclass(frozen=True, slots=True)
class Cell:
    """One flight of the matrix."""

    firmware: str
    level: str
    phase: str
    moment: str
    """`begin`, `middle`, or at lift-off `leaving`."""
    end: str
    heading_deg: float
    seed: int = 1

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.firmware}, {self.level}, {self.phase} ({self.moment}), {self.end}, {self.heading_deg:.0f}°"

    @property
    def planned(self) -> PlannedFlight:
        """The flight as the campaign's machinery flies it."""
        px4 = self.firmware == "px4"
        vehicle = "qball2" if px4 else "arducopter"
        return PlannedFlight(
            firmware=self.firmware,
            seed=self.seed,
            stub_firmware="px4-1.13" if px4 and self.level == "actuator" else self.firmware,
            profile=vehicle if px4 else "arducopter_sitl",
            vehicle=vehicle,
            variation=Variation(),
            wind_m_s=0.0,
            gust_m_s=0.0,
            estimator="mocap",
            level=self.level,
            controller="dtlannc",
            trajectory="lemniscate,scale=0.5",
            duration_s=2.0,
            fence_radius_m=WIDE_M,
        )


def all_cells(seed: int = 1) -> Iterator[Cell]:
    """Every cell there is, in order. ArduPilot takes no actuator controls."""
    for firmware, level, (name, end) in itertools.product(FIRMWARES, LEVELS, ENDS.items()):
        if (firmware, level) == ("ardupilot", "actuator"):
            continue
        for phase, heading in itertools.product(end.phases, HEADINGS_DEG):
            moments = ["begin"] if phase in ("engage", "arm") else ["begin", "middle"]
            moments += ["leaving"] if phase == "lift-off" else []
            for moment in moments:
                yield Cell(firmware, level, phase, moment, name, heading, seed)


def shuffled(cells: list[Cell], count: int | None, seed: int) -> list[Cell]:
    """`count` of the cells, drawn by `seed`; all of them in order where it is None."""
    return cells if count is None else random.Random(f"handover {seed}").sample(cells, min(count, len(cells)))
