"""Measured flights in CSV: one row a flight, and the points of trajectories in a second file.

Columns are named as in the shot table. `flight` numbers the flights where points are given. An empty cell is
a figure that was not measured; direction and spin axis default to 0, the air to that of `sim.air.Air`.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from math import isfinite, pi, radians
from pathlib import Path
from typing import Any

import numpy as np

from bench.calibration.aerodynamics_fit import MeasuredFlight
from bench.errors import BenchError
from drivers.base import Launch
from sim.air import Air

MPH, YARD = 0.44704, 0.9144

_COLUMNS: Mapping[str, tuple[str, Callable[[float], float]]] = {
    "ball_speed_mps": ("speed", float),
    "ball_speed_mph": ("speed", lambda value: MPH * value),
    "launch_angle_deg": ("launch_angle", radians),
    "direction_deg": ("direction", radians),
    "spin_rpm": ("spin", lambda value: value * pi / 30),
    "spin_axis_deg": ("spin_axis", radians),
    "carry_m": ("carry", float),
    "carry_yd": ("carry", lambda value: YARD * value),
    "apex_m": ("apex", float),
    "apex_yd": ("apex", lambda value: YARD * value),
    "time_s": ("time", float),
    "air_temperature_k": ("temperature", float),
    "air_pressure_pa": ("pressure", float),
    "relative_humidity": ("relative_humidity", float),
    "wind_mps": ("wind", float),
    "cross_wind_mps": ("cross_wind", float),
}
"""Column -> figure and its conversion to SI; wind along the target line and to the right."""
_NEEDED = ("speed", "launch_angle", "spin")
_POINT_COLUMNS = ("flight", "time_s", "distance_m", "height_m")
_CURE = "Correct the cell."


def read_flights(path: Path, points: Path | None = None) -> list[MeasuredFlight]:
    """Return the flights in `path`, with the trajectories in `points` if given.

    Raises:
        BenchError: a file cannot be read; names file, line and column of a cell that is no number, a column
            that is missing, or a flight whose figures are impossible.
    """
    trajectories = {} if points is None else _read_points(points)
    flights = []
    for line, row in _rows(path):
        number = row.pop("flight", None)
        place = f"{path}, line {line}"
        if "carry_source" in row:
            raise BenchError(
                str(path),
                "a campaign's shot table, whose apex and carry are computed",
                "flights as a device measured them",
                "Give the export of the full-flight monitor or indoor range.",
            )
        figures = _figures(row, place)
        missing = [name for name in _NEEDED if name not in figures]
        if missing:
            wanted = [column for column, (name, _) in _COLUMNS.items() if name == missing[0]]
            raise BenchError(place, f"no {missing[0]}", f"a figure in {' or '.join(wanted)}", "Add it.")
        try:
            flights.append(_flight(figures, trajectories.pop((number or "").strip(), None)))
        except ValueError as error:
            raise BenchError(place, str(error), "a possible flight", _CURE) from None
    if trajectories:
        left = ", ".join(list(trajectories)[:5])
        raise BenchError(
            str(points), f"points of flight {left}", f"a row of it in {path}, column flight", "Correct one."
        )
    return flights


def _flight(figures: Mapping[str, float], points: np.ndarray[Any, Any] | None) -> MeasuredFlight:
    usual = Air()
    return MeasuredFlight(
        Launch(
            figures["speed"],
            figures["launch_angle"],
            figures.get("direction", 0.0),
            figures["spin"],
            figures.get("spin_axis", 0.0),
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


def _rows(path: Path) -> list[tuple[int, dict[str, str]]]:
    """Return (line, cells by column) of each row."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            table = csv.DictReader(stream, strict=True, restval="")
            return [(table.line_num, dict(row)) for row in table]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BenchError(str(path), str(error), "a table of flights (CSV, UTF-8)", "Check it.") from error


def _figures(row: Mapping[str, str], place: str) -> dict[str, float]:
    """Return the figures of a row in SI; columns of other names are ignored."""
    return {
        name: convert(_number(row[column], f"{place}, {column}"))
        for column, (name, convert) in _COLUMNS.items()
        if (row.get(column) or "").strip()
    }


def _read_points(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Return the points of each flight, shape (n, 3): time, distance along the launch direction, height."""
    found: dict[str, list[list[float]]] = {}
    for line, row in _rows(path):
        missing = [name for name in _POINT_COLUMNS if name not in row]
        if missing:
            raise BenchError(str(path), f"no column {missing[0]}", ", ".join(_POINT_COLUMNS), "Add it.")
        numbers = [_number(row[name], f"{path}, line {line}, {name}") for name in _POINT_COLUMNS[1:]]
        found.setdefault(row["flight"].strip(), []).append(numbers)
    return {flight: np.array(points) for flight, points in found.items()}


def _number(cell: str, place: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise BenchError(place, repr(cell), "a number with a decimal point", _CURE)
    return value
