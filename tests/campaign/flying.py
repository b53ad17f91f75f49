"""One flight: both programs started, watched, waited for; what is left of it is handed over for judging."""

from __future__ import annotations

import json
import math
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from campaign.draw import PlannedFlight
from campaign.faults import scenario
from campaign.instruments import watch_companion, watch_stub
from campaign.processes import Child, fork
from campaign.tape import (
    ARMED,
    BODY_RATE,
    BOX_WIDTH,
    POSITION,
    QUATERNION,
    TICK_WIDTH,
    TIME,
    VELOCITY,
    FloatArray,
    Tape,
)

WALL_LIMIT_S = 600.0
"""Our time that a flight may take; on an idle machine it takes 4 s."""
FREE_SPEED = 20.0
"""How much faster than real time the stub goes on when its companion is gone."""
AGAIN_SPEED = 2.0
"""The same where another one follows: it must find the vehicle where it was left, not landed long ago."""
AFTERWARDS_S = 90.0
"""Simulated time that an autopilot has to bring down what was left in the air."""
HANDED_BACK_S = 6.0
"""Simulated time that a vehicle handed back is looked at."""
STANDS_M = 0.4
"""A vehicle not higher than this stands, and is looked at until it is disarmed."""
LOOKING_ON_S = 180.0
"""Our time for that."""
_STARTING_S = 60.0


@dataclass(frozen=True)
class Flown:
    """What a flight left."""

    planned: PlannedFlight
    log: Path
    code: int | None
    """The companion's exit code, negative for a signal; None when it had to be ended."""
    words: tuple[str, ...]
    """Its lines on standard error."""
    output: str
    stub_code: int
    stub_words: str
    wall_s: float
    cpu_s: float
    box: FloatArray = field(repr=False)
    """(n, BOX_WIDTH), see `campaign.tape`; empty for a flight flown as a command."""
    ticks: FloatArray = field(repr=False)
    companion_ended_s: float = math.nan
    """Simulated time when the companion was gone."""
    armed_at_s: float = math.nan
    struck_at_s: float = 0.0


def arguments(planned: PlannedFlight, log: Path) -> list[str]:
    """Of `companion fly`, without the endpoint."""
    words = ["fly", "--profile", planned.profile, "--controller", planned.controller]
    words += ["--level", planned.level, "--trajectory", planned.trajectory]
    words += ["--duration", f"{planned.duration_s:g}", "--seed", str(planned.seed % 1000)]
    words += ["--log", str(log), "--overwrite", "--json", "--fix"]
    if any("autopilot" in str(fault.value("senders")) for fault in planned.faults):
        words += ["--system", "1"]  # two autopilots are refused where nobody says which
    for text in planned.overrides():
        words += ["--set", text]
    return words


def stub_options(planned: PlannedFlight, folder: Path) -> list[str]:
    """Of `sitl-stub` that make this flight; writes the files that they name into `folder`."""
    vehicle = folder / "vehicle.toml"
    vehicle.write_text(planned.vehicle_file())
    words = ["--vehicle", str(vehicle), "--estimator", planned.estimator, "--lockstep"]
    words += ["--wind", f"{planned.wind_m_s:g},{planned.gust_m_s:g}"]
    words += ["--ready-after", "1"] if planned.firmware == "ardupilot" else []
    if planned.faults:
        file = folder / "scenario.toml"
        file.write_text(scenario(planned.seed, planned.faults))
        words += ["--scenario", str(file)]
    return words


