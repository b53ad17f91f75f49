"""What the tests of engagements in the air share: a stub that hovers already, and how far an engagement threw it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from companion.flightlog.reader import FlightRecord
from companion.mavlink.frames import angle_between

READY_TO_BE_FLOWN = ("--param", "GUID_OPTIONS=8", "--param", "ATC_ANGLE_BOOST=0")
"""What an ArduCopter needs beforehand: parameters of a vehicle that flies are not set."""
WITHIN_S = 2.0
TURNS_WITHIN_S = 0.25  # what comes later is the plan's own: from 2 m/s it brakes


def airborne(firmware: str, *words: str) -> list[str]:
    """Words for a stub of `firmware` that hovers at 3 m."""
    return [
        "--airborne",
        "3",
        *(READY_TO_BE_FLOWN if firmware == "ardupilot" else ()),
        *words,
    ]


def scenario(folder: Path, *faults: str) -> list[str]:
    """Words for a scenario of these faults, each the lines of one table."""
    file = folder / "scenario.toml"
    file.write_text("\n".join(f"[[fault]]\n{fault}" for fault in faults))
    return ["--scenario", str(file)]


def jumps(record: FlightRecord) -> list[tuple[float, float]]:
    """By truth, for each engagement: how far (m) the vehicle came off its reference, and how far (°) it turned."""
    truth, reference = record.channel("/truth"), record.channel("/reference")
    assert truth is not None and reference is not None
    found = []
    for event in record.events_of("engaged"):
        asked = (reference.time_s >= event.time_s - 1e-6) & (reference.time_s <= event.time_s + WITHIN_S)
        times = reference.time_s[asked]
        off_m = 0.0
        where = np.column_stack(
            [np.interp(times, truth.time_s, truth["position_enu"][:, axis]) for axis in range(3)]
        )
        # how far apart estimate and truth are at that moment is not the engagement's doing
        apart = where - reference["position_enu"][asked]
        off_m = float(np.linalg.norm(apart - apart[0], axis=1).max())
        at = int(np.searchsorted(truth.time_s, event.time_s))
        soon = int(np.searchsorted(truth.time_s, event.time_s + TURNS_WITHIN_S))
        attitudes = truth["quaternion_wxyz"][at:soon]
        turned = max(float(np.degrees(angle_between(attitudes[0], each))) for each in attitudes)
        found.append((off_m, turned))
    return found
