"""Gains as TOML: the tables of one controller at one level, and putting them into a profile's file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from companion.config.errors import UserError
from companion.config.gains import ControllerGains, LeadGains, LoopGains

NETWORK_ONLY = ("alpha", "boundary_width", "N", "kappa", "weight_bound", "residual_bound", "input_scales")


def gains_text(controller: str, level: str, gains: ControllerGains, remark: str = "") -> str:
    """The tables `[controllers.<controller>.<level>...]`, defaults left out, `remark` as a comment above."""
    head = f"controllers.{controller}.{level}"
    lines = [f"# {remark}"] if remark else []
    plain = _table(gains.model_dump(), ControllerGains, ("position_loop", "attitude_loop", "lead"))
    if plain:
        lines += [f"[{head}]", *plain, ""]
    for name, kind in (("position_loop", LoopGains), ("attitude_loop", LoopGains), ("lead", LeadGains)):
        lines += [f"[{head}.{name}]", *_table(getattr(gains, name).model_dump(), kind), ""]
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


def _table(values: dict[str, Any], kind: Any, without: tuple[str, ...] = ()) -> list[str]:
    lines = []
    for name, value in values.items():
        field = kind.model_fields[name]
        if name in without or (
            not field.is_required() and value == field.get_default(call_default_factory=True)
        ):
            continue
        lines.append(f"{name} = {_number(value)}")
    return lines


def _number(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_number(entry) for entry in value) + "]"
    return str(value) if isinstance(value, int) else f"{value:.6g}"
