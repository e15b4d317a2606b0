"""The shot table as CSV (RFC 4180): comma, CRLF, UTF-8, decimal point, one header row.

Floats are written in positional notation with the fewest digits that read back to the same float; an
absent figure is an empty cell; times are UTC in ISO 8601. A text that a spreadsheet would take for a formula
has an apostrophe in front, which reading removes.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import BenchError
from bench.shot.shot import COLUMNS, Shot, ShotColumn, ShotStatus
from bench.telemetry.whole_file import whole_file


def write_shot_table(path: Path, shots: Sequence[Shot]) -> None:
    """Write one row a shot to `path`, whole or not at all. Raises BenchError when it cannot be stored."""
    with whole_file(path) as stream:
        stream.write(shot_table_text(shots).encode())


def shot_table_text(shots: Sequence[Shot]) -> str:
    """Return the table as text."""
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow([column.name for column in COLUMNS])
    table.writerows([_to_cell(getattr(shot, column.name)) for column in COLUMNS] for shot in shots)
    return text.getvalue()


def read_shot_table(path: Path) -> list[Shot]:
    """Return the shots in `path`; columns may stand in any order, unknown ones are ignored.

    Raises BenchError naming file, line and column when the table is not what `write_shot_table` writes.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            table = csv.DictReader(stream, strict=True)
            missing = [name for name in _REQUIRED if name not in (table.fieldnames or ())]
            if missing:
                raise BenchError(
                    str(path), f"no column {missing[0]}", "a shot table with its header", "export it again"
                )
            return [_to_shot(path, table.line_num, row) for row in table]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BenchError(str(path), str(error), "a shot table (CSV, UTF-8)", "check the file") from error


_FORMULA = re.compile("'*[=+\\-@\t\r]")
"""Beginning of a text that a spreadsheet would take for a formula, with apostrophes put in front already."""


def _to_cell(value: object) -> str:
    """Return `value` as the text of a cell."""
    if value is None:
        return ""
    if isinstance(value, datetime):
        return value.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
    if isinstance(value, float):
        return np.format_float_positional(value, unique=True, trim="0")
    if isinstance(value, str) and _FORMULA.match(value):
        return f"'{value}"
    return str(value)


def _to_shot(path: Path, line: int, row: dict[str, str | None]) -> Shot:
    """Return the shot in one row."""
    values: dict[str, Any] = {}
    for column in COLUMNS:
        if column.name not in row:
            continue  # a table of before there was this column
        cell = row[column.name]
        try:
            values[column.name] = _to_value(column, cell)
        except ValueError as error:
            raise BenchError(
                f"{path}, line {line}, {column.name}", repr(cell), _EXPECTED[column.kind], "correct the cell"
            ) from error
    try:
        return Shot(**values)
    except ValueError as error:
        raise BenchError(
            f"{path}, line {line}", str(error), "a consistent shot", "correct the row"
        ) from error


def _to_value(column: ShotColumn, cell: str | None) -> object:
    """Return the value in a cell; raises ValueError when it is not of the column's kind."""
    if cell is None:
        raise ValueError("the row is too short")
    if column.optional and not cell:
        return None
    if column.kind is float:
        number = float(cell)
        if not isfinite(number):
            raise ValueError("not finite")
        return number
    if column.kind is datetime:
        return datetime.fromisoformat(cell)
    if column.kind is str and _FORMULA.match(cell):
        return cell.removeprefix("'")
    return column.kind(cell)


_REQUIRED = [column.name for column in COLUMNS][: 1 + [c.name for c in COLUMNS].index("time_utc")]
"""Columns that every table has; those behind them came later and have defaults."""

_EXPECTED: dict[type, str] = {
    int: "a whole number",
    float: "a number with a decimal point, or nothing",
    str: "text",
    ShotStatus: f"one of {', '.join(ShotStatus)}",
    datetime: "a time in UTC such as 2026-11-01T09:17:39.000000Z",
}
