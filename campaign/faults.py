"""Faults of the stub, as drawn, and the scenario file that tells the stub of them (`sitl-stub --scenario`)."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Fault:
    """One `[[fault]]` of a scenario. `parameters` are those of its kind, as pairs."""

    kind: str
    after: str
    at_s: float
    for_s: float | None
    parameters: tuple[tuple[str, float | str], ...] = ()

    def to_toml(self) -> str:
        """The table."""
        lines = ["[[fault]]", f'kind = "{self.kind}"', f'after = "{self.after}"', f"at_s = {self.at_s}"]
        lines += [] if self.for_s is None else [f"for_s = {self.for_s}"]
        lines += [f"{key} = {_toml(value)}" for key, value in self.parameters]
        return "\n".join(lines) + "\n"


def _toml(value: float | str) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(value)


def scenario(seed: int, faults: tuple[Fault, ...]) -> str:
    """The whole file."""
    return "\n".join([f"seed = {seed}\n", *(fault.to_toml() for fault in faults)])


Drawn = Callable[[random.Random, str], Fault]

KINDS: dict[str, Drawn] = {}
"""How each kind is drawn; the firmware is given."""


def draw_faults(draw: random.Random, firmware: str, count: int) -> tuple[Fault, ...]:
    """`count` faults of different kinds."""
    kinds = draw.sample(sorted(KINDS), min(count, len(KINDS)))
    return tuple(KINDS[kind](draw, firmware) for kind in kinds)
