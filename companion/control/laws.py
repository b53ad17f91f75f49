"""Which control laws there are. A law of one's own needs no change here: `register_law` in a file of one's own.

    companion fly --controller my_law.py          the file calls register_law(...), its text goes into the log

A package that brings laws names their modules as entry points of the group `companion.laws`. Nothing here loads numba.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from companion.config.errors import UserError

ENTRY_POINTS = "companion.laws"


@dataclass(frozen=True, slots=True)
class LawEntry:
    """One law: its step, and which of the shared parts it has."""

    step: str | Callable[..., None]  # `module:name`, or the compiled function (law.py: StepKernel)
    title: str
    has_network: bool  # network with adaptation, and the sign term
    has_integral: bool
    model_in_feedback: bool  # the model term holds U̇_p instead of p̈_d

    @property
    def kernel(self) -> Callable[..., None]:
        """`step` itself."""
        if not isinstance(self.step, str):
            return self.step
        module, _, name = self.step.partition(":")
        kernel: Callable[..., None] = getattr(importlib.import_module(module), name)
        return kernel


LAWS: dict[str, LawEntry] = {
    "dtlannc": LawEntry(
        "companion.control.dtlannc:step", "double two-loop adaptive neural network", True, True, False
    ),
    "tlmbc": LawEntry("companion.control.tlmbc:step", "two-loop model-based", False, True, True),
    "nnsmc": LawEntry("companion.control.nnsmc:step", "adaptive-network sliding mode", True, False, True),
}
BUILT_IN = frozenset(LAWS)
AUTOPILOT = "autopilot"
"""No law of ours: the autopilot's own controller follows the reference (position, velocity, acceleration, yaw)."""
STANDS_IN = "tlmbc"
"""The law whose numbers are looked at where the autopilot's own controller flies: level flight, bounds."""


def register_law(
    name: str,
    step: Callable[..., None],
    title: str = "",
    *,
    has_network: bool = False,
    has_integral: bool = True,
    model_in_feedback: bool = False,
    gains_of: str = "dtlannc",
) -> None:
    """Make a law known by `name`; one of the same name that is not built in is replaced.

    Args:
        name: as `--controller` and profiles call it: letters, digits and underscores.
        step: `step(parameters, memory, inputs, memory_out, terms_out)`, decorated with
            `companion.control.compiled.compiled` (docs/adding_a_law.md).
        title: one line for people.
        has_network: it uses the shared networks and the sign term; without, their gains are 0.
        has_integral: it uses the shared integrals; one without has to carry the weight that m̂ does not know of.
        model_in_feedback: its model term holds U̇_p instead of p̈_d, which the lead has to know.
        gains_of: the law whose gains it takes where a profile has none under `[controllers.NAME]`.

    Raises:
        ValueError: the name is a built-in law's, or no name; `gains_of` is not known.
    """
    if name in BUILT_IN or not name.isidentifier():
        raise ValueError(
            f"a law cannot be called {name!r}: {'that is built in' if name in BUILT_IN else 'no name'}"
        )
    if gains_of not in LAWS:
        raise ValueError(f"gains_of={gains_of!r}: there are {', '.join(LAWS)}")
    from companion.config.settings import GAINS_OF  # not above: help texts read this module

    LAWS[name] = LawEntry(step, title or name, has_network, has_integral, model_in_feedback)
    GAINS_OF[name] = gains_of


def law_entry(name: str) -> LawEntry:
    """The law of that name, an installed package's too. Raises UserError naming those there are."""
    if name == AUTOPILOT:
        return LAWS[STANDS_IN]
    if name not in LAWS:
        for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
            point.load()
    if name not in LAWS:
        close = difflib.get_close_matches(name, LAWS, n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise UserError(
            f"there is no controller {name!r}{hint}; there are {', '.join(LAWS)}, or name the .py file of your own"
        )
    return LAWS[name]


def load_law_file(path: Path) -> str:
    """Run a file that registers one law; returns the law's name. Raises UserError with what is wrong with the file."""
    before = dict(LAWS)
    spec = importlib.util.spec_from_file_location(f"companion_law_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise UserError(f"--controller {path}: there is no such Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module  # where numba looks for what a function refers to
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever somebody's file may raise
        raise UserError(f"--controller {path}: {type(error).__name__}: {error}") from error
    new = [name for name, entry in LAWS.items() if before.get(name) is not entry]
    if len(new) != 1:
        said = f"registers {', '.join(new)}" if new else "registers no law"
        raise UserError(f"--controller {path}: it {said}; it has to call companion.register_law once")
    return new[0]
