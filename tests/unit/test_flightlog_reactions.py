"""Seconds under each reaction, by hand."""

import pytest

from companion.config.safety import Reaction
from companion.flightlog.reactions import in_words, reaction_times


def test_each_reaction_counts_until_the_next_and_the_last_until_our_control_ends():
    changes = [
        (10.0, Reaction.WARN),
        (12.5, Reaction.NON_ADAPTIVE),
        (33.5, Reaction.NONE),
        (40.0, Reaction.FREEZE),
        (40.4, Reaction.NON_ADAPTIVE),
    ]
    spent = reaction_times(changes, 42.0)
    assert list(spent) == [Reaction.WARN, Reaction.FREEZE, Reaction.NON_ADAPTIVE]
    assert list(spent.values()) == pytest.approx([2.5, 0.4, 22.6])
    assert in_words(spent) == "networks off for 23 s, adaptation frozen for 0.4 s"


def test_a_flight_that_was_only_warned_of_was_flown_as_asked():
    assert in_words(reaction_times([(1.0, Reaction.WARN)], 5.0)) == ""
    assert reaction_times([], 5.0) == {}


def test_a_reaction_at_the_very_end_took_no_time():
    assert reaction_times([(1.0, Reaction.HOLD), (4.0, Reaction.LAND)], 3.99) == {
        Reaction.HOLD: pytest.approx(3.0),
        Reaction.LAND: 0.0,
    }
