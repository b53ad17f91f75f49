"""The pages against the code: links lead somewhere, commands parse, names exist, examples do what is said of them."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import importlib.util
import re
import shlex
import tomllib
import unicodedata
from pathlib import Path

import numpy as np
import pytest

from companion.cli.main import COMMANDS
from companion.cli.sitl import FIRMWARES
from companion.config.load import read_toml, shipped_profiles, validated
from companion.config.profile import VehicleProfile
from companion.config.resolve import profile_values
from companion.config.settings import GAINS_OF, load_settings
from companion.control import laws, registry
from companion.control.compiled import python_twin
from companion.control.laws import LAWS
from companion.control.structs import AdaptationGate, ControlLevel, Reference, VehicleState
from companion.live.trajectory import trajectory_or_live
from companion.mavlink.endpoint import parse_endpoint
from companion.reference.csv_file import csv_trajectory
from companion.reference.minimum_snap import waypoint_trajectory
from companion.reference.registry import CATALOGUE, describe_trajectories

PROJECT = Path(__file__).resolve().parents[2]
PAGES = sorted([PROJECT / "README.md", *(PROJECT / "docs").rglob("*.md")])
FENCE = re.compile(r"^[ ]*```(\w*)\n(.*?)^[ ]*```", re.S | re.M)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)")
COMMAND = re.compile(r"^\s*(?:\$ )?(?:\.venv/bin/)?(companion|sitl-stub)( .*)?$")
OWN_LAWS = {"my_law"}  # of the pages that tell how to add one


def name_of(page: Path) -> str:
    return str(page.relative_to(PROJECT))


def blocks(page: Path, *languages: str) -> list[str]:
    return [body for language, body in FENCE.findall(page.read_text()) if language in languages]


def without_blocks(page: Path) -> str:
    return FENCE.sub("", page.read_text())


def commands() -> list[tuple[str, str]]:
    """(page, command line) of every fenced block; a backslash at the end of a line goes on with the next."""
    found = []
    for page in PAGES:
        for _, body in FENCE.findall(page.read_text()):
            for line in re.sub(r"\\\n\s*", " ", body).splitlines():
                if match := COMMAND.match(line):
                    found.append((name_of(page), match.group(1) + (match.group(2) or "")))
    return found


def companion_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="companion", exit_on_error=False)
    subparsers = parser.add_subparsers(dest="command", required=True)
    for name in COMMANDS:
        importlib.import_module(f"companion.cli.{name.replace('-', '_')}").add_parser(subparsers)
    return parser


def stub_parser() -> argparse.ArgumentParser:
    return importlib.import_module("sitl_stub.arguments").parser()


def parsed(parser: argparse.ArgumentParser, words: list[str], shown: str) -> argparse.Namespace | None:
    """What the real parser makes of `words`; None for --help, which ends it too."""
    try:
        return parser.parse_args(words)
    except SystemExit as end:
        assert end.code == 0, f"{shown}: the parser refuses it"
    except argparse.ArgumentError as error:
        pytest.fail(f"{shown}: {error}")
    return None


# Links ------------------------------------------------------------------------------------------------------


def anchors(page: Path) -> set[str]:
    """GitHub's: lower case, spaces to hyphens, punctuation gone."""
    found = set()
    for heading in re.findall(r"^#+ (.*)$", without_blocks(page), re.M):
        kept = "".join(c for c in heading.lower() if c in " -_" or unicodedata.category(c)[0] in "LN")
        found.add(kept.strip().replace(" ", "-"))
    return found


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for target in LINK.findall(without_blocks(page)):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        there = (page.parent / file).resolve() if file else page
        if not there.exists() or (anchor and anchor not in anchors(there)):
            broken.append(target)
    assert not broken


def test_every_page_is_in_the_index() -> None:
    index = PROJECT / "docs" / "README.md"
    linked = {target.partition("#")[0] for target in LINK.findall(index.read_text())}
    pages = {path.name for path in (PROJECT / "docs").glob("*.md")} - {"README.md"}
    assert pages == {target for target in linked if "/" not in target}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_named_in_the_text_exist(page: Path) -> None:
    named = re.findall(r"`((?:companion|sitl_stub|tests|scripts)/[\w./]+)`", without_blocks(page))
    missing = [name for name in named if not (PROJECT / name.rstrip("/")).exists()]
    written_by_the_reader = {"companion/control/pid.py"}
    assert set(missing) <= written_by_the_reader


