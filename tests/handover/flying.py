"""One cell flown: against the stub in lockstep by the campaign's machinery, or against any endpoint in its own time."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
from campaign import flying
from campaign.flying import Flown
from campaign.processes import fork
from campaign.tape import (
    ARMED,
    BOX_WIDTH,
    MODE,
    POSITION,
    QUATERNION,
    TICK_WIDTH,
    TIME,
    VELOCITY,
    FloatArray,
    Tape,
)
from campaign.wire import armed_of, mode_of, read_wire

from handover.cells import Cell
from handover.strikes import SILENCE_S, Strike

_ENDS_WITHIN_S = 180.0
_TRIES = 30
"""Starts of `companion fly` at an endpoint whose vehicle still comes down from the cell before."""


def _settings(cell: Cell) -> list[str]:
    """More arguments of `companion fly`: the last `--set` of a value counts."""
    return ["--set", f"flight.safety.silence_s={SILENCE_S}"] if cell.end.startswith("link lost") else []


def fly_cell(cell: Cell, folder: Path) -> Flown:
    """Against the stub."""
    return flying.fly(
        cell.planned,
        folder,
        strike=lambda tape: Strike(cell, tape).install(),
        extra=_settings(cell),
        heading_rad=math.radians(cell.heading_deg),
        has_pilot=cell.end.startswith("pilot"),
        again=cell.end.startswith("killed"),
    )


def fly_at(cell: Cell, folder: Path, endpoint: str, profile: str | None) -> Flown:
    """Against a simulation at `endpoint`, which flies on by itself afterwards; the truth is what it publishes."""
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "flight.mcap"
    words = flying.arguments(cell.planned, log)
    if profile is not None:
        words[words.index("--profile") + 1] = profile
    began_s = time.monotonic()
    for number in range(_TRIES):
        tape = Tape()

        def companion_main(tape: Tape = tape) -> int:
            from companion.cli.main import main

            Strike(cell, tape).install()
            return main([*words, *_settings(cell), "--endpoint", endpoint])

        companion = fork(companion_main, folder / "companion.out", folder / "companion.err", folder)
        code = companion.wait(_ENDS_WITHIN_S)
        companion.end(0.0)
        if tape.struck_at_s or number == _TRIES - 1:
            break
        time.sleep(2.0)
    lines = tuple((folder / "companion.err").read_text(errors="replace").splitlines())
    box = _box_of(log)
    return Flown(
        planned=cell.planned,
        log=log,
        code=code,
        words=lines,
        output="",
        stub_code=0,
        stub_words="",
        wall_s=time.monotonic() - began_s,
        cpu_s=companion.cpu_s,
        box=box,
        ticks=np.empty((0, TICK_WIDTH)),
        companion_ended_s=float(box[-1, TIME]) if len(box) else math.nan,
        struck_at_s=tape.struck_at_s,
    )


def _box_of(log: Path) -> FloatArray:
    """(n, BOX_WIDTH) from a log's truth, modes and arming; empty where the vehicle publishes no truth."""
    from companion.flightlog.reader import read_log

    record = read_log(log)
    truth = record.channel("/truth")
    if truth is None:
        return np.empty((0, BOX_WIDTH))
    box = np.zeros((len(truth), BOX_WIDTH))
    box[:, TIME] = truth.time_s
    box[:, POSITION] = truth["position_enu"][:, [1, 0, 2]] * (1.0, 1.0, -1.0)
    box[:, VELOCITY] = truth["velocity_enu"][:, [1, 0, 2]] * (1.0, 1.0, -1.0)
    box[:, QUATERNION] = truth["quaternion_wxyz"]  # its tilt is the same in ENU/FLU
    for frame in read_wire(log, record.utc_offset_ns).frames:
        later = box[:, TIME] >= frame.time_s
        if not frame.outgoing and (mode := mode_of(frame)) is not None:
            box[later, MODE] = mode
        if not frame.outgoing and (armed := armed_of(frame)) is not None:
            box[later, ARMED] = armed
    return box
