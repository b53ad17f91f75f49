"""Machine code where its usual place cannot be written, and commands that need none."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR")}
    return subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        env=kept | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )


def compiles(package: str) -> str:
    return (
        f"from {package}.compiled import compiled\n"
        "from colorsys import rgb_to_yiq\n"
        "print(compiled(rgb_to_yiq)(1.0, 1.0, 1.0)[0])"
    )


@pytest.mark.parametrize("package", ["companion.control", "sitl_stub.physics"])
@pytest.mark.parametrize(
    "environment",
    [
        {"HOME": "/proc/none"},
        {"HOME": "/tmp", "XDG_CACHE_HOME": "/dev/null/cache"},
        {"HOME": "/tmp", "NUMBA_CACHE_DIR": "/proc/none"},
    ],
    ids=["home", "cache home", "numba's own setting"],
)
def test_code_is_kept_in_a_temporary_place_and_said_once(tmp_path, package, environment):
    ended = run(compiles(package), TMPDIR=str(tmp_path), **environment)
    assert ended.returncode == 0, ended.stderr
    assert float(ended.stdout) == pytest.approx(1.0)
    assert ended.stderr.count("\n") == 1 and "cannot be written" in ended.stderr
    (place,) = tmp_path.iterdir()
    assert place.stat().st_mode & 0o777 == 0o700 and list(place.rglob("*.nbi"))


@pytest.mark.parametrize("package", ["companion.control", "sitl_stub.physics"])
def test_a_temporary_folder_that_others_can_write_is_not_believed(tmp_path, package):
    taken = tmp_path / {"companion.control": "dtlannc-companion", "sitl_stub.physics": "sitl-stub"}[package]
    taken = taken.with_name(f"{taken.name}-{os.getuid()}")
    taken.mkdir()
    taken.chmod(0o777)
    ended = run(compiles(package), TMPDIR=str(tmp_path), HOME="/proc/none")
    assert ended.returncode == 0, ended.stderr
    assert not list(taken.iterdir()) and list(tmp_path.rglob("*.nbi"))


@pytest.mark.parametrize("command", ["", "fly", "check", "analyze", "compare", "replay", "recover", "tune"])
def test_help_loads_nothing_that_takes_time(command):
    code = (
        "import sys\nfrom companion.cli.main import main\n"
        f"try: main([*{command!r}.split(), '--help'])\nexcept SystemExit: pass\n"
        "print([n for n in ('numba', 'numpy', 'pydantic', 'matplotlib', 'pymavlink') if n in sys.modules])"
    )
    assert run(code, HOME="/proc/none").stdout.splitlines()[-1] == "[]"


def test_what_reads_logs_compiles_nothing():
    modules = "analysis.metrics, analysis.comparison, analysis.table, flightlog.recovery, flightlog.tlog"
    imports = "\n".join(f"import companion.{name}" for name in modules.split(", "))
    assert run(f"import sys\n{imports}\nprint('numba' in sys.modules)", HOME="/proc/none").stdout == "False\n"


def test_version():
    ended = run("from companion.cli.main import main; main(['--version'])", HOME="/proc/none")
    assert ended.returncode == 0 and ended.stdout.startswith("companion ")
