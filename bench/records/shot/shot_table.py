"""The shot table as CSV (RFC 4180): comma, CRLF, UTF-8, decimal point, one header row.

Floats are written in positional notation with the fewest digits that read back to the same float; an
absent figure is an empty cell; times are UTC in ISO 8601. A text that a spreadsheet would take for a formula
has an apostrophe in front.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from bench.records.shot.shot import COLUMNS, Shot
from bench.records.telemetry.atomic_file import atomic_file


def write_shot_table(path: Path, shots: Sequence[Shot]) -> None:
    """Write one row a shot to `path`, whole or not at all. Raises BenchError when it cannot be stored."""
    with atomic_file(path) as stream:
        stream.write(shot_table_text(shots).encode())


def shot_table_text(shots: Sequence[Shot]) -> str:
    """Return the table as text."""
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow(COLUMNS)
    table.writerows(map(_to_cell, vars(shot).values()) for shot in shots)
    return text.getvalue()


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
