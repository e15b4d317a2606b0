"""Measured flights in CSV: one row per flight, and the points of trajectories in a second file.

Columns have the names of the shot table or of exports by TrackMan and Foresight, with the unit in the name or
in a row below. Column `flight` has the number of the flight in tables of trajectory points. An empty cell is
a figure that was not measured; direction and spin axis default to 0, the air to `sim.ball.Air()`.

UTF-8 and UTF-16 are read, with the separators comma, semicolon and tab (also named by a first line `sep=;`),
and decimal commas, in quotes where the comma is the separator. Lines before the header, a row of units below
it, and repeated headers are accepted. Rows of averages and deviations are left out, and those in which the
device measured no speed, launch angle or spin. Column names are compared in lower case, words joined by
underscores: "Ball Speed (mph)" is "ball_speed_mph".
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from io import StringIO
from itertools import islice
from math import atan2, cos, hypot, isfinite, pi, radians
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.base.errors import BenchError
from bench.base.from_toml import encoding_of
from bench.calibration.ball_aerodynamics import MeasuredFlight
from drivers.base import Launch
from drivers.base.ranges import read_number
from sim.ball import Air

_SEPARATORS = ",;\t"
_HEADER_LINES = 20
"""Maximum number of lines in which the header is searched."""
_FILES = {b"PK\x03\x04": "a workbook (xlsx)", b"\xd0\xcf\x11\xe0": "a workbook (xls)", b"%PDF": "a PDF"}
_SUMMARY = r"(avg|average|mean|median|summary|sd|(std_|st_|standard_|std)?dev(iation)?)s?"
_LABEL = re.compile(rf"{_SUMMARY}(_.*)?|(min|max)(imum)?|longest|shortest|total|consistency")
"""First cell of a row that sums up others; elsewhere only a summary's own word counts."""
_PEOPLE = {"player", "player_name", "golfer", "name"}
"""Columns with names of people: Max is one, not a label."""
_NO_VALUE = {"", "-", "--", "–", "—", "n/a", "na", "nan", "null", "none"}
_UNIT = re.compile(r"[\[(].*[\])]|%|°|mph|kph|rpm|deg(rees)?|yds?|yards|fe?e?t|m|s|sec|(km/h|m/s|ft/s)")


class MeasurementTable(NamedTuple):
    """Columns and rows of a file."""

    path: Path
    header: int
    """Line of the header."""
    names: tuple[str, ...]
    """Column names as in the file."""
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
            value = sign * read_number(text.replace(",", ".") if self.decimal_comma else text)
        except ValueError:
            value = float("nan")
        if not isfinite(value):
            mark = "comma, as in other cells" if self.decimal_comma else "point"
            expected = f"a number with a decimal {mark}" + (", L or R behind it" if sided else "")
            raise BenchError(
                self.location(line, column), repr(cell), expected, "Correct the cell in the file."
            )
        return value

    def location(self, line: int, column: int) -> str:
        """Return the place of a cell."""
        return f"{self.path}, line {line}, {self.names[column]} (column {column + 1})"


