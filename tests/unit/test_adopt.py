"""`companion adopt`: what it flies, what it refuses; what it finds is tested on flights (tests/flight)."""

import numpy as np
import pytest

from companion.cli.main import main
from companion.config.errors import UserError
from companion.reference.registry import trajectory_from_text


def test_steps_go_each_way_and_back_within_their_size():
    """2 s each: still, forward, back, left, back, up by 0.6 of it, back, turned, back; twice, 34 s in all."""
    steps = trajectory_from_text("steps,size_m=0.4,yaw_rad=0.3,height_m=2")
    assert steps.duration_s == pytest.approx(34.0)
    places = {t: steps.sample(t) for t in (1.0, 3.0, 5.0, 7.0, 11.0, 15.0, 17.0, 19.0, 33.0, 50.0)}
    assert np.allclose(places[3.0].position_enu, (0.4, 0.0, 2.0))
    assert np.allclose(places[7.0].position_enu, (0.0, 0.4, 2.0))
    assert np.allclose(places[11.0].position_enu, (0.0, 0.0, 2.24))
    assert places[15.0].yaw_rad == 0.3 and np.allclose(places[15.0].position_enu, (0.0, 0.0, 2.0))
    assert np.allclose(places[19.0].position_enu, (0.4, 0.0, 2.0))
    for still in (1.0, 5.0, 17.0, 33.0, 50.0):
        assert np.allclose(places[still].position_enu, (0.0, 0.0, 2.0)) and places[still].yaw_rad == 0.0


@pytest.mark.parametrize("wrong", ["size_m=0.9", "size_m=0.01", "yaw_rad=2", "hold_s=0.1", "rounds=0"])
def test_what_is_no_small_step_is_refused(wrong):
    with pytest.raises(UserError, match="steps: "):
        trajectory_from_text(f"steps,{wrong}")


def test_a_dry_run_says_the_room_and_flies_nothing(capsys):
    assert main(["adopt", "--endpoint", "udpin:127.0.0.1:1", "--dry-run", "--size", "0.4"]) == 0
    said = capsys.readouterr().out
    assert "1.4 m of room on every side" in said and "34 s" in said and "supervisor" in said


@pytest.mark.parametrize(
    "words, what",
    [
        ([], "give either a LOG, or where to fly"),
        (["flight.mcap", "--sitl", "px4"], "give either a LOG, or where to fly"),
        (["--sitl", "px4", "--level", "body_rate"], "adopt flies at level attitude"),
        (["nowhere.mcap"], "nowhere.mcap"),
    ],
)
def test_wrong_input_is_one_clear_error(words, what, capsys):
    assert main(["adopt", *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and what in said


def test_a_profile_that_is_there_is_kept(tmp_path, capsys):
    kept = tmp_path / "mine.toml"
    kept.write_text("mass_kg = 2.0\n")
    assert main(["adopt", "--sitl", "px4", "--write", str(kept)]) == 2
    assert "choose another name" in capsys.readouterr().err and kept.read_text() == "mass_kg = 2.0\n"
