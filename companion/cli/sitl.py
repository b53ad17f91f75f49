"""Starting the bundled autopilot stub for a flight (`--sitl`), and making sure that it ends with it.

The stub is another program: it is started as a process and spoken to over its socket, like any autopilot.
"""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from companion.config.errors import UserError

FIRMWARES = ("px4", "px4-1.13", "ardupilot")
START_TIMEOUT_S = 60.0
STUB_PROFILES = {"px4": "qball2", "px4-1.13": "qball2", "ardupilot": "arducopter_sitl"}
"""Profiles of the vehicles that the stub flies where nobody chooses one, with the report's m̂ = 70 %."""
STUB_PATIENCE = "flight.procedure.connect_timeout_s=300"
"""Setting for a flight against the stub: on a new machine it compiles before its first HEARTBEAT."""
AIRBORNE = ("--airborne", "2", "--param", "GUID_OPTIONS=8", "--param", "ATC_ANGLE_BOOST=0")
"""Options of a stub that hovers already; parameters of a vehicle that flies are not set, so an ArduCopter has them so."""


def airborne(firmware: str) -> Sequence[str]:
    """Options for a stub of `firmware` (one of FIRMWARES) that hovers already."""
    return AIRBORNE if firmware == "ardupilot" else AIRBORNE[:2]


@contextmanager
def running_stub(firmware: str, seed: int, options: Sequence[str]) -> Iterator[str]:
    """Run the stub; yields the endpoint to fly to.

    Args:
        firmware: one of FIRMWARES.
        seed: of its noise and wind.
        options: further options of `sitl-stub`, as words.

    Raises:
        UserError: it did not start; the message is its own.
    """
    command = [
        sys.executable,
        "-m",
        "sitl_stub",
        "--firmware",
        firmware,
        "--seed",
        str(seed),
        "--port",
        "0",
        "--json",
        "--die-with-parent",  # also when we are killed
        str(os.getpid()),
    ]
    process = subprocess.Popen(
        [*command, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for the flight: the stub must live to see the landing
    )
    try:
        yield _endpoint(process)
    finally:
        process.terminate()
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _endpoint(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None and process.stderr is not None
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        line = process.stdout.readline() if selector.select(START_TIMEOUT_S) else ""
    if not line:
        process.kill()
        said = process.stderr.read().strip()
        raise UserError(
            f"the bundled stub did not start: {said or 'it said nothing; try sitl-stub by itself'}"
        )
    return str(json.loads(line)["endpoint"])
