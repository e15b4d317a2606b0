"""Format of a report: units by the reader's choice, template, table of shots, configurations as text."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import floor, isfinite, log10
from typing import Any, overload

import jinja2
import numpy as np
from numpy.typing import NDArray

from bench.records.shot.shot import Shot

MPH = 0.44704
YARD = 0.9144
_INCH_MM = 25.4
_OUNCE = 28.349523125e-3


class UnitSystem(StrEnum):
    """System of units of a report."""

    SI = "si"
    US = "us"


@dataclass(frozen=True)
class DisplayUnit:
    """Unit of one quantity on a page."""

    unit: str
    digits: int
    """Decimals of one shot's figure."""
    size: float = 1.0
    """Size of the unit in that of the record."""
    offset: float = 0.0
    """Zero of the unit in that of the record."""

    @overload
    def of(self, value: float) -> float: ...
    @overload
    def of(self, value: NDArray[np.float64]) -> NDArray[np.float64]: ...
    def of(self, value: float | NDArray[np.float64]) -> float | NDArray[np.float64]:
        """Return a `value` of the record, or an array of them, in this unit."""
        return (value - self.offset) / self.size

    def text(self, value: float | None, more: int = 0) -> str:
        """Return a `value` of the record as text with `more` decimals than one shot has; "–" if unknown."""
        return "–" if value is None else number_text(self.of(value), max(self.digits + more, 0))


def number_text(value: float, digits: int, *, signed: bool = False) -> str:
    """Return `value` with so many decimals and a real minus sign; "–" for NaN, "∞" for infinity."""
    if value != value:  # noqa: PLR0124 - NaN
        return "–"
    if abs(value) == float("inf"):
        return "∞" if value > 0 else "−∞"
    text = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    if float(text) == 0 and not signed:
        text = text.removeprefix("-")
    return text.replace("-", "−")


def two_digits(value: float) -> str:
    """Return a width, deviation or uncertainty with two significant digits; "–" for NaN."""
    if not isfinite(value) or not value:
        return number_text(value, 0)
    return number_text(value, max(1 - floor(log10(abs(value))), 0))


_ANGLES = (
    *("attack_angle_deg", "club_path_deg", "face_angle_deg", "dynamic_loft_deg"),
    *("launch_angle_deg", "launch_angle", "direction_deg", "spin_axis_deg"),
)
_ALIKE: Mapping[str, DisplayUnit] = {
    **dict.fromkeys(_ANGLES, DisplayUnit("°", 2)),
    **dict.fromkeys(("landing_angle_deg", "landing_angle"), DisplayUnit("°", 1)),
    "spin_rpm": DisplayUnit("rpm", 0),
    "angle_rad": DisplayUnit("mrad", 2, 1e-3),
    "relative_humidity": DisplayUnit("%", 0, 0.01),
}
_LENGTHS = DisplayUnit("m", 1), DisplayUnit("yd", 1, YARD)
_SPEEDS = DisplayUnit("m/s", 2), DisplayUnit("mph", 1, MPH)
_STRIKES = DisplayUnit("mm", 1), DisplayUnit("in", 3, _INCH_MM)
_UNITS: Mapping[str, tuple[DisplayUnit, DisplayUnit]] = {
    **{name: (unit, unit) for name, unit in _ALIKE.items()},
    **dict.fromkeys(("carry_m", "total_m", "apex_m", "carry_side_m"), _LENGTHS),
    **dict.fromkeys(("club_speed_mps", "ball_speed_mps"), _SPEEDS),
    **dict.fromkeys(("strike_x_mm", "strike_y_mm"), _STRIKES),
    "air_temperature_k": (DisplayUnit("°C", 1, 1.0, 273.15), DisplayUnit("°F", 1, 5 / 9, 459.67 * 5 / 9)),
    "air_pressure_pa": (DisplayUnit("hPa", 0, 100.0), DisplayUnit("inHg", 2, 3386.389)),
    "temperature_difference_k": (DisplayUnit("°C", 1), DisplayUnit("°F", 1, 5 / 9)),
    "mass_kg": (DisplayUnit("g", 2, 1e-3), DisplayUnit("oz", 3, _OUNCE)),
    "diameter_m": (DisplayUnit("mm", 2, 1e-3), DisplayUnit("in", 3, _INCH_MM / 1e3)),
    "length_m": (DisplayUnit("m", 4), DisplayUnit("in", 2, _INCH_MM / 1e3)),
    "head_mass_kg": (DisplayUnit("g", 1, 1e-3), DisplayUnit("oz", 2, _OUNCE)),
}
"""Unit of each quantity in SI and in the US system."""


def display_unit(quantity: str, units: UnitSystem = UnitSystem.SI) -> DisplayUnit:
    """Return the unit of a column of the shot table, or of a plan's quantity."""
    return _UNITS[quantity][units is UnitSystem.US]


CLUB = {
    "club_speed_mps": "club",
    "attack_angle_deg": "attack",
    "club_path_deg": "path",
    "face_angle_deg": "face",
    "dynamic_loft_deg": "loft",
    "strike_x_mm": "strike x",
    "strike_y_mm": "strike y",
}
"""Short names of the columns of the delivery, the upper line in the table of shots."""
BALL = {
    "ball_speed_mps": "ball",
    "launch_angle_deg": "launch",
    "direction_deg": "direction",
    "spin_rpm": "spin",
    "spin_axis_deg": "spin axis",
    "carry_m": "carry",
    "carry_side_m": "offline",
    "total_m": "total",
    "apex_m": "apex",
    "landing_angle_deg": "landing",
}
"""Short names of the columns of launch and flight, the lower line."""


def page_template(filters: Mapping[str, Callable[..., Any]]) -> jinja2.Template:
    """Return the template of a report with its `filters`; undefined variables are errors."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("bench.campaign", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters)
    return environment.get_template("campaign.html.j2")


def shot_figures(shot: Shot, columns: Iterable[str], units: UnitSystem) -> list[str]:
    """Return the `columns` of a shot as text."""
    return [display_unit(column, units).text(getattr(shot, column)) for column in columns]


def flat(configuration: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the configuration as titled groups of (key, value as text)."""
    groups: dict[str, list[tuple[str, str]]] = {}

    def visit(prefix: str, value: object) -> None:
        if isinstance(value, Mapping) and value:
            for key, inner in value.items():
                visit(f"{prefix}.{key}" if prefix else str(key), inner)
        else:
            group, _, key = prefix.rpartition(".")
            text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)
            groups.setdefault(group, []).append((key, text))

    visit("", configuration)
    return list(groups.items())