def read_table(path: Path, known: Callable[[str], bool]) -> MeasurementTable:
    """Return the table in the file at `path`; `known` says whether a column key is one of the header's.

    Raises:
        BenchError: the file cannot be read, is no table, or a row has more cells than the header.
    """
    text = _text(path)
    named = re.match(r"sep=(.)\r?\n", text)
    try:
        heads = {
            separator: [
                sum(map(known, map(key_of, row))) for _, row in islice(_cells(text, separator), _HEADER_LINES)
            ]
            for separator in (named[1] if named else _SEPARATORS)
        }
        separator = max(heads, key=lambda one: (max(heads[one], default=0), text.count(one)))
        lines = [(line, row) for line, row in _cells(text, separator, strict=True) if any(row)]
    except csv.Error as error:
        action = "Correct the quotes of this row, or export the table again as CSV."
        raise BenchError(str(path), str(error), "a table (CSV)", action) from None
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
            location, action = f"{path}, line {line}", "Correct the row: is a decimal comma the separator?"
            raise BenchError(location, f"{len(row)} cells", f"{len(names)}, as in the header", action)
        cells = (*row[: len(names)], *[""] * (len(names) - len(row)))
        if cells == names:
            continue
        if all(_UNIT.fullmatch(cell.lower()) for cell in cells if cell):
            units = tuple(map(key_of, cells))
        elif summary := _summary(cells, names):
            notes.append(f"line {line}: {summary}")
        else:
            rows.append((line, tuple("" if cell.lower() in _NO_VALUE else cell for cell in cells)))
    figures = [cell for _, row in rows for name, cell in zip(names, row, strict=True) if known(key_of(name))]
    commas = [cell for cell in figures if re.fullmatch(r"[+-]?\d+,\d+\s*[LRlr]?", cell)]
    # 2,545 alone may be a number of thousands.
    decimal_comma = not all(re.match(r"\d{1,3},\d{3}$", cell) for cell in commas)
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
    try:
        return data.decode(encoding_of(data))
    except UnicodeDecodeError as error:
        raise BenchError(
            str(path), f"byte {error.start} is not {error.encoding}", "UTF-8 or UTF-16", "Save it as UTF-8."
        ) from None


def _summary(cells: Sequence[str], names: Sequence[str]) -> str:
    """Return the word that makes a row one of averages or deviations; empty without one."""
    label, column = next((cell, name) for cell, name in zip(cells, names, strict=True) if cell)
    words = [cell for cell in cells if re.fullmatch(_SUMMARY, key_of(cell))]
    is_label = _LABEL.fullmatch(key_of(label)) and key_of(column) not in _PEOPLE
    return label if is_label else next(iter(words), "")


