"""The supervisor's state machine: from measured values to one reaction. Pure: same state, same values, same answer.

Two layers. Below, every rung of every quantity (`companion.config.safety`) is quiet, beyond its threshold, or
acting; it lets go only after the quantity has been well within its threshold for `recovery_s`. Above, the
hardest rung that acts moves the whole machine along the reactions: up at any time, down only among those that can be
taken back (`next_reaction`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from companion.config.safety import QUANTITIES, Reaction, SafetyLimits

SOFTEST_FINAL = Reaction.HOLD
"""From here on nothing is taken back: the plan has been left."""
ROUNDING_S = 1e-9  # times are differences of floats


@dataclass(frozen=True, slots=True)
class RungSpec:
    """One rung of one quantity, ready to compare."""

    quantity: int  # index into QUANTITIES
    name: str
    unit: str
    reaction: Reaction
    at: float
    for_s: float
    below: bool
    lets_go_at: float

    def beyond(self, value: float) -> bool:
        """Whether `value` is on the bad side; NaN is."""
        return not (value >= self.at if self.below else value <= self.at)

    def well_within(self, value: float) -> bool:
        """Whether `value` is far enough on the good side to let go."""
        return value >= self.lets_go_at if self.below else value <= self.lets_go_at

    def sentence(self, value: float) -> str:
        """What happened, in numbers, for people."""
        unit = f" {self.unit}" if self.unit else ""
        lasted = f" for {self.for_s:g} s" if self.for_s else ""
        return f"{self.name} {value:.3g}{unit}, limit {self.at:g}{unit}{lasted}"


@dataclass(frozen=True, slots=True)
class RungTable:
    """All rungs of one flight."""

    rungs: tuple[RungSpec, ...]  # grouped by quantity, softest first
    spans: tuple[tuple[int, int], ...]  # of each quantity in `rungs`
    soft_limits: tuple[
        tuple[float, bool], ...
    ]  # of each quantity: the softest threshold, whether below is bad
    recovery_s: float
    hold_s: float


@dataclass(frozen=True, slots=True)
class Exceeded:
    """A rung whose threshold is exceeded, or was and has not been let go of."""

    rung: int
    since_s: float
    acting: bool  # it has been exceeded for its duration
    quiet_since_s: float | None  # since when the value has been well within; None while it is not


@dataclass(frozen=True, slots=True)
class LadderState:
    """Where the machine stands."""

    reaction: Reaction = Reaction.NONE
    entered_s: float = -math.inf
    exceeded: tuple[Exceeded, ...] = ()


@dataclass(frozen=True, slots=True)
class Change:
    """A rung began to act, or was let go of."""

    rung: RungSpec
    value: float
    began: bool
    lasted_s: float


START = LadderState()


def rung_table(limits: SafetyLimits) -> RungTable:
    """The rungs in use, in the order of QUANTITIES."""
    rungs: list[RungSpec] = []
    spans, soft = [], []
    for index, (name, quantity) in enumerate(QUANTITIES.items()):
        first = len(rungs)
        for reaction, at, for_s in limits.ladder(name).rungs():
            share = 1.0 / limits.recovery_share if quantity.below else limits.recovery_share
            lets_go = at * share if at > 0.0 else at
            rungs.append(RungSpec(index, name, quantity.unit, reaction, at, for_s, quantity.below, lets_go))
        spans.append((first, len(rungs)))
        nothing = -math.inf if quantity.below else math.inf
        soft.append((rungs[first].at if len(rungs) > first else nothing, quantity.below))
    return RungTable(tuple(rungs), tuple(spans), tuple(soft), limits.recovery_s, limits.hold_s)


def next_reaction(current: Reaction, wanted: Reaction, hold_is_over: bool) -> Reaction:
    """The machine's next state. `wanted` is the hardest acting rung's reaction, NONE when none acts."""
    if current is Reaction.HOLD and hold_is_over:
        return max(Reaction.LAND, wanted)
    if current >= SOFTEST_FINAL:
        return max(current, wanted)
    return wanted


def step(
    table: RungTable, state: LadderState, values: Sequence[float | None], time_s: float
) -> tuple[LadderState, tuple[Change, ...]]:
    """One look at all values (in the order of QUANTITIES; None where nothing is known, which changes nothing).

    Returns the next state, and what began or ended with it.
    """
    beyond = [
        index
        for index, (value, (limit, below)) in enumerate(zip(values, table.soft_limits, strict=True))
        if value is not None and not (value >= limit if below else value <= limit)
    ]
    if not beyond and not state.exceeded:
        hold_is_over = (
            state.reaction is Reaction.HOLD and time_s - state.entered_s >= table.hold_s - ROUNDING_S
        )
        reaction = next_reaction(state.reaction, Reaction.NONE, hold_is_over)
        if reaction is state.reaction:
            return state, ()
        return LadderState(reaction, time_s, ()), ()
    exceeded, changes = _step_rungs(table, state.exceeded, beyond, values, time_s)
    wanted = max((table.rungs[item.rung].reaction for item in exceeded if item.acting), default=Reaction.NONE)
    hold_is_over = time_s - state.entered_s >= table.hold_s - ROUNDING_S
    reaction = next_reaction(state.reaction, wanted, hold_is_over)
    entered_s = state.entered_s if reaction is state.reaction else time_s
    return LadderState(reaction, entered_s, exceeded), changes


def _step_rungs(
    table: RungTable,
    before: tuple[Exceeded, ...],
    beyond: list[int],
    values: Sequence[float | None],
    time_s: float,
) -> tuple[tuple[Exceeded, ...], tuple[Change, ...]]:
    following: list[Exceeded] = []
    changes: list[Change] = []
    known = set()
    for item in before:
        known.add(item.rung)
        kept, change = _step_one(table.rungs[item.rung], item, values, time_s, table.recovery_s)
        if kept is not None:
            following.append(kept)
        if change is not None:
            changes.append(change)
    for quantity in beyond:
        for index in range(*table.spans[quantity]):
            rung, value = table.rungs[index], values[quantity]
            if index in known or value is None or not rung.beyond(value):
                continue
            at_once = rung.for_s <= 0.0
            following.append(Exceeded(index, time_s, at_once, None))
            if at_once:
                changes.append(Change(rung, value, True, 0.0))
    return tuple(following), tuple(changes)


def _step_one(
    rung: RungSpec, item: Exceeded, values: Sequence[float | None], time_s: float, recovery_s: float
) -> tuple[Exceeded | None, Change | None]:
    value = values[rung.quantity]
    if value is None:
        return item, None
    lasted_s = time_s - item.since_s
    if not item.acting:
        if not rung.beyond(value):
            return None, None
        if lasted_s < rung.for_s - ROUNDING_S:
            return item, None
        return replace(item, acting=True), Change(rung, value, True, lasted_s)
    if not rung.well_within(value):
        return (item if item.quiet_since_s is None else replace(item, quiet_since_s=None)), None
    if item.quiet_since_s is None:
        return replace(item, quiet_since_s=time_s), None
    if time_s - item.quiet_since_s < recovery_s - ROUNDING_S:
        return item, None
    return None, Change(rung, value, False, lasted_s)


def hardest_by_quantity(table: RungTable, state: LadderState) -> dict[int, Reaction]:
    """The hardest acting reaction of every quantity that has one."""
    found: dict[int, Reaction] = {}
    for item in state.exceeded:
        rung = table.rungs[item.rung]
        if item.acting:
            found[rung.quantity] = max(rung.reaction, found.get(rung.quantity, Reaction.NONE))
    return found


# What follows is for the documentation -------------------------------------------------------------------


def transitions() -> dict[tuple[Reaction, Reaction], str]:
    """Every change of reaction that `next_reaction` can make, with the reasons for it, found by trying all of them."""
    found: dict[tuple[Reaction, Reaction], set[str]] = {}
    for current in Reaction:
        for wanted in Reaction:
            for over in (False, True):
                following = next_reaction(current, wanted, over)
                if following is current:
                    continue
                if following < current:
                    why = "let go"
                else:
                    why = "limit" if following is wanted else "held for hold_s"
                found.setdefault((current, following), set()).add(why)
    return {edge: " or ".join(sorted(reasons, reverse=True)) for edge, reasons in found.items()}


def mermaid() -> str:
    """The machine as a mermaid state diagram, made from `transitions`."""
    edges = transitions()
    lines = ["stateDiagram-v2", "    [*] --> NONE"]
    for (current, following), why in sorted(edges.items()):
        lines.append(f"    {current.name} --> {following.name}: {why}")
    lines += [f"    {last.name} --> [*]: our control has ended" for last in Reaction if last >= Reaction.LAND]
    return "\n".join(lines) + "\n"
