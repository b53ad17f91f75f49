"""The limits as settings: overridable one rung at a time, never harder before softer, never without an end."""

import itertools
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.errors import UserError
from companion.config.safety import QUANTITIES, RUNGS, Reaction, SafetyLimits
from companion.config.settings import load_settings, settings_from_tables
from companion.flight import safety_page


def load(*overrides):
    return load_settings("qball2", {}, overrides).flight.safety


def test_one_rung_is_changed_and_the_others_stay():
    changed = load("flight.safety.position_error_m.land=[3.0, 0.2]")
    default = SafetyLimits()
    assert changed.position_error_m.land == (3.0, 0.2)
    assert changed.position_error_m.hold == default.position_error_m.hold
    assert changed.tilt_deg == default.tilt_deg


def test_a_rung_can_be_switched_off_and_survives_the_log():
    settings = load_settings("qball2", {}, ["flight.safety.yaw_error_deg.land=off"])
    assert settings.flight.safety.yaw_error_deg.land == "off"
    assert settings_from_tables(settings.as_tables()).flight.safety == settings.flight.safety


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("flight.safety.tilt_deg.land=[30, 0.3]", "tilt_deg: land at 30 would come before freeze at 45"),
        ("flight.safety.thrust_margin.land=[0.01, 1.0]", "land after 1 s would come before hold after 2 s"),
        ("flight.safety.battery_remaining.land=[0.5, 5]", "land at 0.5 would come before warn at 0.25"),
        ("flight.safety.tilt_deg.land=off", "land or a harder rung has to be in use"),
        ("flight.safety.position_age_s.land=[2.0, 0]", "up to 0.5"),
        ("flight.safety.fence_margin_m.land=[-3, 0]", "above 0"),
        ("flight.safety.tilt_deg.disarm=[80, 1]", "allow_disarm=true"),
        ("flight.safety.tilt_deg.land=[50]", "tilt_deg.land: write [threshold, seconds]"),
        ("flight.safety.tilt_deg.land=[50, -1]", "tilt_deg.land: write [threshold, seconds]"),
        ("flight.safety.tilt_deg.lnd=[50, 0]", "did you mean 'safety.tilt_deg.land'?"),
        ("flight.safety.fence.box_m=[1, -1, 2, 1]", "hold the place of take-off"),
        ("flight.safety.fence.shape=polygon", "three corners"),
        ("flight.safety.tilt_deg.warn=[nan, 1]", "tilt_deg.warn: write [threshold, seconds]"),
    ],
)
def test_limits_that_make_no_sense_are_refused_with_a_reason(override, says):
    with pytest.raises(UserError, match=r"^flight settings: |--set") as refused:
        load(override)
    assert says in str(refused.value)


def test_disarm_is_there_for_those_who_ask_twice():
    limits = load("flight.safety.allow_disarm=true", "flight.safety.tilt_deg.disarm=[80, 0.5]")
    assert limits.tilt_deg.rungs()[-1] == (Reaction.DISARM, 80.0, 0.5)


@given(
    thresholds=st.lists(st.floats(0.0, 10.0), min_size=2, max_size=6),
    durations=st.lists(st.floats(0.0, 5.0), min_size=6, max_size=6),
)
def test_no_accepted_ladder_has_a_harder_rung_before_a_softer_one(thresholds, durations):
    names = [reaction.setting for reaction in RUNGS[: len(thresholds)]]
    rungs = {name: [at, for_s] for name, at, for_s in zip(names, thresholds, durations, strict=False)}
    ordered = all(
        hard > soft or (hard == soft and durations[i + 1] >= durations[i])
        for i, (soft, hard) in enumerate(itertools.pairwise(thresholds))
    )
    off = {reaction.setting: "off" for reaction in RUNGS}
    table = {"velocity_error_m_s": {**off, **rungs}}
    try:
        SafetyLimits.model_validate(table)
        accepted = True
    except ValueError:
        accepted = False
    assert accepted == ordered


def test_every_quantity_has_a_ladder_and_says_what_it_is():
    for name in QUANTITIES:
        assert SafetyLimits.model_fields[name].description


def test_the_safety_page_says_what_the_code_does():
    page = safety_page.PAGE.read_text(encoding="utf-8")
    assert safety_page.made(page) == page, "python -m companion.flight.safety_page --write"


def test_the_safety_page_has_a_measured_time_for_every_limit():
    page = safety_page.PAGE.read_text(encoding="utf-8")
    measured = page.partition("<!-- reaction times:")[2].partition("<!-- end of")[0]
    for name in QUANTITIES:
        for reaction, at, for_s in SafetyLimits().ladder(name).rungs():
            rows = [
                line.split("|")
                for line in measured.splitlines()
                if f"`{name}` | {reaction.setting} |" in line
            ]
            assert len(rows) == 1, (
                f"{name} {reaction.setting}: python scripts/bench/reaction_times.py --write"
            )
            threshold, duration, worst = (cell.split()[0] for cell in rows[0][3:6])
            assert (float(threshold), float(duration)) == (at, for_s)
            assert float(worst) >= for_s


def test_a_page_without_its_block_is_not_silently_left_alone():
    with pytest.raises(ValueError, match="limits"):
        safety_page.with_block("nothing here", "limits", "x")


def test_the_safety_case_names_tests_that_exist():
    page = safety_page.PAGE.read_text(encoding="utf-8")
    named = set(re.findall(r"`(test_\w+)`", page))
    tests = "\n".join(
        path.read_text(encoding="utf-8") for path in Path(__file__).parents[1].rglob("test_*.py")
    )
    missing = {name for name in named if f"def {name}(" not in tests}
    assert len(named) > 15 and not missing
