"""A tuning run: profile in, gains out; best so far kept at every improvement, so that stopping it loses nothing."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.config.errors import UserError
from companion.config.gains import ControllerGains, LoopGains
from companion.config.profile import LevelName, VehicleProfile
from companion.config.search_space import Parameter, search_space, to_vector, with_vector
from companion.control.laws import LAWS
from companion.control.structs import Vector
from companion.tuning.objective import Objective
from companion.tuning.search import Search


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a search stands."""

    evaluations: int
    budget: int
    best_cost: float
    start_cost: float
    elapsed_s: float


@dataclass(frozen=True, slots=True)
class Tuned:
    """What a search found."""

    gains: ControllerGains
    cost: float
    start_cost: float
    evaluations: int
    flights: int
    elapsed_s: float
    stopped: bool  # before the budget was used up


def certified(loop: LoopGains) -> LoopGains:
    """The loop with ε_max and W_max no larger than Propositions 1 and 2 allow for its α and κ.

    α ≥ κ W_max²/4 + ε_max. A quarter of α is left for what the network cannot explain.
    """
    if loop.alpha <= 0.0 or loop.kappa <= 0.0:
        return loop
    residual = min(loop.residual_bound, 0.25 * loop.alpha)
    largest = 2.0 * math.sqrt((loop.alpha - residual) / loop.kappa)
    bound = min(loop.weight_bound, math.floor(largest * 1e3) / 1e3)
    return loop.model_copy(
        update={"residual_bound": float(f"{residual:.4g}"), "weight_bound": max(bound, 1e-3)}
    )


STANDARD_START: dict[str, float] = {
    "position_loop.K_e[0][1]": 1.5,
    "position_loop.K_e[2]": 1.5,
    "position_loop.K_U[0][1]": 1.12,
    "position_loop.K_U[2]": 4.47,
    "position_loop.K_i[0][1]": 0.39,
    "position_loop.K_i[2]": 3.35,
    "position_loop.alpha": 0.28,
    "position_loop.boundary_width": 0.3,
    "position_loop.N": 0.84,
    "position_loop.kappa": 0.02,
    "lead.feedback_s": 0.12,
    "attitude_loop.K_e[0][1]": 6.0,
    "attitude_loop.K_e[2]": 3.0,
    "command_filter_rad_s": 12.0,
    "attitude_loop.K_U[0][1]": 8.0,
    "attitude_loop.K_U[2]": 4.0,
    "lead.rotor_filter_s": 0.02,
    "attitude_loop.K_i[0][1]": 8.0,
    "attitude_loop.K_i[2]": 3.0,
    "attitude_loop.alpha": 1.0,
    "attitude_loop.boundary_width": 0.5,
    "attitude_loop.N": 0.67,
    "attitude_loop.kappa": 0.1,
}
"""Where searches begin, per kg or kg·m² where a parameter is counted so: gentle gains that fly, the same for every law
and vehicle. A search from here is repeatable whatever has been written into the profile since."""


def standard_start(space: tuple[Parameter, ...]) -> Vector:
    """The point (n,) of `STANDARD_START` in a search space."""
    out = np.empty(len(space))
    for k, parameter in enumerate(space):
        value = STANDARD_START[parameter.name]
        if parameter.linear:
            out[k] = (value - parameter.low) / (parameter.high - parameter.low)
        else:
            out[k] = math.log(value / parameter.low) / math.log(parameter.high / parameter.low)
    return np.clip(out, 0.0, 1.0)


class Tuning:
    """One controller at one level of one profile. Raises UserError for what cannot be tuned."""

    def __init__(
        self,
        profile: VehicleProfile,
        controller: str,
        level: LevelName,
        objective: Objective,
        start: ControllerGains,
        seed: int,
        save: Path | None = None,
        from_profile: bool = False,
    ) -> None:
        entry = LAWS[controller]
        self.space: tuple[Parameter, ...] = search_space(
            level, has_network=entry.has_network, has_integral=entry.has_integral
        )
        self._profile, self._start, self._objective = profile, start, objective
        self._has_network = entry.has_network
        self._save, self._about = save, {"controller": controller, "level": level, "profile": profile.name}
        first = to_vector(self.space, start, profile) if from_profile else standard_start(self.space)
        if save is not None and save.exists():
            first = self._resumed(save)
        self.search = Search(first, seed=seed)

    def gains(self, vector: Vector) -> ControllerGains:
        """The gains that a point of the search stands for."""
        gains = with_vector(self.space, self._start, self._profile, vector)
        if not self._has_network:
            return gains
        return gains.model_copy(
            update={
                "position_loop": certified(gains.position_loop),
                "attitude_loop": certified(gains.attitude_loop),
            }
        )

    def run(self, budget: int, report: Callable[[Progress], None]) -> Tuned:
        """Search until `budget` sets of gains were flown, or Ctrl-C; the best of them either way."""
        began = time.monotonic()
        start_cost = math.inf
        stopped = False
        search = self.search
        try:
            # whole generations only, as many as the budget has room for
            while search.evaluations == 0 or search.evaluations + search.population <= budget:
                points = search.ask()
                best = search.best_cost
                costs = np.array([self._objective(self.gains(point)) for point in points])
                if not math.isfinite(start_cost):
                    start_cost = float(costs[0])
                search.tell(costs)
                if search.best_cost < best:
                    self._keep()
                elapsed = time.monotonic() - began
                report(Progress(search.evaluations, budget, search.best_cost, start_cost, elapsed))
                if search.step < 0.004:
                    break
        except KeyboardInterrupt:
            stopped = True
        return Tuned(
            self.gains(search.best),
            search.best_cost,
            start_cost,
            search.evaluations,
            self._objective.flights,
            time.monotonic() - began,
            stopped,
        )

    def _keep(self) -> None:
        if self._save is None:
            return
        body = self._about | {
            "cost": self.search.best_cost,
            "evaluations": self.search.evaluations,
            "point": {p.name: float(v) for p, v in zip(self.space, self.search.best, strict=True)},
            "gains": self.gains(self.search.best).model_dump(mode="json"),
        }
        partial = self._save.with_suffix(self._save.suffix + ".part")
        partial.write_text(json.dumps(body, indent=1), encoding="utf-8")
        partial.replace(self._save)

    def _resumed(self, save: Path) -> Vector:
        try:
            body: dict[str, Any] = json.loads(save.read_text(encoding="utf-8"))
            if any(body[key] != value for key, value in self._about.items()):
                raise UserError(
                    f"{save} holds {body['controller']} at level {body['level']} of {body['profile']}: "
                    "give another --save, or remove it"
                )
            return np.array([body["point"][parameter.name] for parameter in self.space])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{save}: is not the state of such a search ({error})") from None
