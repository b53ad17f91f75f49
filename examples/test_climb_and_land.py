"""The tests of `climb_and_land.py` against the stub: `pytest examples --sitl px4 --sitl ardupilot`."""

import pytest
from climb_and_land import climb_and_land


@pytest.mark.sitl(speed=8.0, ready_after_s=1.0)
def test_it_climbs_and_lands(sitl):
    assert climb_and_land(sitl.endpoint, 3.0) == pytest.approx(3.0, abs=0.3)


@pytest.mark.sitl(speed=8.0, ready_after_s=1.0)
@pytest.mark.parametrize("sitl", [{"mass_kg": 1.6}, {"wind": "4,2"}], ids=["light", "windy"], indirect=True)
def test_wind_and_weight_change_nothing(sitl):
    assert climb_and_land(sitl.endpoint, 3.0) == pytest.approx(3.0, abs=0.3)


@pytest.mark.sitl(speed=50.0, ready_after_s=60.0)
def test_a_refusal_is_passed_on(ardupilot_sitl):
    """ArduPilot says that it may be armed before it knows where it is; GUIDED then refuses."""
    with pytest.raises(RuntimeError, match="refused with 4"):
        climb_and_land(ardupilot_sitl.endpoint, 3.0)
