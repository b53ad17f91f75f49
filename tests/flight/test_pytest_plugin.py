"""The pytest plugin, from outside: pytest runs in a process of its own, as somebody else would run it."""

import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import pytest

pytestmark = pytest.mark.flight
PROJECT = Path(__file__).resolve().parents[2]
PLUGIN = "sitl_stub.pytest_plugin"


def pytest_command(folder: Path, *words: str) -> list[str]:
    """Without the project's own settings; an older installation of the package may not name the plugin yet."""
    installed = any(entry.value == PLUGIN for entry in entry_points(group="pytest11"))
    named = [] if installed else ["-p", PLUGIN]
    options = ["-c", os.devnull, "--rootdir", str(folder), "-p", "no:cacheprovider", "-v", "--strict-markers"]
    return [sys.executable, "-m", "pytest", *named, *options, *words]


def run_pytest(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        pytest_command(folder, *words),
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(PROJECT), str(folder)))},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


def outcomes(output: str) -> dict[str, str]:
    """Test (without its file) to PASSED, FAILED or ERROR."""
    return dict(re.findall(r"::(\S+) (PASSED|FAILED|ERROR)", output))


def test_the_package_announces_the_plugin() -> None:
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["pytest11"] == {"sitl": PLUGIN}
    assert not [need for need in project["dependencies"] if need.startswith("pytest")]


def test_the_pages_example_tests_somebody_elses_script_on_both_firmwares(tmp_path: Path) -> None:
    for file in (PROJECT / "examples").glob("*climb_and_land.py"):
        (tmp_path / file.name).write_text(file.read_text())
    done = run_pytest(tmp_path, "--sitl", "px4", "--sitl", "ardupilot", "-k", "climbs or refusal")
    assert done.returncode == 0, done.stdout + done.stderr
    assert set(outcomes(done.stdout)) == {
        "test_it_climbs_and_lands[px4]",
        "test_it_climbs_and_lands[ardupilot]",
        "test_a_refusal_is_passed_on",
    }


FIXTURES = """
import pytest

pytestmark = pytest.mark.sitl(seed=3, wind="1")

def test_as_the_option_says(sitl):
    assert sitl.ready["firmware"] == "px4-1.13" and sitl.ready["seed"] == 3

def test_named(px4_sitl, ardupilot_sitl):
    assert (px4_sitl.ready["firmware"], ardupilot_sitl.ready["firmware"]) == ("px4", "ardupilot")
    assert px4_sitl.endpoint != ardupilot_sitl.endpoint

@pytest.mark.sitl(seed=4, vehicle="px4_sih", parameters={"MC_ROLL_P": 6.0}, estimator="gps")
@pytest.mark.parametrize("px4_sitl", [{"seed": 5, "lockstep": True}], indirect=True)
def test_the_nearest_wins(px4_sitl):
    ready = px4_sitl.ready
    assert (ready["seed"], ready["vehicle"], ready["estimator"], ready["lockstep"]) == (5, "px4_sih", "gps", True)
    assert "--wind" in px4_sitl.command and "MC_ROLL_P=6.0" in px4_sitl.command

@pytest.mark.sitl(scenario="faults.toml", ready_after_s=0.5)
def test_faults_by_file_and_by_call(px4_sitl):
    px4_sitl.inject("link_loss", for_s=1.0)

@pytest.mark.sitl(winds="4")
def test_a_wrong_option(sitl):
    pass

@pytest.mark.sitl(vehicle="nope")
def test_a_refused_value(sitl):
    pass

def test_a_stub_that_is_stopped_on_purpose(sitl):
    sitl.process.kill()
"""


def test_options_reach_the_stub_and_wrong_ones_are_named(tmp_path: Path) -> None:
    (tmp_path / "test_fixtures.py").write_text(FIXTURES)
    (tmp_path / "faults.toml").write_text('[[fault]]\nkind = "link_delay"\nat_s = 5.0\ndelay_s = 0.2\n')
    done = run_pytest(tmp_path, "--sitl", "px4-1.13", "--tb=short")
    assert outcomes(done.stdout) == {
        "test_as_the_option_says[px4-1.13]": "PASSED",
        "test_named": "PASSED",
        "test_the_nearest_wins[px4_sitl0]": "PASSED",
        "test_faults_by_file_and_by_call": "PASSED",
        "test_a_wrong_option[px4-1.13]": "ERROR",
        "test_a_refused_value[px4-1.13]": "ERROR",
        "test_a_stub_that_is_stopped_on_purpose[px4-1.13]": "PASSED",
    }, done.stdout + done.stderr
    assert "sitl: no option 'winds'; there are vehicle, estimator, seed" in done.stdout
    assert re.search(r"the stub did not start: sitl-stub: .*nope", done.stdout)


def test_a_firmware_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    done = run_pytest(tmp_path, "--sitl", "betaflight")
    assert done.returncode == 4
    assert "choose from" in done.stderr and "ardupilot" in done.stderr


HANGING = """
import os, pathlib, time

def test_hangs(sitl):
    pathlib.Path("pids").write_text(f"{os.getpid()} {sitl.process.pid}\\n")
    time.sleep(600)
"""


def gone(pid: int) -> bool:
    """Ended; one that only waits for somebody to look counts as ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def wait_until(condition, timeout_s: float = 60.0) -> bool:
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def test_a_killed_test_process_leaves_no_stub_behind(tmp_path: Path) -> None:
    """Killed at once, while the stub still loads."""
    (tmp_path / "test_hanging.py").write_text(HANGING)
    process = subprocess.Popen(
        pytest_command(tmp_path),
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(PROJECT)},
        stdout=subprocess.DEVNULL,
    )
    noted = tmp_path / "pids"
    try:
        assert wait_until(lambda: noted.exists() and noted.read_text().endswith("\n"))
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    _, stub = map(int, noted.read_text().split())
    assert wait_until(lambda: gone(stub)), "the stub outlived its test"


def test_several_workers_have_stubs_of_their_own(tmp_path: Path) -> None:
    pytest.importorskip("xdist")
    (tmp_path / "test_many.py").write_text(
        "import pytest\n"
        "@pytest.mark.parametrize('number', range(2))\n"
        "def test_started(sitl, number):\n"
        "    print('endpoint', sitl.endpoint)\n"
    )
    done = run_pytest(tmp_path, "-n", "2", "-rP")
    assert done.returncode == 0, done.stdout
    assert len(set(re.findall(r"^endpoint (\S+)", done.stdout, re.M))) == 2