# Commands ---------------------------------------------------------------------------------------------------


def test_there_are_commands_to_check() -> None:
    assert len(commands()) > 30


@pytest.mark.parametrize(("page", "line"), commands())
def test_commands_are_understood(page: str, line: str) -> None:
    shown = f"{page}: {line}"
    assert "…" not in line, f"{shown}: an ellipsis cannot be typed"
    words = shlex.split(line, comments=True)
    if words[0] == "sitl-stub":
        parsed(stub_parser(), words[1:], shown)
        return
    arguments = parsed(companion_parser(), words[1:], shown)
    if arguments is not None:
        check_values(arguments, shown)


def check_values(arguments: argparse.Namespace, shown: str) -> None:
    """What the parser leaves to the code behind it: names of profiles, laws, trajectories, settings, addresses."""
    given = vars(arguments)
    profile = given.get("profile") or "qball2"
    assert profile.endswith(".toml") or profile in shipped_profiles(), shown
    for name in [given.get("controller"), *(given.get("controllers") or "").split(",")]:
        assert not name or name in LAWS or name in OWN_LAWS or name.endswith(".py"), shown
    if given.get("endpoint"):
        parse_endpoint(given["endpoint"])
    if given.get("sitl"):
        assert given["sitl"] in FIRMWARES, shown
        parsed(stub_parser(), shlex.split(given.get("sitl_options") or ""), shown)
    if given.get("trajectory"):
        check_trajectory(given["trajectory"])
    check_overrides(given.get("overrides") or [], profile)


def check_trajectory(text: str) -> None:
    head = text.partition(",")[0]
    name = head.partition(":")[0]
    if name in ("waypoints", "csv", "mission") or Path(head).suffix in (".toml", ".csv"):
        return  # the reader's own file
    trajectory_or_live(text)


def check_overrides(overrides: list[str], profile: str = "qball2") -> None:
    """Raises UserError for a setting that does not exist or a value that is refused."""
    load_settings("qball2" if profile.endswith(".toml") else profile, {}, overrides)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_settings_named_in_the_text_exist(page: Path) -> None:
    for override in re.findall(r"--set ([\w.]+=(?:\[[^\]]*\]|[^\s`]+))", without_blocks(page)):
        check_overrides([override])


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_trajectories_and_profiles_named_in_the_text_exist(page: Path) -> None:
    text = without_blocks(page)
    for word in re.findall(r"--trajectory ([\w:.,=]+)", text):
        if not word.startswith("NAME"):
            check_trajectory(word.rstrip(".,"))
    for word in re.findall(r"--profile ([\w./]+)", text):
        assert word.rstrip(".").endswith(".toml") or word in shipped_profiles()


# Examples ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_and_toml_are_whole(page: Path) -> None:
    for code in blocks(page, "python"):
        compile(code, name_of(page), "exec")
    for text in blocks(page, "toml"):
        tomllib.loads(text)


def test_the_trajectories_of_the_page_are_those_of_the_code(tmp_path: Path, monkeypatch) -> None:
    page = PROJECT / "docs" / "trajectories.md"
    text = page.read_text()
    for line in describe_trajectories().splitlines():
        name, _, options = line.partition("  ")
        row = next(row for row in text.splitlines() if row.startswith(f"| `{name}` |"))
        assert all(option in row for option in options.split(", "))
    rows = re.findall(r"^\| `(\w+)(?::FILE)?` \|", text, re.M)
    assert rows == list(CATALOGUE)

    tour = tmp_path / "tour.toml"
    tour.write_text(next(block for block in blocks(page, "toml") if "[[waypoint]]" in block))
    flown = waypoint_trajectory(tour)
    np.testing.assert_allclose(flown.sample(0.0).position_enu, [0.0, 0.0, 1.0], atol=1e-9)
    assert 5.0 < flown.duration_s < 30.0

    monkeypatch.chdir(tmp_path)
    exec(compile(blocks(page, "python")[0], "trajectories.md", "exec"), {})
    assert csv_trajectory(tmp_path / "loop.csv").duration_s == pytest.approx(10.0)


