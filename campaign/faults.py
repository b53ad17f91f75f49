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
IN_FLIGHT_S = (0.5, 9.0)
"""After lift-off; a flight tracks from about 6 s to 11 s after it."""


def _lasting(kind: str, for_s: tuple[float, float], **ranges: tuple[float, float]) -> Drawn:
    """A fault in flight that lasts, with evenly distributed parameters."""

    def drawn(draw: random.Random, firmware: str) -> Fault:
        values = tuple((name, round(draw.uniform(*limits), 3)) for name, limits in ranges.items())
        return Fault(kind, "airborne", _moment(draw), round(draw.uniform(*for_s), 2), values)

    return drawn


def _moment(draw: random.Random) -> float:
    return round(draw.uniform(*IN_FLIGHT_S), 2)


def _link(kind: str, for_s: tuple[float, float], **ranges: tuple[float, float]) -> Drawn:
    """A fault of the link: one way or both, from the start for a while, or in flight."""

    def drawn(draw: random.Random, firmware: str) -> Fault:
        values: list[tuple[str, float | str]] = [
            ("direction", draw.choice(("both", "to_client", "from_client")))
        ]
        values += [(name, round(draw.uniform(*limits), 3)) for name, limits in ranges.items()]
        if draw.random() < 0.2:
            return Fault(kind, "start", round(draw.uniform(0.5, 3.0), 2), 40.0, tuple(values))
        return Fault(kind, "airborne", _moment(draw), round(draw.uniform(*for_s), 2), tuple(values))

    return drawn


def _answers(kind: str) -> Drawn:
    """Answers that are lost from the start on, for a while or for good."""

    def drawn(draw: random.Random, firmware: str) -> Fault:
        share = draw.choice((0.3, 0.6, 1.0))
        for_s = None if draw.random() < 0.3 else round(draw.uniform(0.5, 15.0), 2)
        return Fault(
            kind,
            draw.choice(("start", "armed")),
            round(draw.uniform(0.0, 8.0), 2),
            for_s,
            (("probability", share),),
        )

    return drawn


def _bits(draw: random.Random, firmware: str) -> Fault:
    fault = _link("link_corrupt", (1.0, 8.0), probability=(0.02, 0.5))(draw, firmware)
    return Fault(
        fault.kind,
        fault.after,
        fault.at_s,
        fault.for_s,
        (*fault.parameters, ("bits", draw.choice((1, 2, 8, 40)))),
    )


KINDS: dict[str, Drawn] = {
    "link_loss": _link("link_loss", (0.1, 8.0), probability=(0.05, 1.0)),
    "link_delay": _link("link_delay", (0.5, 8.0), delay_s=(0.01, 0.6)),
    "link_jitter": _link("link_jitter", (0.5, 8.0), jitter_s=(0.005, 0.3)),
    "link_duplicate": _link("link_duplicate", (1.0, 10.0), probability=(0.05, 1.0)),
    "link_reorder": _link("link_reorder", (1.0, 8.0), probability=(0.02, 0.6), delay_s=(0.01, 0.3)),
    "link_corrupt": _bits,
    "link_truncate": _link("link_truncate", (1.0, 8.0), probability=(0.02, 0.5)),
    "ack_loss": _answers("ack_loss"),
    "parameter_loss": _answers("parameter_loss"),
}
"""How each kind is drawn; the firmware is given."""


def draw_faults(draw: random.Random, firmware: str, count: int) -> tuple[Fault, ...]:
    """`count` faults of different kinds."""
    kinds = draw.sample(sorted(KINDS), min(count, len(KINDS)))
    return tuple(KINDS[kind](draw, firmware) for kind in kinds)
