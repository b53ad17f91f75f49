"""Tuned gains go into a profile's file, replace their own tables only, and come back the same."""

import shutil
import tomllib
from pathlib import Path

import pytest

from companion.config.errors import UserError
from companion.config.load import find_profile
from companion.config.settings import load_profile
from companion.tuning.profile_file import put_gains


@pytest.fixture
def copy(tmp_path):
    path = tmp_path / "mine.toml"
    shutil.copy(find_profile("qball2"), path)
    return path


def changed(gains):
    loop = gains.position_loop.model_copy(
        update={"K_e": (1.25, 1.25, 3.5), "kappa": 0.0375, "residual_bound": 0.05}
    )
    return gains.model_copy(update={"position_loop": loop, "command_filter_rad_s": 17.5})


@pytest.mark.parametrize("controller", ["dtlannc", "tlmbc", "nnsmc"])
@pytest.mark.parametrize("level", ["attitude", "body_rate", "actuator"])
def test_replaced_and_read_back(copy, controller, level):
    before = tomllib.loads(copy.read_text())
    profile = load_profile(str(copy))
    wanted = changed(getattr(profile.controllers[controller], level))
    put_gains(copy, controller, level, wanted, "[tuned] by a test")
    assert getattr(load_profile(str(copy)).controllers[controller], level) == wanted
    after = tomllib.loads(copy.read_text())
    before["controllers"].setdefault(controller, {}).pop(level, None)
    del after["controllers"][controller][level]
    assert before == after


def test_comments_stay_and_remarks_do_not_pile_up(copy):
    gains = load_profile(str(copy)).controllers["dtlannc"].body_rate
    comments = [
        line for line in copy.read_text().splitlines() if line.startswith("#") and "[tuned]" not in line
    ]
    for turn in range(3):
        put_gains(copy, "dtlannc", "body_rate", gains, f"[tuned] turn {turn}")
    text = copy.read_text()
    assert "[tuned] turn 2" in text and "turn 1" not in text and "turn 0" not in text
    assert [line for line in text.splitlines() if line.startswith("#") and "[tuned]" not in line] == comments
    assert text.count("[controllers.dtlannc.body_rate.position_loop]") == 1


def test_a_level_that_was_missing_is_added(tmp_path, copy):
    profile = load_profile(str(copy))
    lines = copy.read_text().split("[controllers.nnsmc.actuator")[0]
    copy.write_text(lines)
    assert load_profile(str(copy)).controllers["nnsmc"].actuator != profile.controllers["nnsmc"].actuator
    put_gains(copy, "nnsmc", "actuator", profile.controllers["nnsmc"].actuator, "")
    assert load_profile(str(copy)).controllers["nnsmc"].actuator == profile.controllers["nnsmc"].actuator


def test_a_file_that_cannot_be_written_is_one_clear_error(tmp_path):
    gains = load_profile("qball2").controllers["tlmbc"].attitude
    with pytest.raises(UserError, match="gains cannot be written"):
        put_gains(Path(tmp_path / "no" / "such.toml"), "tlmbc", "attitude", gains, "")
