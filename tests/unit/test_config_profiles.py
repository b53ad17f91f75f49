"""The shipped profiles: the report's numbers, consistency, and gains a search can walk in."""

import re

import numpy as np
import pytest
from control_cases import QBALL2
from hypothesis import given
from hypothesis import strategies as st

from companion.config.errors import UserError
from companion.config.load import find_profile, shipped_profiles
from companion.config.search_space import search_space, to_vector, with_vector
from companion.config.settings import load_profile, select_gains
from companion.control.laws import LAWS
from companion.control.registry import build_law
from companion.control.structs import ControlLevel

LEVELS = [level.value for level in ControlLevel]


def test_qball2_is_the_report():
    """control_laws.md, section 2 and figure 3 of the report."""
    assert (QBALL2.mass_kg, QBALL2.mass_ratio, QBALL2.gravity_m_s2) == (1.79, 0.7, 9.81)
    assert QBALL2.inertia_kg_m2 == (0.03, 0.03, 0.04)
    assert QBALL2.drag_kg_s == QBALL2.rotational_drag_kg_m2_s == (0.002, 0.002, 0.004)
    assert QBALL2.rotors.thrust_max_newton == 12.0 and QBALL2.rotors.lag_rad_s == 15.0
    assert QBALL2.rotors.torque_per_newton_m == pytest.approx(0.4 / 12)
    np.testing.assert_allclose(QBALL2.rotors.arms_m, [[0.2, 0], [0, -0.2], [-0.2, 0], [0, 0.2]])
    assert QBALL2.mass_estimate_kg == pytest.approx(1.253)


@pytest.mark.parametrize("name", shipped_profiles())
def test_hover_thrust_fits_mass_and_rotors(name):
    profile = load_profile(name)
    share = profile.mass_kg * profile.gravity_m_s2 / profile.thrust_available_newton
    assert profile.hover_thrust == pytest.approx(share, rel=0.01)


@pytest.mark.parametrize("name", shipped_profiles())
@pytest.mark.parametrize("controller", LAWS)
@pytest.mark.parametrize("level", LEVELS)
def test_every_law_can_be_built_at_every_level(name, controller, level):
    profile = load_profile(name)
    law = build_law(
        controller, select_gains(profile, controller, level), profile, ControlLevel(level), seed=2
    )
    p = law.parameters
    count = int(p.rotor_count)
    np.testing.assert_allclose(p.allocation[:, :count] @ p.mixer[:count], np.eye(4), atol=1e-12)
    assert p.thrust_max > 1.2 * profile.mass_kg * profile.gravity_m_s2


def test_every_number_of_qball2_says_where_it_is_from():
    """Each line of the vehicle's own numbers carries a comment; gains say it at their head."""
    text = find_profile("qball2").read_text(encoding="utf-8")
    vehicle = text[: text.index("# Gains:")]
    section_marked = False
    for line in vehicle.splitlines():
        if line.startswith("# ["):
            section_marked = True
        if line.startswith("["):
            section_marked = section_marked or "# [" in line
            continue
        if re.match(r"\w+ = [\[{\d]", line) and not section_marked:
            assert re.search(r"# (\[(report|assumed|tuned)\]|mass)", line), line
    assert "[tuned]" in text[text.index("# Gains:") :].splitlines()[0]


def test_autopilot_chooses_the_response():
    px4 = QBALL2.response("px4")
    other = px4.model_copy(update={"tilt": px4.tilt.model_copy(update={"natural_frequency_rad_s": 20.0})})
    both = QBALL2.model_copy(update={"responses": {"px4": px4, "ardupilot": other}})
    gains = select_gains(both, "dtlannc", "attitude")
    leads = [
        build_law("dtlannc", gains, both, ControlLevel.ATTITUDE, 1, autopilot=name).parameters.attitude_lead[
            0
        ]
        for name in ("px4", "ardupilot")
    ]
    assert leads[0] == pytest.approx(px4.tilt.lag_s) and leads[1] == pytest.approx(2 * px4.tilt.damping / 20)


def test_unknown_controller():
    with pytest.raises(UserError, match="did you mean 'dtlannc'"):
        build_law("dtlanc", select_gains(QBALL2, "dtlannc", "attitude"), QBALL2, ControlLevel.ATTITUDE, 1)


def test_networks_of_one_seed_differ_and_repeat():
    gains = select_gains(QBALL2, "dtlannc", "actuator")
    one, same, other = (
        build_law("dtlannc", gains, QBALL2, ControlLevel.ACTUATOR, s).parameters for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.position_V, same.position_V)
    assert not np.array_equal(one.position_V, other.position_V)
    assert not np.array_equal(one.position_V / one.position_V[0], one.attitude_V / one.attitude_V[0])


@pytest.mark.parametrize("controller", LAWS)
@pytest.mark.parametrize("level", LEVELS)
def test_search_space_round_trip(controller, level):
    entry = LAWS[controller]
    space = search_space(level, has_network=entry.has_network, has_integral=entry.has_integral)
    names = [parameter.name for parameter in space]
    assert len(set(names)) == len(names)
    gains = select_gains(QBALL2, controller, level)
    vector = to_vector(space, gains, QBALL2)
    np.testing.assert_allclose(
        to_vector(space, with_vector(space, gains, QBALL2, vector), QBALL2), vector, atol=1e-3
    )
    if not entry.has_network:
        assert not any("alpha" in name or ".N" in name for name in names)


@given(st.lists(st.floats(-0.5, 1.5), min_size=30, max_size=30))
def test_every_point_of_the_search_is_a_valid_configuration(point):
    space = search_space("actuator", has_network=True, has_integral=True)
    gains = with_vector(
        space, select_gains(QBALL2, "dtlannc", "actuator"), QBALL2, np.array(point[: len(space)])
    )
    assert build_law("dtlannc", gains, QBALL2, ControlLevel.ACTUATOR, 1).hidden == gains.hidden_neurons
