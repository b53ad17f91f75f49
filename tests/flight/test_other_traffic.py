"""What others send on the link, and a serial bridge on it, change nothing: the same setpoints to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from stub_flights import fly_short, lockstep_stub

from companion.flight.outcome import Outcome

pytestmark = pytest.mark.flight
OF_THE_FLIGHT = ("/state", "/reference", "/setpoint", "/law_input", "/law_memory", "/terms", "/truth")


@pytest.mark.parametrize("firmware", ["px4", "ardupilot"])
def test_other_peoples_traffic_changes_nothing(tmp_path, firmware):
    """Every message there is, with random and extreme numbers, from four senders; 500 a second."""
    crowd = '[[fault]]\nkind = "other_traffic"\nafter = "start"\nat_s = 0.0\n'
    bridge = '[[fault]]\nkind = "link_pieces"\nsize = 64\nafter = "start"\nat_s = 0.0\n'
    flown = {}
    for name, faults in {"alone": "", "crowd": crowd, "bridge": bridge}.items():
        folder = tmp_path / name
        folder.mkdir()
        scenario = folder / "faults.toml"
        scenario.write_text(f"seed = 1\n{faults}")
        with lockstep_stub("--scenario", str(scenario), firmware=firmware) as stub:
            flown[name] = fly_short(stub, folder, trajectory="hover", fix=True)
        assert flown[name].result.outcome is Outcome.COMPLETED, flown[name].result.text
    assert int(flown["crowd"].record.metadata["wall link"]["other senders"]) > 5000
    alone = flown["alone"].record.channels
    for name in ("crowd", "bridge"):
        for topic in OF_THE_FLIGHT:
            assert np.array_equal(
                alone[topic].values, flown[name].record.channels[topic].values, equal_nan=True
            ), (name, topic)


def test_a_second_autopilots_traffic_changes_nothing_once_it_is_said_which_is_flown(tmp_path):
    """It is an ArduPilot, moves, answers commands that nobody gave it, and tells of other parameters."""
    flown = {}
    for name, share in {"alone": 0.0, "two": 1.0}.items():
        scenario = tmp_path / f"{name}.toml"
        scenario.write_text(
            '[[fault]]\nkind = "other_traffic"\nsenders = ["autopilot"]\n'
            f'probability = {share}\nafter = "start"\nat_s = 0.0\n'
        )
        with lockstep_stub("--scenario", str(scenario)) as stub:
            folder = tmp_path / name
            folder.mkdir()
            flown[name] = fly_short(stub, folder, trajectory="hover", system=1)
        assert flown[name].result.outcome is Outcome.COMPLETED, flown[name].result.text
    for topic in OF_THE_FLIGHT:
        alone, two = (flown[name].record.channels[topic].values for name in ("alone", "two"))
        assert np.array_equal(alone, two, equal_nan=True), topic
