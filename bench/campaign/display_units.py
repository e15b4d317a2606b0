"""Units of a report, by the reader's choice: one system in all of it. Records and JSON keep SI."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import floor, isfinite, log10
from typing import overload

import numpy as np
from numpy.typing import NDArray

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


_DEGREES, _RPM = DisplayUnit("°", 2), DisplayUnit("rpm", 0)
_METRES, _YARDS = DisplayUnit("m", 1), DisplayUnit("yd", 1, YARD)
_SPEED, _MILES = DisplayUnit("m/s", 2), DisplayUnit("mph", 1, MPH)
_LENGTHS = ("carry_m", "total_m", "apex_m", "carry_side_m")
_SPEEDS = ("club_speed_mps", "ball_speed_mps")
_ANGLES = (
    "attack_angle_deg",
    "club_path_deg",
    "face_angle_deg",
    "dynamic_loft_deg",
    "launch_angle_deg",
    "direction_deg",
    "spin_axis_deg",
    "launch_angle",
)
_COMMON: Mapping[str, DisplayUnit] = {
    **dict.fromkeys(_ANGLES, _DEGREES),
    **dict.fromkeys(("landing_angle_deg", "landing_angle"), DisplayUnit("°", 1)),
    "spin_rpm": _RPM,
    "angle_rad": DisplayUnit("mrad", 2, 1e-3),
    "relative_humidity": DisplayUnit("%", 0, 0.01),
}
_SI: Mapping[str, DisplayUnit] = {
    **_COMMON,
    **dict.fromkeys(_LENGTHS, _METRES),
    **dict.fromkeys(_SPEEDS, _SPEED),
    **dict.fromkeys(("strike_x_mm", "strike_y_mm"), DisplayUnit("mm", 1)),
    "air_temperature_k": DisplayUnit("°C", 1, 1.0, 273.15),
    "air_pressure_pa": DisplayUnit("hPa", 0, 100.0),
    "temperature_difference_k": DisplayUnit("°C", 1),
    "mass_kg": DisplayUnit("g", 2, 1e-3),
    "diameter_m": DisplayUnit("mm", 2, 1e-3),
    "length_m": DisplayUnit("m", 4),
    "head_mass_kg": DisplayUnit("g", 1, 1e-3),
}
_US: Mapping[str, DisplayUnit] = {
    **_COMMON,
    **dict.fromkeys(_LENGTHS, _YARDS),
    **dict.fromkeys(_SPEEDS, _MILES),
    **dict.fromkeys(("strike_x_mm", "strike_y_mm"), DisplayUnit("in", 3, _INCH_MM)),
    "air_temperature_k": DisplayUnit("°F", 1, 5 / 9, 459.67 * 5 / 9),
    "air_pressure_pa": DisplayUnit("inHg", 2, 3386.389),
    "temperature_difference_k": DisplayUnit("°F", 1, 5 / 9),
    "mass_kg": DisplayUnit("oz", 3, _OUNCE),
    "diameter_m": DisplayUnit("in", 3, _INCH_MM / 1e3),
    "length_m": DisplayUnit("in", 2, _INCH_MM / 1e3),
    "head_mass_kg": DisplayUnit("oz", 2, _OUNCE),
}


def display_unit(quantity: str, units: UnitSystem = UnitSystem.SI) -> DisplayUnit:
    """Return the unit of a column of the shot table, or of a plan's quantity."""
    return (_US if units is UnitSystem.US else _SI)[quantity]
