"""pytest fixtures that start the stub: `sitl` (as `--sitl FIRMWARE` says), `px4_sitl` and `ardupilot_sitl`.

    @pytest.mark.sitl(wind="4,1.5", estimator="gps", speed=5.0)
    def test_my_script(sitl):
        subprocess.run([sys.executable, "my_script.py", sitl.endpoint], check=True)

pytest finds this module by the package's entry point; nothing has to be imported or configured. A fixture's value is a
running `sitl_stub.Stub` with ports of its own; it is gone when the test ends, however it ends, and also when the test
process is killed. The keyword arguments of the marker are those of `Stub`, without `firmware`; so are the keys of a
dict given by indirect parametrisation, which goes before the marker.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import pytest

from sitl_stub.arguments import FIRMWARES
from sitl_stub.stub_process import Stub, StubError

OPTIONS = tuple(name for name in inspect.signature(Stub).parameters if name != "firmware")
"""What the marker and indirect parameters may say."""
_MARKER = (
    "sitl(**options): how the fixtures sitl, px4_sitl and ardupilot_sitl start their stub; "
    f"keyword arguments of sitl_stub.Stub: {', '.join(OPTIONS)}"
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--sitl`."""
    parser.getgroup("sitl", "stand-in autopilots").addoption(
        "--sitl",
        action="append",
        default=[],
        choices=FIRMWARES,
        metavar="FIRMWARE",
        help=f"autopilot of the fixture `sitl`: {', '.join(FIRMWARES)} (default px4); "
        "given several times, every test that uses it runs with each",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    config.addinivalue_line("markers", _MARKER)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """One test for each `--sitl`."""
    if "sitl_firmware" in metafunc.fixturenames:
        wished = metafunc.config.getoption("--sitl") or [FIRMWARES[0]]
        metafunc.parametrize("sitl_firmware", list(dict.fromkeys(wished)), indirect=True)


@pytest.fixture
def sitl_firmware(request: pytest.FixtureRequest) -> str:
    """Name of the firmware that `sitl` runs."""
    return str(getattr(request, "param", FIRMWARES[0]))


@pytest.fixture
def sitl(request: pytest.FixtureRequest, sitl_firmware: str) -> Iterator[Stub]:
    """A running stub of the firmware that `--sitl` names."""
    yield from _running(request, sitl_firmware)


@pytest.fixture
def px4_sitl(request: pytest.FixtureRequest) -> Iterator[Stub]:
    """A running stub that behaves like PX4 1.17."""
    yield from _running(request, "px4")


@pytest.fixture
def ardupilot_sitl(request: pytest.FixtureRequest) -> Iterator[Stub]:
    """A running stub that behaves like ArduCopter 4.7."""
    yield from _running(request, "ardupilot")


def _running(request: pytest.FixtureRequest, firmware: str) -> Iterator[Stub]:
    try:
        stub = Stub(firmware, **_options(request))
        stub.start()
    except (StubError, ValueError) as error:
        pytest.fail(f"the stub did not start: {error}", pytrace=False)
    try:
        yield stub
        assert stub.process is not None
        code = stub.process.poll()
    finally:
        stub.stop()
    if code is not None and code > 0:  # a test may stop or kill it, but it must not die by itself
        pytest.fail(f"the stub ended with exit code {code}: {stub.errors}", pytrace=False)


def _options(request: pytest.FixtureRequest) -> dict[str, Any]:
    """The options of the test's markers, the nearest winning, and of its indirect parameter."""
    options: dict[str, Any] = {}
    marks = list(request.node.iter_markers("sitl"))
    for mark in reversed(marks):
        if mark.args:
            pytest.fail("pytest.mark.sitl takes keyword arguments only, for example speed=5.0", pytrace=False)
        options |= mark.kwargs
    parameter = getattr(request, "param", None) or {}
    if not isinstance(parameter, dict):
        pytest.fail(f"{request.fixturename}: the indirect parameter {parameter!r} is no dict", pytrace=False)
    options |= parameter
    for name in options:
        if name not in OPTIONS:
            pytest.fail(
                f"{request.fixturename}: no option {name!r}; there are {', '.join(OPTIONS)}", pytrace=False
            )
    return options
