"""Reads a shot table back."""

from __future__ import annotations

import csv
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.shot.shot import COLUMNS, Shot, ShotColumn


def read_shot_table(path: Path) -> list[Shot]:
    """Return the shots in `path`."""
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream, strict=True))
    return [Shot(**{column.name: _value(column, row[column.name]) for column in COLUMNS}) for row in rows]


def _value(column: ShotColumn, cell: str) -> Any:
    if column.optional and not cell:
        return None
    if column.kind is datetime:
        return datetime.fromisoformat(cell)
    if column.kind is str:
        return cell.removeprefix("'") if cell.lstrip("'")[:1] in {*"=+-@\t\r"} - {""} else cell
    return column.kind(cell)
