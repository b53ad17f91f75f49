"""Reading tables of numbers (CSV with a header) so that every mistake is reported with its line."""

from __future__ import annotations

import contextlib
import csv
import difflib
import functools
import math
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.config.errors import UserError
from companion.control.structs import Vector

MAX_BYTES = 64 * 1024 * 1024
MOST_ROWS = 100_000
LARGEST_TIME = 1e11  # s; times may count from 1970, but their span is bound as everything is
LARGEST = 1e6  # nothing flown here is that far, late or fast; beyond it double precision runs out


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of finite numbers."""

    path: Path
    columns: dict[str, Vector]  # each (n,)
    lines: list[int]  # (n,) line of the file each row stands on, from 1

    def place(self, row: int) -> str:
        """Return `file:line` of a row."""
        return f"{self.path}:{self.lines[row]}"

    def stacked(self, names: tuple[str, ...]) -> Vector:
        """(n, len(names)) of the columns named."""
        return np.stack([self.columns[name] for name in names], axis=1)


def read_text(path: Path) -> str:
    """Return the text of a file. Raises UserError where there is none to read."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise UserError(f"{path}: larger than {MAX_BYTES // 2**20} MiB; thin it out or cut it")
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such file") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not a text file (byte {error.start} is not UTF-8)") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_table(path: Path, aliases: dict[str, str], required: tuple[str, ...]) -> Table:
    """Read a table whose first row names its columns, separated by commas, semicolons, tabs or blanks.

    `#` begins a comment line, but a first one that names the required columns is the header, as numpy.savetxt writes it.
    `aliases` maps each accepted column name, in lower case, to the name it is returned under; a unit in brackets
    behind a name belongs to it. Other columns are passed over, and named once on standard error. Raises UserError, with
    file and line, for a missing, misspelled or repeated column, a row of another length, and anything that is not a
    finite number.
    """
    lines = read_text(path).splitlines()
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    separator = next((mark for mark in (";", "\t", ",") if mark in first), None)
    rows: Any = (
        _Blanks(lines) if separator is None else csv.reader(lines, delimiter=separator, skipinitialspace=True)
    )
    try:
        return _read_rows(path, rows, aliases, required, separator == ";")
    except csv.Error as error:
        raise UserError(f"{path}:{rows.line_num}: not a comma-separated table: {error}") from None


class _Blanks:
    """Rows of words between blanks, counted as `csv.reader` counts them."""

    def __init__(self, lines: list[str]) -> None:
        self._lines = lines
        self.line_num = 0

    def __iter__(self) -> Iterator[list[str]]:
        for number, line in enumerate(self._lines, start=1):
            self.line_num = number
            yield line.split()


def _read_rows(
    path: Path, rows: Any, aliases: dict[str, str], required: tuple[str, ...], decimal_comma: bool
) -> Table:
    names: list[str | None] = []
    numbers: list[list[float]] = []
    lines: list[int] = []
    for row in rows:
        if not any(cell.strip() for cell in row):
            continue
        where = f"{path}:{rows.line_num}"
        if row[0].lstrip().startswith("#"):
            cells = [row[0].lstrip().lstrip("#"), *row[1:]]
            cells = [cell for cell in cells if cell.strip()] if not cells[0].strip() else cells
            known = [aliases.get(_plain_name(cell)) for cell in cells]
            if not names and all(name in known for name in required):
                names = _column_names(where, cells, aliases, required)
            continue
        if not names:
            if all(_is_number(cell, decimal_comma) for cell in row):
                raise UserError(
                    f"{where}: the file has no header: put a line above that names its {len(row)} columns, "
                    f"such as {','.join(required)}"
                )
            names = _column_names(where, row, aliases, required)
            continue
        if len(numbers) == MOST_ROWS:
            raise UserError(f"{where}: more than {MOST_ROWS} rows; thin the file out or cut it")
        if len(row) == len(names) + 1 and not row[-1].strip():
            row = row[:-1]  # some tools end each row with a separator
        if len(row) != len(names):
            raise UserError(f"{where}: {len(row)} values where the header names {len(names)} columns")
        numbers.append(
            [
                _number(where, name, cell.replace(",", ".") if decimal_comma else cell)
                for name, cell in zip(names, row, strict=True)
                if name is not None
            ]
        )
        lines.append(rows.line_num)
    if not names:
        raise UserError(f"{path}: is empty; the first row has to name the columns {', '.join(required)}")
    kept = [name for name in names if name is not None]
    table = np.array(numbers, dtype=np.float64).reshape(len(numbers), len(kept))
    columns = {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(kept)}
    if "t" in columns and len(numbers) and np.ptp(columns["t"]) > LARGEST:
        raise UserError(f"{path}: the times span {np.ptp(columns['t']):.3g}; they have to be in seconds")
    return Table(path, columns, lines)


_UNITS = {"s": "", "sec": "", "m": "", "m/s": "", "rad": "", "rad/s": "", "deg": "_deg", "°": "_deg"}


def _plain_name(cell: str) -> str:
    """`Time [s]` as `time`, `yaw (deg)` as `yaw_deg`; a unit that is none of ours stays, and makes the name unknown."""
    given = cell.strip().strip("\"'").lower()
    found = re.fullmatch(r"([^\[(]+?)\s*[\[(]([^\])]*)[\])]", given)
    if found is None or found[2].strip() not in _UNITS:
        return given
    return found[1].strip() + _UNITS[found[2].strip()]


def _is_number(cell: str, decimal_comma: bool) -> bool:
    try:
        float(cell.replace(",", ".") if decimal_comma else cell)
        return True
    except ValueError:
        return False


def _column_names(
    where: str, row: list[str], aliases: dict[str, str], required: tuple[str, ...]
) -> list[str | None]:
    names: list[str | None] = []
    passed_over = []
    while len(row) > 1 and not row[-1].strip():
        row = row[:-1]
    for cell in row:
        given = _plain_name(cell)
        name = aliases.get(given)
        if name is not None and name in names:
            raise UserError(f"{where}: column '{cell.strip()}' is there twice")
        if name is None:
            near = difflib.get_close_matches(given, aliases, n=1, cutoff=0.75)
            if near:
                raise UserError(
                    f"{where}: unknown column '{cell.strip()}'; did you mean '{near[0]}'? "
                    f"The header may name: {', '.join(aliases)}"
                )
            passed_over.append(cell.strip())
        names.append(name)
    missing = [name for name in required if name not in names]
    if missing:
        unknown = f"; not known: {', '.join(passed_over)}" if passed_over else ""
        raise UserError(
            f"{where}: column {', '.join(missing)} is missing; needed are {', '.join(required)}{unknown}"
        )
    if passed_over:
        say_once(f"{where}: passed over: column {', '.join(passed_over)}")
    return names


@functools.cache
def say_once(text: str) -> None:
    """A word that is no error; the file is read more than once on the way to a flight."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr)


def _number(where: str, name: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        raise UserError(f"{where}: column {name}: '{cell.strip()}' is not a number") from None
    if not math.isfinite(number):
        raise UserError(
            f"{where}: column {name}: {cell.strip()} is not a finite number; fill it in or delete the row"
        )
    if name == "t" and abs(number) > LARGEST_TIME:
        raise UserError(
            f"{where}: column t: {cell.strip()} is out of range; is it in ms, µs or ns? Give seconds"
        )
    if name != "t" and abs(number) > LARGEST:
        raise UserError(f"{where}: column {name}: {cell.strip()} is out of range (at most {LARGEST:g})")
    return number
