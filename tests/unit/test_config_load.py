"""Settings: every error at once, the nearest key, overrides, and what a log gets back."""

import pytest

from companion.config.errors import UserError
from companion.config.load import apply_overrides, find_profile, parse_override, shipped_profiles
from companion.config.profile import VehicleProfile
from companion.config.settings import load_profile, load_settings, select_gains, settings_from_tables


@pytest.fixture
def profile_file(tmp_path):
    """A copy of the shipped QBall2 with lines replaced."""

    def write(*changes):
        text = find_profile("qball2").read_text(encoding="utf-8")
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "mine.toml"
        path.write_text(text, encoding="utf-8")
        return str(path)

    return write


def message_of(call, *args, **kwargs):
    with pytest.raises(UserError) as caught:
        call(*args, **kwargs)
    return str(caught.value)


def test_every_error_is_listed_at_once_with_file_key_and_remedy(profile_file):
    path = profile_file(
        ("mass_kg = 1.79", "mass_kg = -1"),
        ("hover_thrust =", "hover_trust ="),
        ("lag_rad_s = 15.0", 'lag_rad_s = "fast"'),
        ('spin = "cw"', 'spin = "right"'),
        ("tilt_max_deg = 35.0", "tilt_max_deg = 70.0"),
    )
    message = message_of(load_profile, path)
    assert path in message
    assert "mass_kg: Input should be greater than 0 (it is -1)" in message
    assert "hover_trust: unknown key (did you mean 'hover_thrust'?)" in message
    assert "rotors.lag_rad_s" in message and "'fast'" in message
    assert "rotors.layout.1.spin" in message and "'cw'" in message
    assert "limits.tilt_max_deg: Input should be less than or equal to 60 (it is 70" in message
    assert "5 errors" in message


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("thrust_max_newton = 12.0", "thrust_max_newton = 4.0"), "1.2 times its weight"),
        (("tilt_abort_deg = 75.0", "tilt_abort_deg = 40.0"), "10° above tilt_max_deg"),
        (("mass_kg = 1.79", "mass_kg = nan"), "mass_kg"),
        (("mass_kg = 1.79", 'mass_kg = "1.79"'), "mass_kg"),
        (("mass_kg = 1.79", "mass_kg = 1.79 kg"), "is not TOML"),
    ],
)
def test_what_cannot_be_is_refused(profile_file, change, said):
    assert said in message_of(load_profile, profile_file(change))


def test_unknown_key_deep_in_the_gains(profile_file):
    path = profile_file(("feedback_s = ", "feedback_sec = "))
    message = message_of(load_profile, path)
    assert ".lead.feedback_sec: unknown key (did you mean 'feedback_s'?)" in message


def test_missing_profile_and_missing_file(tmp_path):
    message = message_of(load_profile, "qbal2")
    assert "did you mean 'qball2'" in message and "px4_sih" in message
    assert "cannot be read" in message_of(load_profile, str(tmp_path / "none.toml"))
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    assert "UTF-8" in message_of(load_profile, str(tmp_path / "bytes.toml"))


def test_overrides_reach_their_room():
    settings = load_settings(
        "qball2",
        {"level": "actuator"},
        [
            "flight.seed=7",
            "profile.mass_ratio=0.9",
            "profile.limits.tilt_max_deg=30",
            "gains.position_loop.K_U=[2.0, 2.5, 12]",
            "gains.lead.feedback_s=0",
            "flight.controller=nnsmc",
        ],
    )
    assert settings.flight.seed == 7 and settings.flight.controller == "nnsmc"
    assert settings.profile.mass_estimate_kg == pytest.approx(0.9 * 1.79)
    assert settings.profile.limits.tilt_max_deg == 30
    assert settings.gains.position_loop.K_U == (2.0, 2.5, 12.0)
    shipped = select_gains(load_profile("qball2"), "nnsmc", "actuator")
    assert settings.gains.position_loop.K_e == shipped.position_loop.K_e
    assert settings.gains.attitude_loop == shipped.attitude_loop


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("gains.position_loop.K_x=1", "did you mean 'position_loop.K_"),
        ("profile.limits.tilt_max=30", "did you mean 'limits.tilt_max_deg'"),
        ("flight.sed=1", "did you mean 'seed'"),
        ("gain.position_loop.K_U=1", "did you mean 'gains'"),
        ("seed", "write key=value"),
        ("=3", "write key=value"),
        ("gains.position_loop.K_U=high", "position_loop.K_U"),
        ("gains.position_loop.K_U=[1, 2]", "position_loop.K_U"),
        ("gains.position_loop.K_U=[1, -2, 3]", "position_loop.K_U.1"),
        ("flight.level=torque", "'attitude', 'body_rate' or 'actuator'"),
        ("flight.controller=dtlanc", "did you mean 'dtlannc'"),
    ],
)
def test_wrong_overrides_name_the_remedy(override, said):
    assert said in message_of(load_settings, "qball2", {}, [override])


def test_several_unknown_overrides_are_said_together():
    values = {"name": "x"}
    message = message_of(
        apply_overrides,
        VehicleProfile,
        values,
        [parse_override("mas_kg=1"), parse_override("gravty_m_s2=9.8")],
    )
    assert "mass_kg" in message and "gravity_m_s2" in message
    assert values == {"name": "x"}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a.b=1", 1),
        ("a.b=1.5", 1.5),
        ("a.b=[1,2]", [1, 2]),
        ("a.b=true", True),
        ("a.b=word", "word"),
        ("a.b=x=y", "x=y"),
    ],
)
def test_values_are_read_as_toml_or_as_text(text, value):
    assert parse_override(text) == (["a", "b"], value)


@pytest.mark.parametrize("name", shipped_profiles())
def test_settings_survive_the_log(name):
    settings = load_settings(name, {"level": "body_rate"}, ["flight.seed=3"])
    back = settings_from_tables(settings.as_tables())
    assert back == settings


def test_a_level_without_gains_is_refused(profile_file):
    profile = load_profile("qball2")
    levels = profile.controllers["tlmbc"].model_copy(update={"body_rate": None})
    poor = profile.model_copy(update={"controllers": {"tlmbc": levels}})
    assert "[controllers.tlmbc.body_rate.position_loop]" in message_of(
        select_gains, poor, "tlmbc", "body_rate"
    )
    assert "it has tlmbc" in message_of(select_gains, poor, "dtlannc", "attitude")
