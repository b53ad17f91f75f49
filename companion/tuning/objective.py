"""What makes gains good: the report's figures as the measure, in calm and in rough circumstances alike.

One number for each set of gains. Its parts are ratios to the same fixed goals for every controller and level, so that a
comparison between controllers is one between laws and not between amounts of care.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from companion.config.gains import ControllerGains
from companion.config.profile import LevelName, VehicleProfile
from companion.config.settings import DEFAULT_RATE_HZ
from companion.control.structs import ControlLevel
from companion.tuning.flight import Outcome, PlantChoice, Scenario, TrialFlight
from companion.tuning.reference_table import reference_table

POSITION_GOAL_M = np.array([0.0448, 0.0216, 0.0238])
"""The report's DTLANNC, section 7 of the control laws."""
ATTITUDE_GOAL_RAD = np.radians([1.1505, 1.1638, 0.2834])
SHAKE_GOAL_RAD_S = 0.15
"""Body rate beyond the reference's own that is still calm: 0.15 rad/s is 1° at 8 rad/s."""
HOLD_GOAL_M = 0.01
LOST = 30.0
"""Score of a flight that is lost at once; one lost at the end counts half of it."""
WORST_SHARE, ROUGH_SHARE = 0.25, 0.5

CALM = (Scenario("calm, seed 1", seed=1), Scenario("calm, seed 2", seed=2))
ROUGH = (
    Scenario("slow and weak", seed=3, lag_factor=1.25, delay_s=0.02, thrust_factor=0.8),
    Scenario("fast and strong", seed=4, lag_factor=0.8, delay_s=-0.02, thrust_factor=1.2),
    Scenario("m̂ 60 %, gusts", seed=5, mass_ratio=0.6, gust_newton=0.4),
    Scenario("m̂ 130 %, jitter", seed=6, mass_ratio=1.3, jitter_s=0.008),
)
"""What a search flies: every circumstance of `STRESS`, several at a time."""

STRESS = (
    Scenario("lag +25 %", seed=11, lag_factor=1.25),
    Scenario("lag -25 %", seed=12, lag_factor=0.75),
    Scenario("dead time +20 ms", seed=13, delay_s=0.02),
    Scenario("dead time -20 ms", seed=14, delay_s=-0.02),
    Scenario("thrust +20 %", seed=15, thrust_factor=1.2),
    Scenario("thrust -20 %", seed=16, thrust_factor=0.8),
    Scenario("m̂ 60 %", seed=17, mass_ratio=0.6),
    Scenario("m̂ 130 %", seed=18, mass_ratio=1.3),
    Scenario("gusts 0.4 N", seed=19, gust_newton=0.4),
    Scenario("jitter 8 ms", seed=20, jitter_s=0.008),
)
"""One at a time, to show afterwards that what was found is not knife-edge. Seeds that no search has seen."""


def score(outcome: Outcome) -> float:
    """One flight as a number; 1 means about the report's DTLANNC in every respect, less is better."""
    if outcome.flown < 1.0:
        return LOST * (1.0 - 0.5 * outcome.flown)
    position = float(np.sqrt(np.mean((outcome.position_rms_m / POSITION_GOAL_M) ** 2)))
    ratios = outcome.attitude_rms_rad / ATTITUDE_GOAL_RAD
    attitude = float(np.sqrt(np.mean(ratios**2)))
    beyond = float(np.sum(np.maximum(0.0, ratios[:2] - 0.8) ** 2))
    shake = float(np.max(outcome.shake_rms_rad_s)) / SHAKE_GOAL_RAD_S
    hold = float(np.mean(outcome.hold_rms_m)) / HOLD_GOAL_M
    return position + 0.15 * attitude + min(2.0 * beyond, 0.5) + 0.1 * shake**2 + 0.05 * hold


@dataclass(frozen=True, slots=True)
class Flown:
    """One scenario with what came of it."""

    scenario: Scenario
    outcome: Outcome


class Objective:
    """The cost of gains for one controller at one level of a profile; lower is better."""

    def __init__(
        self,
        profile: VehicleProfile,
        autopilot: str,
        controller: str,
        level: LevelName,
        plant: PlantChoice,
        trajectory: str = "lemniscate",
        track_s: float = 14.0,
    ) -> None:
        self._fixed = (profile, autopilot, controller, level)
        self._plant = plant
        self._table = self._tabulated(trajectory, track_s)
        self._whole = self._tabulated(trajectory, 40.0)
        self._calm = [self._flight(scenario) for scenario in CALM]
        self._rough = [self._flight(scenario) for scenario in ROUGH]
        self.flights = 0
        # compiled flights let go of the interpreter, and each has arrays of its own
        self._cores = ThreadPoolExecutor(os.cpu_count())

    def _tabulated(self, trajectory: str, track_s: float):  # type: ignore[no-untyped-def]
        profile, autopilot, _, level = self._fixed
        ahead_s = profile.response(autopilot).dead_time(ControlLevel(level))
        return reference_table(trajectory, DEFAULT_RATE_HZ[level], ahead_s, track_s)

    def _flight(self, scenario: Scenario, whole: bool = False) -> TrialFlight:
        profile, autopilot, controller, level = self._fixed
        table = self._whole if whole else self._table
        return TrialFlight(profile, autopilot, controller, level, scenario, table, self._plant)

    def __call__(self, gains: ControllerGains) -> float:
        """Mean over the calm flights, half the mean of the rough ones, and a quarter of the worst."""
        flights = [*self._calm, *self._rough]
        scores = list(self._cores.map(lambda flight: score(flight.fly(gains)), flights))
        calm, rough = scores[: len(self._calm)], scores[len(self._calm) :]
        self.flights += len(flights)
        return float(np.mean(calm) + ROUGH_SHARE * np.mean(rough) + WORST_SHARE * max(rough))

    def verify(self, gains: ControllerGains, seeds: Sequence[int] = (1, 2, 3, 4, 5)) -> Iterator[Flown]:
        """Fly the whole 40 s for every seed, then each of `STRESS`."""
        calm = tuple(Scenario(f"seed {seed}", seed=seed) for seed in seeds)
        yield from self._cores.map(
            lambda scenario: Flown(scenario, self._flight(scenario, whole=True).fly(gains)), calm + STRESS
        )
