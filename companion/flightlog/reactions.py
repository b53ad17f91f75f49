"""How hard the supervisor reacted in a flight, and for how long: for its last word and for its log."""

from __future__ import annotations

from collections.abc import Iterable

from companion.config.safety import Reaction

_WORDS = {
    Reaction.FREEZE: "adaptation frozen",
    Reaction.NON_ADAPTIVE: "networks off",
    Reaction.HOLD: "held in place",
}
"""Reactions under which a flight goes on, but not as it was asked for."""


def reaction_times(changes: Iterable[tuple[float, Reaction]], end_s: float) -> dict[Reaction, float]:
    """Seconds spent under each reaction but NONE, softest first.

    Args:
        changes: when the machine came to which reaction, in order, autopilot's clock.
        end_s: when our control ended.
    """
    spent: dict[Reaction, float] = {}
    before, since_s = Reaction.NONE, end_s
    for time_s, reaction in [*changes, (end_s, Reaction.NONE)]:
        if before is not Reaction.NONE:
            spent[before] = spent.get(before, 0.0) + max(0.0, time_s - since_s)
        before, since_s = reaction, time_s
    return dict(sorted(spent.items()))


def in_words(spent: dict[Reaction, float]) -> str:
    """What of a flight was not flown as asked, hardest first; empty where all was."""
    return ", ".join(
        f"{_WORDS[reaction]} for {spent[reaction]:.{0 if spent[reaction] >= 9.95 else 1}f} s"
        for reaction in sorted(spent, reverse=True)
        if reaction in _WORDS
    )
