"""A step repeated from the log gives the bits that were logged, and any change of the law shows."""

import argparse
import json

import numpy as np
import pytest

from companion.analysis.replay import laws_of, replay
from companion.cli import replay as command
from companion.config.errors import UserError
from companion.config.settings import load_settings
from companion.control.law import pack_input
from companion.control.registry import build_law
from companion.control.structs import AdaptationGate, ControlLevel, Reference, VehicleState
from companion.flightlog.law_channels import input_channel, law_terms_channel, memory_channel
from companion.flightlog.reader import read_log
from companion.flightlog.writer import FlightLog

STEPS = 120
HAND_OVER_AT = 70


def fly(path, settings, leave_out=()):
    """Steps of the law on a state that wanders, with one hand-over, logged as a flight logs them."""
    law = build_law(
        settings.flight.controller,
        settings.gains,
        settings.profile,
        settings.level,
        settings.flight.seed,
        autopilot="px4",
    )
    rng = np.random.default_rng(5)
    memory = law.initial_memory()
    attachments = {"settings.json": json.dumps(settings.as_tables())}
    with FlightLog(path, {"firmware": "PX4 1.17.0"}, attachments, utc_offset_ns=0) as log:
        channels = {
            "input": log.define(input_channel()),
            "memory": log.define(memory_channel(law.hidden)),
            "terms": log.define(law_terms_channel()),
        }
        for step in range(STEPS):
            level = np.array([1.0, 0.0, 0.0, 0.0])
            state = VehicleState(
                0.01 * step, rng.normal(0, 0.1, 3), rng.normal(0, 0.1, 3), level, rng.normal(0, 0.1, 3)
            )
            reference = Reference(*(rng.normal(0, 0.1, (5, 3))), 0.1, 0.0, 0.0)
            if step == HAND_OVER_AT:
                memory = law.take_over(memory, state, reference, 15.0, level)
            inputs = pack_input(state, reference, 0.01, AdaptationGate.RUN, law.thrust_bounds_newton)
            result = law.step_packed(memory, inputs)
            records = {"input": inputs, "memory": memory.to_array(), "terms": result.terms.values}
            for name, values in records.items():
                if name not in leave_out:
                    log.record(channels[name], state.time_s, values)
            memory = result.memory
    return read_log(path)


@pytest.mark.parametrize("controller", ["dtlannc", "tlmbc", "nnsmc"])
def test_repeated_steps_are_the_same_bits(tmp_path, controller):
    record = fly(
        tmp_path / "a.mcap", load_settings(flight={"controller": controller, "level": "actuator", "seed": 3})
    )
    found = replay(record)
    assert found.exact and found.steps == STEPS and found.mismatches == ()
    assert found.hand_overs == 1


def test_the_law_is_rebuilt_from_the_log_alone(tmp_path):
    settings = load_settings(overrides=["flight.seed=9", "gains.position_loop.alpha=0.123"])
    ((_, law),) = laws_of(fly(tmp_path / "a.mcap", settings))
    assert law.seed == 9 and law.parameters.position.alpha == 0.123 and law.level is ControlLevel.ATTITUDE


def test_another_gain_shows_in_the_terms_it_changes(tmp_path):
    settings = load_settings()
    record = fly(tmp_path / "a.mcap", settings)
    other = load_settings(overrides=["gains.position_loop.alpha=0.001"])
    law = build_law("dtlannc", other.gains, other.profile, other.level, 1, autopilot="px4")
    found = replay(record, law)
    assert not found.exact and found.identical == 0
    assert "position_sign_term" in found.mismatches[0].fields
    assert "position_error" not in found.mismatches[0].fields and found.mismatches[0].largest > 0


def test_another_seed_shows(tmp_path):
    record = fly(tmp_path / "a.mcap", load_settings())
    settings = load_settings(overrides=["flight.seed=2"])
    law = build_law("dtlannc", settings.gains, settings.profile, settings.level, 2, autopilot="px4")
    assert "position_network_term" in {
        name for item in replay(record, law).mismatches for name in item.fields
    }


def test_a_cut_log_is_repeated_as_far_as_it_goes(tmp_path):
    fly(tmp_path / "a.mcap", load_settings())
    cut = tmp_path / "cut.mcap"
    data = (tmp_path / "a.mcap").read_bytes()
    cut.write_bytes(data[:-1000])
    found = replay(read_log(cut))
    assert found.exact and 0 < found.steps <= STEPS


@pytest.mark.parametrize("missing", ["input", "memory", "terms"])
def test_what_is_missing_is_named(tmp_path, missing):
    record = fly(tmp_path / "a.mcap", load_settings(), leave_out=(missing,))
    with pytest.raises(UserError, match="cannot be repeated"):
        replay(record)


def test_a_log_without_settings_is_refused(tmp_path):
    with FlightLog(tmp_path / "a.mcap") as log:
        log.event("ended", 0.0, outcome="refused")
    with pytest.raises(UserError, match=r"settings\.json"):
        replay(read_log(tmp_path / "a.mcap"))


def test_the_command_says_how_many_steps_are_the_same(tmp_path, capsys):
    fly(tmp_path / "a.mcap", load_settings())
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers())
    arguments = parser.parse_args(["replay", str(tmp_path / "a.mcap")])
    assert arguments.run(arguments) == 0
    assert f"{STEPS} of {STEPS} steps" in capsys.readouterr().out
