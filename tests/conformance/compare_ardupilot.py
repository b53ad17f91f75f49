"""`scripts/conformance ardupilot`: fly the ArduPilot capture's session against the stub (or any endpoint), compare, print.

One line a comparison: what the capture shows, what was flown, ok or different. Differences that are meant carry
their reason, and count as differences. The exit code is 0 when at least 95 % agree and every difference has a reason.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import ardupilot_figures
import ardupilot_scenario
from compare import Line, report

FROM_S = 5.6
"""The capture begins here."""
TIMED_KINDS = {
    # figure: (name of a line, seconds that a change may be off)
    "acks": ("ack", 0.3),
    "heartbeats": ("heartbeat change", 1.05),  # each side on its own grid of a second
    "landed": ("landed state", 0.55),
    "sensors": ("sensor bits", 0.75),
}
MEANT = {
    "heartbeat change 12": "landed and not yet disarmed lasts half a second: a HEARTBEAT of the stub's phase misses it",
    "heartbeat change 13": "follows the one before",
    "ack 1": "asks for the stream the capture's clock is read from: when it came is not in the capture",
}


def flown_by_the_stub(seed: int) -> dict[str, Any]:
    """Figures of the session flown against the stub in lockstep, with the TIMESYNC rate of one without."""
    import timesync_rate

    from sitl_stub import Stub

    with Stub(firmware="ardupilot", estimator="perfect", seed=seed, lockstep=True) as stub:
        session = ardupilot_scenario.fly_scenario(stub.endpoint, alive=lambda: stub.running)
    figures = ardupilot_figures.figures(session.messages)
    _, figures["rates_hz"]["TIMESYNC"] = timesync_rate.rates_hz("ardupilot", (2, 3), speed=50.0)
    return figures


def _near(ours: Any, theirs: Any, relative: float, absolute: float = 0.0) -> bool:
    if not isinstance(ours, (int, float)) or not isinstance(theirs, (int, float)):
        return bool(ours == theirs)
    return abs(ours - theirs) <= relative * abs(theirs) + absolute


def compare(flown: dict[str, Any], captured: dict[str, Any]) -> Iterator[Line]:
    """Every comparison, in order."""
    for key, (kind, tolerance_s) in TIMED_KINDS.items():
        for index, (ours, theirs) in enumerate(zip_longest(flown[key], captured[key])):
            same = ours is not None and theirs is not None and ours[1:] == theirs[1:]
            # the first entry is how the capture began, not when something changed
            timely = same and ((index == 0 and key != "acks") or abs(ours[0] - theirs[0]) <= tolerance_s)
            yield Line(f"{kind} {index + 1}", str(theirs), str(ours), bool(timely))
    texts = [
        [(severity, words.split(" at ")[0]) for t, severity, words in side["texts"] if t >= FROM_S]
        for side in (captured, flown)
    ]
    for index, (theirs, ours) in enumerate(zip_longest(*texts)):
        yield Line(f"text {index + 1}", str(theirs), str(ours), theirs == ours)
    for name in sorted({*captured["rates_hz"], *flown["rates_hz"]}):
        theirs, ours = captured["rates_hz"].get(name, 0.0), flown["rates_hz"].get(name, 0.0)
        yield Line(f"rate of {name}", f"{theirs:g} Hz", f"{ours:g} Hz", _near(ours, theirs, 0.1, 0.02))
    for step, values in captured["steps"].items():
        for name, theirs, ours in zip(
            ("t10", "t63", "peak"), values, flown["steps"].get(step, ()), strict=True
        ):
            yield Line(f"step {step} {name}", str(theirs), str(ours), _near(ours, theirs, 0.15))
    for name, relative, absolute in (
        ("first_position_s", 0.0, 0.3),
        ("off_the_ground_after_target_s", 0.0, 0.3),
        ("hover_thrust", 0.02, 0.0),
        ("height_after_timeout_m", 0.0, 0.15),
        ("parameter_count", 0.0, 0.0),
        ("unknown_parameter_answered", 0.0, 0.0),
        ("flight_sw_version", 0.0, 0.0),
    ):
        agrees = _near(flown[name], captured[name], relative, absolute)
        yield Line(name, str(captured[name]), str(flown[name]), agrees)


def main(arguments: list[str] | None = None) -> int:
    """Fly, compare, print; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="scripts/conformance ardupilot",
        description=__doc__,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument(
        "--endpoint", help="an autopilot just started, e.g. tcp:127.0.0.1:5760 (default: the stub)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the stub")
    parser.add_argument("--all", action="store_true", help="print the agreements as well")
    options = parser.parse_args(arguments)
    if options.endpoint:
        flown = ardupilot_figures.figures(ardupilot_scenario.fly_scenario(options.endpoint).messages)
    else:
        flown = flown_by_the_stub(options.seed)
    return report(compare(flown, ardupilot_figures.capture_figures()), MEANT, "ArduPilot", options.all)


if __name__ == "__main__":
    raise SystemExit(main())
