"""What `import companion` and `import sitl_stub` give, and that it costs nothing until it is used."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest

import companion
import sitl_stub

EXPORTED = [
    "Checked",
    "Comparison",
    "ControlLaw",
    "FlightMetrics",
    "FlightRecord",
    "Flown",
    "Outcome",
    "Replay",
    "Settings",
    "UserError",
    "__version__",
    "analyze",
    "build_law",
    "check",
    "compare",
    "fly",
    "load_settings",
    "read_log",
    "register_law",
    "replay",
    "trajectory",
]


def test_the_exported_names_are_these() -> None:
    """A name more or less is a decision: it is for others to build on."""
    assert sorted(companion.__all__) == sorted(EXPORTED)
    assert sorted(sitl_stub.__all__) == ["FAULTS", "Stub", "StubError", "__version__"]
    assert set(EXPORTED) <= set(dir(companion))


@pytest.mark.parametrize("name", EXPORTED)
def test_each_is_there_and_documented(name: str) -> None:
    found = getattr(companion, name)
    if name != "__version__":
        assert inspect.getdoc(found)
        assert found.__name__ in (name, "trajectory_from_text")


def test_a_wrong_name_is_an_attribute_error_that_names_the_right_ones() -> None:
    with pytest.raises(AttributeError, match="no attribute 'flight_control'; it has Checked"):
        companion.flight_control  # noqa: B018


def test_importing_loads_nothing() -> None:
    heavy = ("numpy", "numba", "pydantic", "pymavlink")
    code = f"import sys, companion, sitl_stub; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_options_of_the_command_are_options_of_the_function() -> None:
    with pytest.raises(TypeError, match="companion fly has no option 'armed'"):
        companion.fly(sitl="px4", armed=True)
    with pytest.raises(companion.UserError, match="either endpoint='ADDRESS' or sitl='px4'"):
        companion.fly()
