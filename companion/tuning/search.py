"""CMA-ES: covariance matrix adaptation, after Hansen, "The CMA Evolution Strategy: A Tutorial" (arXiv:1604.00772).

Seeded and pure: `ask` gives points, `tell` takes their costs; the caller flies. Points live in the unit cube; what is
sampled outside is put on its face and pays for the distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from companion.control.structs import Vector


@dataclass
class Search:
    """State of one search over `start.size` numbers in [0, 1]."""

    start: Vector  # (n,) where to begin
    seed: int = 1
    step: float = 0.2  # σ, in widths of the cube
    population: int = 0  # 0: 4 + 3 ln n
    best: Vector = field(init=False)
    best_cost: float = field(init=False, default=math.inf)
    evaluations: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        n = self.start.size
        self.best = self.start.copy()
        self._random = np.random.default_rng(self.seed)
        self.population = self.population or 4 + int(3.0 * math.log(n))
        parents = self.population // 2
        raw = math.log((self.population + 1) / 2.0) - np.log(np.arange(1, parents + 1))
        self._weights = raw / raw.sum()
        effective = 1.0 / float(np.sum(self._weights**2))
        self._cumulate_step = (effective + 2.0) / (n + effective + 5.0)
        self._damp_step = (
            1.0 + 2.0 * max(0.0, math.sqrt((effective - 1.0) / (n + 1.0)) - 1.0) + self._cumulate_step
        )
        self._cumulate = (4.0 + effective / n) / (n + 4.0 + 2.0 * effective / n)
        self._rank_one = 2.0 / ((n + 1.3) ** 2 + effective)
        self._rank_many = min(
            1.0 - self._rank_one, 2.0 * (effective - 2.0 + 1.0 / effective) / ((n + 2.0) ** 2 + effective)
        )
        self._effective = effective
        self._expected_norm = math.sqrt(n) * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n))
        self._mean = self.start.astype(np.float64).copy()
        self._covariance = np.eye(n)
        self._path_step, self._path = np.zeros(n), np.zeros(n)
        self._generation = 0
        self._sampled = np.empty((0, n))
        self._asked_start = False

    def ask(self) -> Vector:
        """(population, n) points in the unit cube; the very first of all is the start itself."""
        n = self._mean.size
        values, vectors = np.linalg.eigh(self._covariance)
        self._scale = np.sqrt(np.maximum(values, 1e-20))
        self._axes = vectors
        draws = self._random.standard_normal((self.population, n))
        if not self._asked_start:
            draws[0] = 0.0
            self._asked_start = True
        self._sampled = self._mean + self.step * (draws * self._scale) @ vectors.T
        return np.clip(self._sampled, 0.0, 1.0)

    def tell(self, costs: Vector) -> None:
        """Costs (population,) of the points last asked for, in their order. Moves mean, step and covariance."""
        inside = np.clip(self._sampled, 0.0, 1.0)
        self.evaluations += len(costs)
        winner = int(np.argmin(costs))
        if costs[winner] < self.best_cost:
            self.best, self.best_cost = inside[winner].copy(), float(costs[winner])
        outside = np.sum((self._sampled - inside) ** 2, axis=1)
        order = np.argsort(costs + 10.0 * outside, kind="stable")[: self._weights.size]
        n = self._mean.size
        before = self._mean
        moves = (self._sampled[order] - before) / self.step
        move = self._weights @ moves
        self._mean = np.clip(before + self.step * move, 0.0, 1.0)
        whitened = self._axes @ ((self._axes.T @ move) / self._scale)
        c = self._cumulate_step
        self._path_step = (1.0 - c) * self._path_step + math.sqrt(c * (2.0 - c) * self._effective) * whitened
        norm = float(np.linalg.norm(self._path_step))
        self._generation += 1
        settled = math.sqrt(1.0 - (1.0 - c) ** (2 * self._generation))
        rising = norm / settled < (1.4 + 2.0 / (n + 1.0)) * self._expected_norm
        c = self._cumulate
        self._path = (1.0 - c) * self._path
        if rising:
            self._path = self._path + math.sqrt(c * (2.0 - c) * self._effective) * move
        keep = 1.0 - self._rank_one - self._rank_many
        if not rising:
            keep += self._rank_one * c * (2.0 - c)
        self._covariance = (
            keep * self._covariance
            + self._rank_one * np.outer(self._path, self._path)
            + self._rank_many * (moves.T * self._weights) @ moves
        )
        self.step *= math.exp(self._cumulate_step / self._damp_step * (norm / self._expected_norm - 1.0))
        self.step = min(self.step, 0.5)
