"""Gains as TOML: the tables of one controller at one level, and putting them into a profile's file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from companion.config.errors import UserError
from companion.config.gains import ControllerGains


def gains_text(controller: str, level: str, gains: ControllerGains, remark: str = "") -> str:
    """The tables `[controllers.<controller>.<level>...]`, complete, `remark` as a comment above.

    What a profile leaves out is the common set's: so nothing is.
    """
    head = f"controllers.{controller}.{level}"
    lines = [f"# {remark}"] if remark else []
    tables = gains.model_dump()
    loops = ("position_loop", "attitude_loop", "lead")
    lines += [f"[{head}]", *_table({name: tables[name] for name in tables if name not in loops}), ""]
    for name in loops:
        lines += [f"[{head}.{name}]", *_table(tables[name]), ""]
    return "\n".join(lines)


def put_gains(path: Path, controller: str, level: str, gains: ControllerGains, remark: str) -> None:
    """Replace that controller's tables at that level in the profile at `path`, or add them at its end.

    Everything else in the file, comments included, stays as it is. Raises UserError where it cannot be written.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        text = _replaced(
            lines, f"controllers.{controller}.{level}", gains_text(controller, level, gains, remark)
        )
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: gains cannot be written ({error.strerror})") from None


def _replaced(lines: list[str], head: str, block: str) -> str:
    kept: list[str] = []
    at: int | None = None
    inside = False
    for line in lines:
        stripped = line.strip()
        if stripped.startswith("["):
            name = stripped.strip("[]")
            mine = name == head or name.startswith(head + ".")
            if mine and at is None:
                at = len(kept)
                while at and kept[at - 1].startswith("# [tuned]"):
                    kept.pop()  # the remark of the gains that go
                    at -= 1
            inside = mine
        elif inside and stripped.startswith("#"):
            inside = False  # a remark that stands between tables belongs to the next one
        if not inside:
            kept.append(line)
    if at is None:
        at = len(kept)
    head_lines, tail = kept[:at], kept[at:]
    while head_lines and not head_lines[-1].strip():
        head_lines.pop()
    out = [*head_lines, "", *block.rstrip("\n").splitlines(), ""]
    return "\n".join(out + tail).rstrip("\n") + "\n"


def _table(values: dict[str, Any]) -> list[str]:
    return [f"{name} = {_number(value)}" for name, value in values.items()]


def _number(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_number(entry) for entry in value) + "]"
    return str(value) if isinstance(value, int) else f"{value:.6g}"