def fly(
    planned: PlannedFlight,
    folder: Path,
    plant: Callable[[], None] | None = None,
    strike: Callable[[Tape], None] | None = None,
    extra: Sequence[str] = (),
    heading_rad: float = 0.0,
    has_pilot: bool = False,
    again: bool = False,
) -> Flown:
    """Fly in `folder` (made, and kept). `plant` is called in the companion's process first: a defect on purpose.

    `strike` is called there too (the hand-over matrix), `extra` are more arguments of `companion fly`, the vehicle stands
    with its nose to `heading_rad` and has a radio where `has_pilot`; `again` starts a killed companion anew at once.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # What a pilot has taken may hover for ever, and the command is right to log it for as long: that needs our own clock.
    has_end = not any(fault.kind in ("pilot_mode", "pilot_sticks") for fault in planned.faults)
    if planned.as_command and has_end and plant is None:
        return _fly_as_command(planned, folder)
    began_s = time.monotonic()
    tape = Tape()
    stub = _start_stub(planned, folder, tape, heading_rad, has_pilot, AGAIN_SPEED if again else FREE_SPEED)
    log = folder / "flight.mcap"
    try:
        endpoint = _endpoint(stub, folder)

        def companion_main() -> int:
            from companion.cli.main import main

            watch_companion(tape, planned.kill_at_s, planned.interrupts_at_s)
            if plant is not None:
                plant()
            if strike is not None:
                strike(tape)
            return main([*arguments(planned, log), *extra, "--endpoint", endpoint])

        def second_main() -> int:
            from companion.cli.main import main

            return main([*arguments(planned, folder / "again.mcap"), *extra, "--endpoint", endpoint])

        companion = fork(companion_main, folder / "companion.out", folder / "companion.err", folder)
        try:
            code = companion.wait(WALL_LIMIT_S)
            ended_s = tape.now_s
            if again and code == -9:
                # The stub goes on before the second takes the port: else it would wait for the dead one's answer.
                tape.companion_gone = True
                deadline = time.monotonic() + _STARTING_S
                while tape.now_s <= ended_s and stub.poll() is None and time.monotonic() < deadline:
                    time.sleep(0.001)
                tape.companion_gone = False
                second = fork(second_main, folder / "again.out", folder / "again.err", folder)
                second.wait(WALL_LIMIT_S)
                second.end(0.0)
        finally:
            companion.end(0.0)
            tape.companion_gone = True
        _look_on(stub, tape, ended_s)
    finally:
        stub.end()
    return Flown(
        planned=planned,
        log=log,
        code=code,
        words=_lines(folder / "companion.err"),
        output=(folder / "companion.out").read_text(errors="replace"),
        stub_code=stub.code if stub.code is not None else -1,
        stub_words=(folder / "stub.err").read_text(errors="replace"),
        wall_s=time.monotonic() - began_s,
        cpu_s=companion.cpu_s + stub.cpu_s,
        box=tape.box.copy(),
        ticks=tape.ticks.copy(),
        companion_ended_s=ended_s,
        armed_at_s=tape.armed_at_s,
        struck_at_s=tape.struck_at_s,
    )


def _start_stub(
    planned: PlannedFlight, folder: Path, tape: Tape, heading_rad: float, has_pilot: bool, speed: float
) -> Child:
    options = [
        "--firmware",
        planned.stub_firmware,
        "--seed",
        str(planned.seed % 1000),
        "--port",
        "0",
        "--json",
    ]
    options += ["--die-with-parent", *stub_options(planned, folder), "--speed", f"{speed:g}"]

    def stub_main() -> int:
        watch_stub(tape, planned.gone_at_s, heading_rad, has_pilot)
        from sitl_stub.cli import main

        return main(options)

    (folder / "stub.out").write_text("")
    return fork(stub_main, folder / "stub.out", folder / "stub.err", folder)


def _endpoint(stub: Child, folder: Path) -> str:
    deadline = time.monotonic() + _STARTING_S
    while time.monotonic() < deadline:
        line, newline, _ = (folder / "stub.out").read_text().partition("\n")
        if newline:
            return str(json.loads(line)["endpoint"])
        if stub.poll() is not None:
            raise RuntimeError(f"the stub ended at once: {(folder / 'stub.err').read_text().strip()}")
        time.sleep(0.005)
    raise RuntimeError("the stub did not start")


def _look_on(stub: Child, tape: Tape, ended_s: float) -> None:
    """Let the stub fly on without its companion until the vehicle is down, rests in the air, or time is up."""
    deadline = time.monotonic() + LOOKING_ON_S
    while stub.poll() is None and time.monotonic() < deadline:
        box = tape.box
        if not len(box) or not box[-1, ARMED] or box[-1, TIME] - ended_s > AFTERWARDS_S:
            return
        hangs = box[0, POSITION][2] - box[-1, POSITION][2] > STANDS_M and rests(box[-1])
        if hangs and box[-1, TIME] - ended_s > HANDED_BACK_S + 6.0 and _was_resting(box):
            return
        time.sleep(0.02)


def rests(row: FloatArray) -> bool:
    """Whether a row of the black box shows a vehicle that keeps its height, level; ArduCopter drifts with the wind then."""
    _, x, y, _ = row[QUATERNION]
    level = 1.0 - 2.0 * float(x * x + y * y) > math.cos(math.radians(20.0))
    still = abs(float(row[VELOCITY][2])) < 0.5 and float(np.linalg.norm(row[BODY_RATE])) < 0.8
    return level and still


def _was_resting(box: FloatArray) -> bool:
    since = box[box[:, TIME] > box[-1, TIME] - HANDED_BACK_S]
    return all(rests(row) for row in since[::10])


def _lines(path: Path) -> tuple[str, ...]:
    return tuple(path.read_text(errors="replace").splitlines())


def _fly_as_command(planned: PlannedFlight, folder: Path) -> Flown:
    """As a user does: `companion fly --sitl`, a process that imports everything anew."""
    began_s = time.monotonic()
    log = folder / "flight.mcap"
    words = [word for word in stub_options(planned, folder) if word != "--lockstep"]
    options = shlex.join([*words, "--speed", f"{FREE_SPEED:g}"])
    words = [sys.executable, "-m", "companion.cli.main", *arguments(planned, log)]
    words += ["--sitl", planned.stub_firmware, "--sitl-options", options]
    code: int | None = None
    try:
        done = subprocess.run(
            words, cwd=folder, check=False, capture_output=True, text=True, timeout=WALL_LIMIT_S
        )
        code, output, errors = done.returncode, done.stdout, done.stderr
    except subprocess.TimeoutExpired as late:
        output, errors = str(late.stdout or ""), str(late.stderr or "")
    nothing = np.empty((0, BOX_WIDTH))
    return Flown(
        planned=planned,
        log=log,
        code=code,
        words=tuple(errors.splitlines()),
        output=output,
        stub_code=0,
        stub_words="",
        wall_s=time.monotonic() - began_s,
        cpu_s=0.0,
        box=nothing,
        ticks=np.empty((0, TICK_WIDTH)),
    )