def _cells(text: str, separator: str, *, strict: bool = False) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield line and stripped cells of each row."""
    reader = csv.reader(StringIO(text, newline=""), delimiter=separator, strict=strict)
    end = 0
    try:
        for row in reader:
            yield (end := reader.line_num), tuple(cell.strip() for cell in row)
    except csv.Error as error:
        raise csv.Error(f"row from line {end + 1}: {error}") from None


_UNITS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    dimension: {name: (factor, offset) for names, factor, offset in units for name in names.split()}
    for dimension, units in {
        "speed": [("mps m_s", 1.0, 0.0), ("mph", 0.44704, 0.0), ("kmh km_h kph", 1 / 3.6, 0.0)],
        "angle": [("deg degrees", pi / 180, 0.0)],
        "spin": [("rpm", pi / 30, 0.0)],
        "length": [("m meters metres", 1.0, 0.0), ("yd yds yards", 0.9144, 0.0), ("ft feet", 0.3048, 0.0)],
        "time": [("s sec seconds", 1.0, 0.0)],
        "temperature": [("k", 1.0, 0.0), ("c deg_c", 1.0, 273.15), ("f deg_f", 5 / 9, 273.15 - 160 / 9)],
        "pressure": [("pa", 1.0, 0.0), ("hpa h_pa mbar", 100.0, 0.0), ("kpa k_pa", 1000.0, 0.0)],
        "ratio": [("ratio", 1.0, 0.0), ("percent", 0.01, 0.0)],
    }.items()
}
"""Units by dimension: factor and offset to SI."""
_ASSUMED = {"angle": "deg", "spin": "rpm", "time": "s", "ratio": "ratio"}
"""Units of columns that name none."""


class _Figure(NamedTuple):
    """A figure of a flight."""

    dimension: str
    names: tuple[str, ...]
    """Column names without unit: that of the shot table first, then of exports."""
    sided: bool = False
    """Whether it has a sign: right is positive."""


# TrackMan: header of TPS and of Range exports. Foresight: FSX 2020 (LastShot.CSV) and FSX sessions.
_FIGURES: Mapping[str, _Figure] = {
    "speed": _Figure("speed", ("ball_speed",)),
    "launch_angle": _Figure("angle", ("launch_angle", "vla")),
    "direction": _Figure(
        "angle", ("direction", "launch_direction", "azimuth", "side_angle", "hla"), sided=True
    ),
    "spin": _Figure("spin", ("spin", "spin_rate", "total_spin")),
    "spin_axis": _Figure("angle", ("spin_axis", "spin_axis_tilt"), sided=True),
    "back_spin": _Figure("spin", ("back_spin", "backspin")),
    "side_spin": _Figure("spin", ("side_spin", "sidespin"), sided=True),
    "carry": _Figure("length", ("carry", "carry_distance", "carry_dist", "carry_flat_length")),
    "apex": _Figure(
        "length", ("apex", "apex_height", "peak_height", "max_height", "max_height_height", "height")
    ),
    "time": _Figure("time", ("time", "hang_time", "flight_time", "carry_flat_time")),
    "temperature": _Figure("temperature", ("air_temperature", "temperature")),
    "pressure": _Figure("pressure", ("air_pressure",)),
    "relative_humidity": _Figure("ratio", ("relative_humidity",)),
    "wind": _Figure("speed", ("wind",), sided=True),
    "cross_wind": _Figure("speed", ("cross_wind",), sided=True),
}
"""Wind along the target line and to the right."""
_NEEDED = ("speed", "launch_angle", "spin")
_NEVER_ZERO = {"speed", "spin"}
"""Figures for which devices write 0 where they measured none."""
_POSSIBLE = {
    "speed": (1.0, 149.0, 1.0, "m/s"),
    "launch_angle": (radians(-85.0), radians(85.0), pi / 180, "deg"),
    "direction": (-pi, pi, pi / 180, "deg"),
    "spin": (5.0, 1990.0, pi / 30, "rpm"),
    "spin_axis": (-pi, pi, pi / 180, "deg"),
    "carry": (0.0, 500.0, 1.0, "m"),
    "apex": (0.0, 200.0, 1.0, "m"),
    "time": (0.0, 30.0, 1.0, "s"),
}
"""Ranges, those of the launch with room for the steps of the fit; factor and unit of their report."""
_SIDES = {"side_spin", "spin_axis"}
"""Either of them gives the total spin from the back spin."""
_POINT_COLUMNS = ("flight", "time_s", "distance_m", "height_m")
_NOT_MEASURED = {"16777215.000000", "-21474836480"}
"""Numbers that stand for a missing measurement, of Foresight and of TrackMan."""
_ESTIMATES = ("estimated", "calculated")


class FlightTable(NamedTuple):
    """Flights of a file."""

    flights: list[MeasuredFlight]
    notes: tuple[str, ...]
    """Columns and rows that are not used."""


class _Column(NamedTuple):
    """A column with a figure."""

    figure: str
    unit: str
    """Empty where the name has none."""


def read_flights(path: Path, points: Path | None = None) -> FlightTable:
    """Return the flights in `path`, with the trajectories in `points` if given.

    Raises:
        BenchError: a file cannot be read; names file, line and column of a cell that is no number, of a unit
            that is missing or unknown and of a figure that is given twice and differs, or a flight whose
            figures are impossible.
    """
    trajectories = {} if points is None else _read_points(points)
    table = read_table(path, lambda key: _column(key) is not None)
    if "carry_source" in table.keys:
        found = "a campaign's shot table, whose apex and carry are computed"
        action = "Give the export of the full-flight monitor or indoor range."
        raise BenchError(str(path), found, "flights as a device measured them", action)
    columns = _columns(table)
    flights, notes = list[MeasuredFlight](), [*table.notes]
    for line, row in table.rows:
        location, cells = f"{path}, line {line}", dict(zip(table.keys, row, strict=True))
        if left_out := _left_out(cells):
            notes.append(f"line {line}: {left_out}")
            continue
        figures = _figures(table, columns, line, row)
        if not figures:
            notes.append(f"line {line}: {' '.join(filter(None, row))}")
            continue
        if "spin" not in figures and (spin := _total_spin(figures)) is not None:
            figures["spin"] = spin
        if missing := _not_measured(figures):
            notes.append(f"line {line}: no {missing}")
            continue
        try:
            flights.append(_flight(figures, trajectories.pop(cells.get("flight", ""), None)))
        except ValueError as error:
            raise BenchError(
                location, str(error), "a possible flight", "Correct the row in the file."
            ) from None
    if trajectories:
        left = ", ".join(list(trajectories)[:5])
        expected = f"a row of it in {path}, column flight"
        raise BenchError(str(points), f"points of flight {left}", expected, "Correct one of the two files.")
    used = {"", "flight", "spin_rate_type", "use_in_stat"}
    unused = [name for n, name in enumerate(table.names) if n not in columns and table.keys[n] not in used]
    if unused:
        notes.append(f"columns {', '.join(unused)}")
    return FlightTable(flights, tuple(notes))


def _left_out(cells: Mapping[str, str]) -> str:
    """Return why the device or its operator does not count a row as measured; empty if they do."""
    if (kind := cells.get("spin_rate_type", "").lower()) in _ESTIMATES:
        return f"spin {kind}, not measured"
    return "Use In Stat is false" if cells.get("use_in_stat", "").lower() in ("false", "0", "no") else ""


def _total_spin(figures: Mapping[str, float]) -> float | None:
    """Return the total spin (rad/s) from its parts; None if one is missing."""
    back, side, axis = (figures.get(name) for name in ("back_spin", "side_spin", "spin_axis"))
    if back is None or (side is None and axis is None):
        return None
    return back / cos(axis or 0.0) if side is None else hypot(back, side)


def _not_measured(figures: Mapping[str, float]) -> str:
    """Return the needed figure that a row does not have, empty if it has all."""
    return next((n for n in _NEEDED if n not in figures or (n in _NEVER_ZERO and not figures[n])), "")


def _wanted(figure: str) -> str:
    dimension, names, _ = _FIGURES[figure]
    first: dict[float, str] = {}
    for unit, (factor, _) in _UNITS[dimension].items():
        first.setdefault(factor, unit)
    units = list(first.values())
    others = f" (or _{', _'.join(units[1:])}: the unit of its numbers)" if units[1:] else ""
    return f"column {names[0]}_{units[0]}{others}"


def _column(key: str) -> _Column | None:
    """Return the figure and the unit that the column `key` names; None if it is another one."""
    for figure, (dimension, names, _) in _FIGURES.items():
        for name in names:
            unit = key[len(name) + 1 :]
            if key == name or (key.startswith(f"{name}_") and unit in _UNITS[dimension]):
                return _Column(figure, unit)
    return None


def _columns(table: MeasurementTable) -> dict[int, _Column]:
    """Return the columns with figures; BenchError if a name is there twice, or a needed figure in none."""
    found: dict[int, _Column] = {}
    for n, key in enumerate(table.keys):
        column = _column(key)
        if column is None or (key == "time" and not table.units[n]):  # a time of day
            continue
        if key in table.keys[:n]:
            location, action = table.location(table.header, n), "Delete one of the two columns."
            raise BenchError(location, "the name of another column", "each value once", action)
        if column.unit and table.units[n] and column.unit != table.units[n]:
            location, action = table.location(table.header, n), "Correct one of them."
            raise BenchError(location, f"{table.units[n]} in the row of units", "one unit", action)
        found[n] = column._replace(unit=column.unit or table.units[n])
    given = {column.figure for column in found.values()}
    for name in _NEEDED:
        if name not in given and not (name == "spin" and "back_spin" in given and given & _SIDES):
            location, names = f"{table.path}, line {table.header}", ", ".join(filter(None, table.names))
            raise BenchError(location, f"no {name} in columns {names}", _wanted(name), "Name its column so.")
    return found


def _figures(
    table: MeasurementTable, columns: Mapping[int, _Column], line: int, row: tuple[str, ...]
) -> dict[str, float]:
    """Return the figures of a row in SI; BenchError if two columns of a figure differ."""
    found: dict[str, tuple[float, float, int]] = {}
    for n, (figure, unit) in columns.items():
        cell, (dimension, _, sided) = row[n], _FIGURES[figure]
        if not cell or cell in _NOT_MEASURED:
            continue
        known = _UNITS[dimension].get(unit or _ASSUMED.get(dimension, "no unit"))
        if known is None:
            expected = f"one of {', '.join(_UNITS[dimension])} in the name, as {table.keys[n]}_{{}}"
            expected = expected.format(next(iter(_UNITS[dimension])))
            action = "Write the unit behind the column's name."
            raise BenchError(table.location(line, n), f"unit {unit}" if unit else "no unit", expected, action)
        factor, offset = known
        value = factor * table.number(line, n, cell, sided=sided) + offset
        rounding = 0.5 * factor * 10.0 ** -len(cell.replace(",", ".").partition(".")[2].rstrip("LRlr "))
        first, first_rounding, other = found.setdefault(figure, (value, rounding, n))
        if abs(first - value) > 1.01 * (first_rounding + rounding):
            location, expected = table.location(line, n), f"the same {figure} in both"
            action = "Delete one of the columns."
            raise BenchError(location, f"{cell}, and {row[other]} in {table.names[other]}", expected, action)
    return {figure: value for figure, (value, _, _) in found.items()}


def _flight(figures: dict[str, float], points: np.ndarray[Any, Any] | None) -> MeasuredFlight:
    """Return the flight; ValueError where a figure is impossible."""
    for name, (low, high, factor, unit) in _POSSIBLE.items():
        if not low <= figures.get(name, low) <= high:
            found = f"{name} {figures[name] / factor:.10g} {unit}"
            raise ValueError(f"{found}, outside {low / factor:.0f} to {high / factor:.0f} {unit}")
    usual = Air()
    axis = figures.get("spin_axis")
    if axis is None:
        side, back = figures.get("side_spin", 0.0), figures.get("back_spin", 0.0)
        axis = atan2(side, back) if side and back else 0.0
    return MeasuredFlight(
        Launch(
            figures["speed"], figures["launch_angle"], figures.get("direction", 0.0), figures["spin"], axis
        ),
        carry=figures.get("carry"),
        apex=figures.get("apex"),
        time=figures.get("time"),
        points=points,
        air=Air(
            figures.get("temperature", usual.temperature),
            figures.get("pressure", usual.pressure),
            figures.get("relative_humidity", usual.relative_humidity),
        ),
        wind=(figures.get("wind", 0.0), 0.0, figures.get("cross_wind", 0.0)),
    )


def _read_points(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Return the points of each flight, shape (n, 3): time, distance along the launch direction, height."""
    found: dict[str, list[list[float]]] = {}
    table = read_table(path, lambda key: key in _POINT_COLUMNS)
    for name in _POINT_COLUMNS:
        if (count := table.keys.count(name)) != 1:
            expected, action = ", ".join(_POINT_COLUMNS), "Correct the header line of the file."
            raise BenchError(f"{path}, line {table.header}", f"{count} columns {name}", expected, action)
    flight, *places = (table.keys.index(name) for name in _POINT_COLUMNS)
    for line, row in table.rows:
        numbers = [table.number(line, location, row[location]) for location in places]
        found.setdefault(row[flight], []).append(numbers)
    return {flight: np.array(points) for flight, points in found.items()}
