"""Reads a shot table back."""

from __future__ import annotations

import csv
from datetime import datetime
from pathlib import Path
from typing import Any, get_args, get_type_hints

from bench.records.shot.shot import Shot

KINDS = {
    name: ((get_args(hint) or (hint,))[0], bool(get_args(hint)))
    for name, hint in get_type_hints(Shot).items()
}
"""Type of each column, and whether it may be empty."""


def read_shot_table(path: Path) -> list[Shot]:
    """Return the shots in `path`."""
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream, strict=True))
    return [Shot(**{name: _value(*kind, row[name]) for name, kind in KINDS.items()}) for row in rows]


def _value(kind: type, optional: bool, cell: str) -> Any:
    if optional and not cell:
        return None
    if kind is datetime:
        return datetime.fromisoformat(cell)
    if kind is str:
        return cell.removeprefix("'") if cell.lstrip("'")[:1] in {*"=+-@\t\r"} - {""} else cell
    return kind(cell)
