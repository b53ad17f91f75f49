"""What a fault is: a frozen dataclass whose fields are its parameters, and a generator that makes it happen.

A new fault is a subclass of `Fault` in one of the files beside this one and a line in `registry.py`. A parameter is
declared with its unit, meaning and bounds (`number`, `whole`, `choice`, `names`, `switch`); scenario files, the call from
Python, `--list-faults` and the table in docs/faults.md all come from that one declaration.
"""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from sitl_stub.faults.frames import FrameFaults
    from sitl_stub.firmware.common.autopilot import Autopilot
    from sitl_stub.physics.vehicle import VehicleParameters

Effect = Generator[None, None, None]
"""A fault at work: begins when it is advanced first, is advanced at every instant while it lasts, undoes itself when
closed. One that returns was momentary: what it did stays."""


class FaultError(ValueError):
    """A fault that cannot be had: wrong kind, parameter or time. `problems` has one line each, with the remedy."""

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = list(problems)


@dataclass(frozen=True, slots=True)
class Parameter:
    """What a field of a fault may hold."""

    kind: type
    unit: str
    """Empty for a share, a count or a name."""
    meaning: str
    least: float = 0.0
    most: float = 0.0
    options: tuple[str, ...] = ()

    def problem(self, value: Any) -> str | None:
        """What is wrong with `value` and what would be right, or None."""
        if self.kind is bool:
            return None if isinstance(value, bool) else "give true or false"
        if self.kind is str:
            if isinstance(value, str) and value and (not self.options or value in self.options):
                return None
            return f"give one of {', '.join(self.options)}" if self.options else "give a name"
        if self.kind is tuple:
            is_list = isinstance(value, list | tuple) and len(value) > 0
            good = is_list and all(isinstance(name, str) and name in self.options for name in value)
            return None if good else f'give a list of {self.meaning}, for example ["{self.options[0]}"]'
        numeric = isinstance(value, int if self.kind is int else (int, float)) and not isinstance(value, bool)
        if numeric and self.least <= value <= self.most:
            return None
        whole = "a whole number" if self.kind is int else "a number"
        unit = f" {self.unit}" if self.unit else ""
        return f"give {whole} from {self.least:g} to {self.most:g}{unit}"

    def converted(self, value: Any) -> Any:
        """A good value as the dataclass holds it."""
        return tuple(value) if self.kind is tuple else self.kind(value)


def number(default: float, unit: str, meaning: str, least: float, most: float) -> Any:
    """A real parameter within [least, most]."""
    return field(default=default, metadata={"parameter": Parameter(float, unit, meaning, least, most)})


def whole(default: int, meaning: str, least: int, most: int) -> Any:
    """A whole parameter within [least, most]."""
    return field(default=default, metadata={"parameter": Parameter(int, "", meaning, least, most)})


def choice(default: str, options: Sequence[str], meaning: str) -> Any:
    """One of `options`."""
    parameter = Parameter(str, "", meaning, options=tuple(options))
    return field(default=default, metadata={"parameter": parameter})


def names(default: Sequence[str], options: Sequence[str], meaning: str) -> Any:
    """A list of names, each one of `options`; `meaning` says what they are names of, in the plural."""
    parameter = Parameter(tuple, "", meaning, options=tuple(options))
    return field(default=tuple(default), metadata={"parameter": parameter})


def switch(default: bool, meaning: str) -> Any:
    """True or false."""
    return field(default=default, metadata={"parameter": Parameter(bool, "", meaning)})


@dataclass(slots=True)
class Site:
    """Where one fault acts, and its own random numbers."""

    autopilot: Autopilot
    frames: FrameFaults
    name: str
    """Distinguishes it from every other fault of a run; with the seed it gives `random`."""
    seed: int
    shared: dict[str, list[float]]
    """What several faults set at once, each its own value: see `setting`."""
    begun_us: int = 0
    ends_us: int | None = None

    @contextlib.contextmanager
    def setting(
        self, what: str, value: float, use: Callable[[float], None], otherwise: float
    ) -> Iterator[None]:
        """While it lasts, let `use` have the least value of all faults that set `what`; in the end `otherwise`."""
        values = self.shared.setdefault(what, [])
        values.append(value)
        use(min(values))
        try:
            yield
        finally:
            values.remove(value)
            use(min(values, default=otherwise))

    @property
    def elapsed_s(self) -> float:
        """Simulated time since the fault began."""
        return (self.autopilot.time_us - self.begun_us) * 1e-6

    @property
    def left_s(self) -> float:
        """Simulated time until it ends; infinite where it stays."""
        return float("inf") if self.ends_us is None else (self.ends_us - self.autopilot.time_us) * 1e-6

    def random(self, purpose: str = "") -> random.Random:
        """A generator that depends on the seed, the fault and `purpose`, and on nothing else."""
        return random.Random(f"{self.seed}/{self.name}/{purpose}")


@dataclass(frozen=True)
class Fault:
    """One fault with its parameters; the first line of a subclass's docstring says what it is."""

    kind: ClassVar[str]
    momentary: ClassVar[bool] = False
    """Happens at once and cannot be taken back: takes no `for_s`."""

    @classmethod
    def parameters(cls) -> Mapping[str, Parameter]:
        """Parameters by name, in their order."""
        return {one.name: one.metadata["parameter"] for one in fields(cls)}

    @classmethod
    def defaults(cls) -> Mapping[str, Any]:
        """Default of each parameter."""
        every: tuple[Field[Any], ...] = fields(cls)
        return {one.name: one.default for one in every}

    @classmethod
    def summary(cls) -> str:
        """What it is, in one sentence."""
        return (cls.__doc__ or "").strip().splitlines()[0]

    def refusal(self, firmware: str, vehicle: VehicleParameters) -> str | None:
        """What this vehicle or firmware (`px4`, `px4-1.13`, `ardupilot`) has not got, with the remedy; None: all there."""
        return None

    def act(self, site: Site) -> Effect:
        """Make it happen."""
        raise NotImplementedError


def hold() -> Effect:
    """Go on until closed."""
    while True:
        yield
