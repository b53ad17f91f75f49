"""Reading tables of numbers (CSV with a header) so that every mistake is reported with its line."""

from __future__ import annotations

import csv
import difflib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.config.errors import UserError
from companion.control.structs import Vector

MAX_BYTES = 64 * 1024 * 1024
MOST_ROWS = 100_000
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
    """Read a comma-separated table whose first row names its columns; `#` begins a comment line.

    `aliases` maps each accepted column name, in lower case, to the name it is returned under. Raises
    UserError, with file and line, for a missing, unknown or repeated column, a row of another length, and
    anything that is not a finite number.
    """
    rows = csv.reader(read_text(path).splitlines(), skipinitialspace=True)
    try:
        return _read_rows(path, rows, aliases, required)
    except csv.Error as error:
        raise UserError(f"{path}:{rows.line_num}: not a comma-separated table: {error}") from None


def _read_rows(path: Path, rows: Any, aliases: dict[str, str], required: tuple[str, ...]) -> Table:
    names: list[str] = []
    numbers: list[list[float]] = []
    lines: list[int] = []
    for row in rows:
        if not row or row[0].lstrip().startswith("#") or not any(cell.strip() for cell in row):
            continue
        where = f"{path}:{rows.line_num}"
        if not names:
            names = _column_names(where, row, aliases, required)
            continue
        if len(numbers) == MOST_ROWS:
            raise UserError(f"{where}: more than {MOST_ROWS} rows; thin the file out or cut it")
        if len(row) != len(names):
            raise UserError(f"{where}: {len(row)} values where the header names {len(names)} columns")
        numbers.append([_number(where, name, cell) for name, cell in zip(names, row, strict=True)])
        lines.append(rows.line_num)
    if not names:
        raise UserError(f"{path}: is empty; the first row has to name the columns {', '.join(required)}")
    table = np.array(numbers, dtype=np.float64).reshape(len(numbers), len(names))
    columns = {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(names)}
    return Table(path, columns, lines)


def _column_names(
    where: str, row: list[str], aliases: dict[str, str], required: tuple[str, ...]
) -> list[str]:
    names = []
    for cell in row:
        given = cell.strip().lower()
        if given not in aliases:
            near = difflib.get_close_matches(given, aliases, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise UserError(
                f"{where}: unknown column '{cell.strip()}'{hint} The header may name: {', '.join(aliases)}"
            )
        if aliases[given] in names:
            raise UserError(f"{where}: column '{cell.strip()}' is there twice")
        names.append(aliases[given])
    missing = [name for name in required if name not in names]
    if missing:
        raise UserError(f"{where}: column {', '.join(missing)} is missing; needed are {', '.join(required)}")
    return names


def _number(where: str, name: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        raise UserError(f"{where}: column {name}: '{cell.strip()}' is not a number") from None
    if not math.isfinite(number):
        raise UserError(
            f"{where}: column {name}: {cell.strip()} is not a finite number; fill it in or delete the row"
        )
    if abs(number) > LARGEST:
        raise UserError(f"{where}: column {name}: {cell.strip()} is out of range (at most {LARGEST:g})")
    return number