def test_the_law_of_the_page_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example's file and the gains as printed: standing where it should, it carries just the weight it was told."""
    page = PROJECT / "docs" / "adding_a_law.md"
    example = (PROJECT / "examples" / "my_law.py").read_text()
    printed = blocks(page, "python")[0]
    assert printed.partition("from companion import")[2] == example.partition("from companion import")[
        2
    ].replace("`companion/control/packing.py`", "`packing.py`")
    monkeypatch.setattr(laws, "LAWS", dict(LAWS))
    monkeypatch.setitem(GAINS_OF, "my_law", "tlmbc")
    assert laws.load_law_file(PROJECT / "examples" / "my_law.py") == "my_law"
    plain = dataclasses.replace(laws.LAWS["my_law"], step=python_twin(laws.LAWS["my_law"].kernel))
    monkeypatch.setitem(laws.LAWS, "my_law", plain)

    values = read_toml(PROJECT / "companion" / "config" / "profiles" / "qball2.toml")
    values["controllers"] |= tomllib.loads(blocks(page, "toml")[0])["controllers"]
    profile = validated(VehicleProfile, profile_values(values), "adding_a_law.md")
    gains = profile.controllers["my_law"].attitude
    assert gains is not None
    law = registry.build_law("my_law", gains, profile, ControlLevel.ATTITUDE, seed=1)

    still, level = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    state = VehicleState(0.0, still, still, level, still)
    here = Reference(still, still, still, still, still, 0.0, 0.0, 0.0)
    result = law.step(law.initial_memory(), state, here, 0.01, AdaptationGate.RUN)
    assert result.terms.values.force[2] == pytest.approx(1.253 * 9.81)
    ahead = dataclasses.replace(here, position_enu=np.array([0.1, 0.0, 0.0]))
    pulled = law.step(law.initial_memory(), state, ahead, 0.01, AdaptationGate.RUN)
    assert pulled.terms.values.force[0] == pytest.approx(3.0 * 1.5 * 0.1)  # K_U K_p e by hand


def test_the_profile_page_names_every_field() -> None:
    """A field that is added to the profile has to be explained where people are told how to fill it in."""
    text = (PROJECT / "docs" / "real_px4.md").read_text()
    section = text.partition("## The profile")[2].partition("\n## ")[0]

    def fields(model: type, prefix: str = "") -> list[str]:
        return [prefix + name for name in model.model_fields]  # type: ignore[attr-defined]

    from companion.config.profile import AutopilotResponse, Limits, Rotors

    names = [name for name in fields(VehicleProfile) if name not in ("rotors", "limits", "responses")]
    names += [name for model in (Rotors, Limits, AutopilotResponse) for name in fields(model)]
    assert not [name for name in names if name not in section]


def test_imports_go_the_way_the_architecture_page_says() -> None:
    """A room imports from its own row of the picture or those below; nobody but tuning imports the stub."""
    picture = (
        (PROJECT / "docs" / "architecture.md")
        .read_text()
        .partition("## The house")[2]
        .partition("sitl_stub/")[0]
    )
    rows = [re.findall(r"(?:^|\s)(\w+)/(?=\s)", row) for row in picture.split("↓")]
    depth = {room: number for number, row in enumerate(rows) for room in row if room != "companion"}
    folders = {path.name for path in (PROJECT / "companion").iterdir() if (path / "__init__.py").exists()}
    assert set(depth) == folders
    upwards, strangers = [], []
    for file in sorted((PROJECT / "companion").glob("*/*.py")):
        room = file.parent.name
        for package, imported in re.findall(
            r"^\s*(?:from|import) (companion|sitl_stub)\.(\w+)", file.read_text(), re.M
        ):
            if package == "sitl_stub":
                strangers.append(room)
            elif depth[imported] < depth[room]:
                upwards.append(f"{file.name} imports companion.{imported}")
    assert not upwards
    assert set(strangers) <= {"tuning"}
