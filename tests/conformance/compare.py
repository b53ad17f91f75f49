"""`scripts/conformance`: fly the PX4 capture's session against the stub (or any endpoint) and print what agrees.

One line a comparison: what the capture shows, what was flown, ok or different. Differences that are meant carry
their reason, and count as differences. The exit code is 0 when at least 95 % agree and every difference has a reason.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import px4_scenario
import wire_figures

MEANT = {
    "rate of PARAM_VALUE": "the parameter list is sent at the stub's own pace",
    "landed state 6": "the capture's estimate went on sinking after touch-down, at up to 0.36 m/s where LNDMC_Z_VEL_MAX is "
    "0.25 m/s, until 3 s before; the stub's stays on the ground",
    "heartbeat change 15": "follows the landing above",
    "step roll rate t10": "10 % of the step is 0.06 rad/s and the capture's gyro noise 0.14 rad/s: a draw of the noise",
}
LEAST_AGREEMENT = 0.95


def flown_by_the_stub(seed: int) -> dict[str, Any]:
    """Figures of the session flown against the stub in lockstep, with the TIMESYNC rates of one without."""
    import timesync_rate

    from sitl_stub import Stub

    with Stub(vehicle="px4_sih", estimator="gps", seed=seed, lockstep=True) as stub:
        session = px4_scenario.fly_scenario(stub.endpoint, alive=lambda: stub.running)
    figures = wire_figures.figures(session.messages)
    unasked, asked = timesync_rate.rates_hz("px4", (16, 30), speed=5.0)
    figures["default_rates_hz"]["TIMESYNC"], figures["asked_rates_hz"]["TIMESYNC"] = unasked, asked
    return figures


@dataclass(frozen=True)
class Line:
    """One comparison."""

    what: str
    captured: str
    flown: str
    agrees: bool


def _near(a: float | None, b: float | None, relative: float, absolute: float = 0.0) -> bool:
    if a is None or b is None:
        return a is b
    return abs(a - b) <= relative * abs(b) + absolute


def compare(flown: dict[str, Any], captured: dict[str, Any]) -> Iterator[Line]:
    """Every comparison, in order."""
    for kind, key in (("ack", "acks"), ("heartbeat change", "heartbeats"), ("landed state", "landed")):
        tolerance = 1.05 if key == "heartbeats" else 0.3
        for index in range(max(len(flown[key]), len(captured[key]))):
            ours = flown[key][index] if index < len(flown[key]) else None
            theirs = captured[key][index] if index < len(captured[key]) else None
            same = ours is not None and theirs is not None and ours[1:] == theirs[1:]
            # the first entries are how the capture began, not when something changed
            timely = same and (
                index == 0 or (key == "heartbeats" and index == 1) or abs(ours[0] - theirs[0]) <= tolerance
            )
            yield Line(f"{kind} {index + 1}", str(theirs), str(ours), bool(timely))
    for key, window_s in (("default_rates_hz", 1.5), ("asked_rates_hz", 25.0)):
        for name, rate in captured[key].items():
            got = flown[key].get(name, 0.0)
            yield Line(
                f"rate of {name}", f"{rate:g} Hz", f"{got:g} Hz", _near(got, rate, 0.1, 1.0 / window_s)
            )
    for step, values in captured["steps"].items():
        for name, theirs, ours in zip(
            ("t10", "t63", "peak"), values, flown["steps"].get(step, [None] * 3), strict=True
        ):
            agrees = _near(ours, theirs, 0.15, 0.02 if name != "peak" else 0.0)
            yield Line(f"step {step} {name}", str(theirs), str(ours), agrees)
    for name in ("parameter_count", "unknown_parameter_answered", "flight_sw_version"):
        yield Line(name, str(captured[name]), str(flown[name]), captured[name] == flown[name])


def main(arguments: list[str] | None = None) -> int:
    """Fly, compare, print; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="scripts/conformance", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--endpoint", help="an autopilot that runs already, e.g. udpin:0.0.0.0:14540 (default: the stub)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the stub")
    parser.add_argument("--all", action="store_true", help="print the agreements as well")
    options = parser.parse_args(arguments)
    if options.endpoint:
        flown = wire_figures.figures(px4_scenario.fly_scenario(options.endpoint).messages)
    else:
        flown = flown_by_the_stub(options.seed)
    return report(compare(flown, wire_figures.capture_figures()), MEANT, "PX4", options.all)


def report(lines: Iterable[Line], meant: Mapping[str, str], whose: str, everything: bool) -> int:
    """Print what differs (or everything) and the total; 0 when 95 % agree and every difference has a reason."""
    lines = list(lines)
    unexplained = 0
    for line in lines:
        reason = "" if line.agrees else meant.get(line.what, "")
        unexplained += not (line.agrees or reason)
        if everything or not line.agrees:
            verdict = "ok" if line.agrees else f"meant: {reason}" if reason else "DIFFERENT"
            print(f"{line.what:34} {line.captured:>44} {line.flown:>44}  {verdict}")
    agreed = sum(line.agrees for line in lines)
    differ = len(lines) - agreed
    print(
        f"{agreed} of {len(lines)} agree with the {whose} capture: {100 * agreed / len(lines):.1f} %. "
        f"{differ} differ, {differ - unexplained} of them with a reason"
    )
    return 0 if agreed >= LEAST_AGREEMENT * len(lines) and not unexplained else 1


if __name__ == "__main__":
    raise SystemExit(main())
