"""Tables of measurements in CSV, as devices export them: one row of cells per measurement.

Read are UTF-8 and UTF-16, the separators comma, semicolon and tab (also named by a first line `sep=;`), lines
before the header, a row of units below it, and headers that are repeated. Rows of averages and deviations are
left out. Column names are compared in lower case, words joined by underscores: "Ball Speed (mph)" is
"ball_speed_mph".
"""

from __future__ import annotations

import csv
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable, Iterator, Sequence
from io import StringIO
from itertools import islice
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from bench.errors import BenchError

_SEPARATORS = ",;\t"
_HEADER_LINES = 20
"""Maximum number of lines in which the header is searched."""
_FILES = {b"PK\x03\x04": "a workbook (xlsx)", b"\xd0\xcf\x11\xe0": "a workbook (xls)", b"%PDF": "a PDF"}
_SUMMARY = r"(avg|average|mean|median|summary|sd|(std_|st_|standard_|std)?dev(iation)?)s?"
_LABEL = re.compile(rf"{_SUMMARY}(_.*)?|(min|max)(imum)?|longest|shortest|total|consistency")
"""First cell of a row that sums up others; elsewhere only a summary's own word counts."""
_NO_VALUE = {"", "-", "--", "–", "—", "n/a", "na", "nan", "null", "none"}
_UNIT = re.compile(r"[\[(].*[\])]|%|°|mph|kph|rpm|deg(rees)?|yds?|yards|fe?e?t|m|s|sec|(km/h|m/s|ft/s)")


class MeasurementTable(NamedTuple):
    """Columns and rows of a file."""

    path: Path
    header: int
    """Line of the header."""
    names: tuple[str, ...]
    """Column names as they stand."""
    keys: tuple[str, ...]
    """Column names for comparison."""
    units: tuple[str, ...]
    """Units below the names, for comparison; empty without one."""
    rows: tuple[tuple[int, tuple[str, ...]], ...]
    """Line and stripped cells of each measurement; empty where there is no value."""
    decimal_comma: bool
    notes: tuple[str, ...]
    """Lines that are not measurements."""

    def number(self, line: int, column: int, cell: str, *, sided: bool = False) -> float:
        """Return the number in `cell`; where `sided` it may end with L (negative) or R, as devices print it.

        Raises:
            BenchError: the cell is not a finite number.
        """
        text, sign = cell, 1.0
        if sided and (side := re.fullmatch(r"([\d.,]+)\s*([LR])", cell, re.IGNORECASE)):
            text, sign = side[1], -1.0 if side[2] in "lL" else 1.0
        try:
            if self.decimal_comma and "." in text:
                raise ValueError
            value = sign * float(text.replace(",", ".") if self.decimal_comma else text)
        except ValueError:
            value = float("nan")
        if not isfinite(value):
            mark = "comma, as in other cells" if self.decimal_comma else "point"
            expected = f"a number with a decimal {mark}" + (", L or R behind it" if sided else "")
            raise BenchError(self.place(line, column), repr(cell), expected, "Correct the cell in the file.")
        return value

    def place(self, line: int, column: int) -> str:
        """Return the place of a cell."""
        return f"{self.path}, line {line}, {self.names[column]} (column {column + 1})"


def read_table(path: Path, known: Callable[[str], bool]) -> MeasurementTable:
    """Return the table in the file at `path`; `known` says whether a column key is one of the header's.

    Raises:
        BenchError: the file cannot be read, is no table, or a row has more cells than the header.
    """
    text = _text(path)
    named = re.match(r"sep=(.)\r?\n", text)
    heads = {
        separator: [
            sum(map(known, map(key_of, row))) for _, row in islice(_cells(text, separator), _HEADER_LINES)
        ]
        for separator in (named[1] if named else _SEPARATORS)
    }
    separator = max(heads, key=lambda one: (max(heads[one], default=0), text.count(one)))
    try:
        lines = [(line, row) for line, row in _cells(text, separator, strict=True) if any(row)]
    except csv.Error as error:
        raise BenchError(str(path), str(error), "a table (CSV)", "Export the table again as CSV.") from None
    known_names = [sum(map(known, map(key_of, row))) for _, row in lines[:_HEADER_LINES]]
    first = known_names.index(max(known_names)) if known_names else 0
    if len(lines) <= first + 1:
        raise BenchError(
            str(path), "no rows", "a header and rows of measurements", "Export the table again with its rows."
        )
    header, names = lines[first]
    notes = [
        f"line {line}: {' '.join(filter(None, row))}"
        for line, row in lines[:first]
        if not (named and line == 1)
    ]
    units, rows = tuple("" for _ in names), []
    for line, row in lines[first + 1 :]:
        if len(row) > len(names) and any(row[len(names) :]):
            place, cure = f"{path}, line {line}", "Correct the row: is a decimal comma the separator?"
            raise BenchError(place, f"{len(row)} cells", f"{len(names)}, as in the header", cure)
        cells = (*row[: len(names)], *[""] * (len(names) - len(row)))
        if cells == names:
            continue
        if all(_UNIT.fullmatch(cell.lower()) for cell in cells if cell):
            units = tuple(map(key_of, cells))
        elif summary := _summary(cells):
            notes.append(f"line {line}: {summary}")
        else:
            rows.append((line, tuple("" if cell.lower() in _NO_VALUE else cell for cell in cells)))
    commas = [cell for _, row in rows for cell in row if re.fullmatch(r"[+-]?\d+,\d+\s*[LRlr]?", cell)]
    # 2,545 alone may be a number of thousands.
    decimal_comma = separator != "," and not all(re.match(r"\d{1,3},\d{3}$", cell) for cell in commas)
    keys = tuple(map(key_of, names))
    return MeasurementTable(path, header, names, keys, units, tuple(rows), decimal_comma, tuple(notes))


def key_of(name: str) -> str:
    """Return a column's name or a unit for comparison."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).replace("%", "percent").replace("°", "deg ").lower()
    return re.sub(r"[^a-z0-9]+", "_", words).strip("_")


def _text(path: Path) -> str:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BenchError(
            str(path), error.strerror or str(error), "a readable file", "Check path and rights of the file."
        ) from None
    for start, kind in _FILES.items():
        if data.startswith(start):
            raise BenchError(str(path), kind, "a table (CSV)", "Save the sheet as CSV.")
    wide = data.startswith((BOM_UTF16_LE, BOM_UTF16_BE))
    encoding = "utf-16" if wide else "utf-16-le" if data[1:2] == b"\0" else "utf-8-sig"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        raise BenchError(
            str(path), f"byte {error.start} is not {error.encoding}", "UTF-8 or UTF-16", "Save it as UTF-8."
        ) from None


def _summary(cells: Sequence[str]) -> str:
    """Return the word that makes a row one of averages or deviations; empty without one."""
    label = next(filter(None, cells))
    words = [cell for cell in cells if re.fullmatch(_SUMMARY, key_of(cell))]
    return label if _LABEL.fullmatch(key_of(label)) else next(iter(words), "")


def _cells(text: str, separator: str, *, strict: bool = False) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield line and stripped cells of each row."""
    reader = csv.reader(StringIO(text, newline=""), delimiter=separator, strict=strict)
    for row in reader:
        yield reader.line_num, tuple(cell.strip() for cell in row)
