"""Defects put into the companion on purpose, in the forked process of a flight: would the campaign notice?

Each comes with the flights that could show it (most defects need a certain kind of trouble to matter), and how many of
those are flown before the campaign has to admit that it is blind.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from campaign.draw import WIDE_M, PlannedFlight, planned

FLIGHTS_TO_CATCH = 12
LAST_SEED = 100_000


@dataclass(frozen=True)
class Defect:
    """One defect. `plant` is called in the companion's process before its main function."""

    summary: str
    plant: Callable[[], None]
    concerns: Callable[[PlannedFlight], bool]


def _replace(owner: Any, name: str, with_what: Any) -> None:
    """Put something else in the place of a function or class."""
    if not hasattr(owner, name):
        raise AttributeError(f"{owner} has no {name} any more: the planted defect has to follow")
    setattr(owner, name, with_what)


def _ignore_fence() -> None:
    import companion.flight.supervisor as supervisor

    _replace(supervisor, "horizontal_margin", lambda fence, east_m, north_m: 100.0)


def _keep_sending() -> None:
    from companion.flight.control_loop import ControlLoop

    _replace(ControlLoop, "stop", lambda loop: None)


def _nan_ungated() -> None:
    """The law answers NaN once in a while, and the gate lets everything pass."""
    from companion.flight.setpoint_gate import SetpointGate

    _nan_from_the_law()
    _replace(SetpointGate, "refusal", lambda gate, setpoint, thrust, controls=None: "")


def _nan_from_the_law() -> None:
    from dataclasses import replace

    from companion.control.law import ControlLaw

    step_packed = ControlLaw.step_packed
    count = 0

    def broken(law: Any, memory: Any, inputs: Any) -> Any:
        nonlocal count
        count += 1
        result = step_packed(law, memory, inputs)
        if count % 400:
            return result
        nothing = np.full(3, np.nan)
        return replace(result, setpoint=replace(result.setpoint, thrust_newton=np.nan, body_rate_flu=nothing))

    _replace(ControlLaw, "step_packed", broken)


def _never_flush() -> None:
    import companion.flightlog.writer as writer

    flight_log = writer.FlightLog.__init__

    def lazy(log: Any, *given: Any, **named: Any) -> None:
        flight_log(log, *given, **{**named, "flush_interval_s": 1e6})

    _replace(writer.FlightLog, "__init__", lazy)


def _always_zero() -> None:
    from companion.flight.outcome import Outcome

    _replace(Outcome, "exit_code", property(lambda outcome: 0))


def _adapt_backwards() -> None:
    import companion.flight.session as session

    build: Any = vars(session)["build_law"]

    def built(*given: Any, **named: Any) -> Any:
        law = build(*given, **named)
        for loop in ("position", "attitude"):
            law.parameters[loop]["N"] *= -1.0
        return law

    _replace(session, "build_law", built)


def _attacked(one: PlannedFlight) -> bool:
    return one.fence_radius_m < WIDE_M and one.has("gust", "payload_drop", "link_delay", "link_jitter")


def _adapting(one: PlannedFlight) -> bool:
    return one.quiet and one.controller != "tlmbc" and one.estimator != "gps" and not one.as_command


DEFECTS: dict[str, Defect] = {
    "fence-ignored": Defect("the supervisor ignores the fence", _ignore_fence, _attacked),
    "setpoints-go-on": Defect(
        "setpoints go on after a takeover or the end",
        _keep_sending,
        lambda one: one.has("pilot_mode", "ctrl_c", "battery_critical", "pilot_sticks"),
    ),
    "nan-gate-off": Defect(
        "the law answers NaN at every 400th step, and the gate before the wire lets it pass",
        _nan_ungated,
        lambda one: one.quiet and one.level != "actuator",
    ),
    "log-not-flushed": Defect(
        "the log is written at the end only", _never_flush, lambda one: one.has("companion_killed")
    ),
    "always-exit-0": Defect(
        "the exit code is 0 whatever happened",
        _always_zero,
        lambda one: one.has("ctrl_c", "pilot_mode", "battery_critical"),
    ),
    "adapts-backwards": Defect("the adaptation's sign is flipped", _adapt_backwards, _adapting),
}
"""By name, for `--plant`."""


def candidates(defect: Defect, firmware: str, first_seed: int) -> Iterator[PlannedFlight]:
    """Flights from `first_seed` on that the defect concerns, FLIGHTS_TO_CATCH of them."""
    found = 0
    for seed in range(first_seed, LAST_SEED):
        one = planned(firmware, seed)
        if not one.as_command and defect.concerns(one):
            yield one
            found += 1
            if found == FLIGHTS_TO_CATCH:
                return
