"""What may import what: no circle in either package, and imports that point one way. Imports for types alone count."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

STUB_MAY_IMPORT = {
    "physics": {"physics"},
    "mavlink": {"mavlink"},
    "firmware/common": {"firmware/common", "mavlink", "physics"},
    "firmware/px4": {"firmware/px4", "firmware/common", "mavlink", "physics"},
    "firmware/ardupilot": {"firmware/ardupilot", "firmware/common", "mavlink", "physics"},
    "faults": {"faults", "firmware/px4", "firmware/ardupilot", "firmware/common", "mavlink", "physics"},
}
"""Rooms of the stub; the files above them (command line, server, simulation) may import every one."""
BRANDS = {"px4": ("px4",), "ardupilot": ("ardupilot", "arducopter")}
"""Wings, and the words that only they may use."""
SAME_IN_EVERY_BRAND = {
    "attitude_control", "autopilot", "battery", "build", "commander", "core", "land_detector", "layout", "loop",
    "messages", "mixing", "modes", "motion_messages", "parameter_protocol", "parameters", "position_control", "protocol",
    "state", "voice",
}  # fmt: skip
"""Files of a firmware that sitl_stub/firmware/README.md names: the folder to copy."""


def modules(package: str) -> dict[str, Path]:
    """Files of a package by module name."""
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports_of(path: Path, known: dict[str, Path], lazy: bool) -> set[str]:
    """Modules of `known` that a file imports: at its top and for types, and within functions if `lazy`."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    inside = {
        id(node)
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(function)
    }
    names: set[str] = set()
    for node in ast.walk(tree):
        if id(node) in inside and not lazy:
            continue
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names} & known.keys()
            names.update(submodules or {node.module})
    return names & known.keys()


def circle_in(graph: dict[str, set[str]]) -> list[str]:
    """One circle, its first module again at the end; empty when there is none."""
    done: set[str] = set()

    def walk(module: str, way: list[str]) -> list[str]:
        if module in way:
            return [*way[way.index(module) :], module]
        if module in done:
            return []
        for other in sorted(graph[module]):
            found = walk(other, [*way, module])
            if found:
                return found
        done.add(module)
        return []

    return next((found for module in sorted(graph) if (found := walk(module, []))), [])


def test_a_circle_is_found() -> None:
    """Of the search itself: a knot of three behind a way into it, and none where there is none."""
    graph = {"a": {"b"}, "b": {"c"}, "c": {"d"}, "d": {"b"}}
    assert circle_in(graph) == ["b", "c", "d", "b"]
    assert circle_in({**graph, "d": set()}) == []


@pytest.mark.parametrize("package", ["companion", "sitl_stub"])
def test_no_package_has_an_import_circle(package: str) -> None:
    """Not even one of imports for types."""
    known = modules(package)
    graph = {name: imports_of(path, known, lazy=False) - {name} for name, path in known.items()}
    assert circle_in(graph) == []


def room_of(module: str) -> str:
    """The room of the stub in which a module lies; empty for what stands above them."""
    path = module.replace(".", "/").removeprefix("sitl_stub/")
    return next((room for room in STUB_MAY_IMPORT if path == room or path.startswith(f"{room}/")), "")


def test_rooms_of_the_stub_import_downwards_only() -> None:
    """No brand knows another, common/ knows none, and nothing below faults/ knows of faults."""
    known = modules("sitl_stub")
    wrong = [
        f"{name} imports {other}"
        for name, path in known.items()
        if room_of(name)
        for other in imports_of(path, known, lazy=True)
        if room_of(other) not in STUB_MAY_IMPORT[room_of(name)]
    ]
    assert not wrong


def test_both_brands_have_the_same_files() -> None:
    """What one of them calls so, the other does too."""
    for brand in BRANDS:
        names = {path.stem for path in (ROOT / "sitl_stub/firmware" / brand).glob("*.py")}
        assert names >= SAME_IN_EVERY_BRAND, brand


def test_common_firmware_names_no_brand() -> None:
    """Nor does a wing name the other."""
    wrong = []
    for wing in ("common", *BRANDS):
        foreign = [word for brand, words in BRANDS.items() if brand != wing for word in words]
        for path in (ROOT / "sitl_stub/firmware" / wing).glob("*.py"):
            text = path.read_text(encoding="utf-8").lower()
            wrong += [f"{wing}/{path.name}: {word}" for word in foreign if word in text]
    assert not wrong
