"""Profiles that say little or nothing: what follows from the rest, and gains in the time of the vehicle's own response."""

import pytest

from companion.config.common_gains import laws_with_common_gains, total_lag_s
from companion.config.errors import UserError
from companion.config.load import find_profile, shipped_profiles
from companion.config.settings import load_profile, load_settings, select_gains
from companion.control.certificates import broken_conditions
from companion.control.laws import LAWS
from companion.control.structs import ControlLevel


@pytest.fixture
def written(tmp_path):
    """A profile of these lines."""

    def write(text):
        path = tmp_path / "mine.toml"
        path.write_text(text)
        return str(path)

    return write


def test_shipped_profiles_are_short():
    """Their gains are the common ones where these do as well (issue 13)."""
    assert sum(len(find_profile(name).read_text().splitlines()) for name in shipped_profiles()) < 200


def test_an_empty_file_is_a_profile(written):
    profile = load_profile(written(""))
    assert profile == load_profile(None)
    assert profile.mass_kg == 1.0 and profile.mass_ratio == 1.0
    assert profile.hover_thrust == pytest.approx(9.81 / profile.thrust_available_newton)
    assert set(LAWS) <= set(laws_with_common_gains())


def test_the_gains_found_on_px4s_simulation_by_hand():
    """The vehicle that the common gains come from flies what was tuned for it: 1.79 kg, lags 0.2367 s and 0.084 s."""
    gains = select_gains(load_profile("px4_sih"), "dtlannc", "attitude")
    loop = gains.position_loop
    assert loop.K_e == pytest.approx((4, 4, 4), rel=1e-3) and pytest.approx((3, 3, 10), rel=1e-3) == loop.K_U
    assert loop.K_i == pytest.approx((1, 1, 8), rel=1e-3)
    assert (loop.alpha, loop.boundary_width, loop.N, loop.kappa, loop.weight_bound) == pytest.approx(
        (0.8, 0.3, 2, 0.3, 3), rel=1e-3
    )
    assert gains.lead.feedback_s == pytest.approx(0.2, rel=1e-3)
    rates = select_gains(load_profile("px4_sih"), "dtlannc", "body_rate")
    assert rates.attitude_loop.K_e == pytest.approx((5.5, 5.5, 2), rel=1e-3)
    assert rates.command_filter_rad_s == pytest.approx(30, rel=1e-3)


def test_half_as_quick_and_three_times_as_heavy(written):
    """Dead time 0.14 s, ω 6 rad/s: twice px4_sih's lag of 0.07 + 2/12 s; 3 kg. Scaled by hand, s = 1/2."""
    text = "mass_kg = 3.0\n[responses.px4]\ndead_time_s = 0.14\n"
    text += "tilt = { natural_frequency_rad_s = 6.0, damping = 1.0 }\n"
    profile = load_profile(written(text))
    gains = select_gains(profile, "dtlannc", "attitude")
    loop = gains.position_loop
    assert loop.K_e[0] == pytest.approx(2.0, rel=1e-3)
    assert loop.K_U[0] == pytest.approx(0.5 * 3.0 / 1.79 * 3.0, rel=1e-3)
    assert loop.K_i[0] == pytest.approx(0.25 * 1.0 / 1.79 * 3.0, rel=2e-3)
    assert pytest.approx(0.25 * 2.0 / 1.79 * 3.0, rel=2e-3) == loop.N
    assert loop.boundary_width == pytest.approx(0.6, rel=1e-3)
    assert gains.lead.feedback_s == pytest.approx(0.4, rel=1e-3)
    assert loop.alpha == pytest.approx(0.8 / 1.79 * 3.0, rel=1e-3)
    assert loop.kappa == pytest.approx(0.3 * 1.79 / 3.0, rel=1e-3)
    assert loop.K_e[2] == pytest.approx(0.6 * 4.0, rel=1e-3)  # thrust passes the loop by


def test_a_quick_response_does_not_make_gains_beyond_what_was_flown(written):
    fast = "[responses.px4]\ndead_time_s = 0.0\ntilt = { natural_frequency_rad_s = 60.0, damping = 0.7 }\n"
    loop = select_gains(load_profile(written(fast)), "dtlannc", "attitude").position_loop
    assert loop.K_e[0] == pytest.approx(1.6 * 4.0)


@pytest.mark.parametrize("lag_margin", [1.0, 2.0])
def test_a_margin_makes_gains_for_a_slower_response(lag_margin):
    profile = load_profile("px4_sih", [f"lag_margin={lag_margin}"])
    assert total_lag_s(profile, ControlLevel.ATTITUDE, "px4") == pytest.approx(lag_margin * 0.23667, rel=1e-3)
    loop = select_gains(profile, "dtlannc", "attitude").position_loop
    assert loop.K_e[0] == pytest.approx(4.0 / lag_margin, rel=2e-3)


@pytest.mark.parametrize("mass_kg", [0.25, 35.0])
@pytest.mark.parametrize("level", ["attitude", "body_rate", "actuator"])
@pytest.mark.parametrize("law", ["dtlannc", "nnsmc"])
def test_the_propositions_hold_for_every_vehicle(written, mass_kg, level, law):
    """α ≥ κ W_max²/4 + ε_max does not depend on mass or lag; only DTLANNC's common α meets it (docs/control_laws.md)."""
    numbers = f"mass_kg = {mass_kg}\n[responses.px4]\ndead_time_s = 0.2\n"
    one, other = (
        broken_conditions(select_gains(load_profile(name), law, level), attitude_loop_flies=False)
        for name in (written(numbers), "px4_sih")
    )
    assert len(one) == len(other)
    assert not one or law == "nnsmc"


def test_single_values_override_the_common_set(written):
    path = written("[controllers.dtlannc.attitude.position_loop]\nalpha = 0.123\n")
    ours, common = (select_gains(load_profile(p), "dtlannc", "attitude") for p in (path, None))
    assert ours.position_loop.alpha == 0.123
    assert ours.position_loop == common.position_loop.model_copy(update={"alpha": 0.123})


def test_hover_thrust_and_rotors_follow_from_each_other(written):
    by_rotors = load_profile(written("mass_kg = 2.0\n[rotors]\nthrust_max_newton = 10.0\n"))
    assert by_rotors.hover_thrust == pytest.approx(2.0 * 9.81 / 40.0)
    by_hover = load_profile(written("mass_kg = 2.0\nhover_thrust = 0.25\n"))
    assert by_hover.rotors.thrust_max_newton == pytest.approx(2.0 * 9.81 / 4 / 0.25)


def test_torques_are_not_flown_on_guesses():
    with pytest.raises(UserError, match=r"inertia_kg_m2.*--profile"):
        load_settings(None, {"level": "actuator"})
    assert load_settings("qball2", {"level": "actuator"}).gains.position_loop.K_e[2] == 2.442


def test_a_response_that_overshoots_counts_as_late_as_it_turns(written):
    """ζ 0.5, ω 5 rad/s lags a ramp by 0.2 s only, but by 90° at 5 rad/s, where px4_sih does at 7.13 rad/s."""
    lively = "[responses.px4]\ndead_time_s = 0.0\ntilt = { natural_frequency_rad_s = 5.0, damping = 0.5 }\n"
    lag_s = total_lag_s(load_profile(written(lively)), ControlLevel.ATTITUDE, "px4")
    assert lag_s == pytest.approx(0.2367 * 7.13 / 5.0, rel=2e-3)
