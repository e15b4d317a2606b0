"""Physical ranges of values that come from outside; each stands in the annotation of its field."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import cache
from math import isfinite
from typing import Annotated, Any, cast, get_origin, get_type_hints


@dataclass(frozen=True)
class Range:
    """Closed interval that a quantity can physically lie in, with its unit for the message."""

    low: float
    high: float
    unit: str

    def __str__(self) -> str:
        return f"{short(self.low)} to {short(self.high)} {self.unit}".rstrip()


@dataclass(frozen=True)
class AtLeast:
    """Smallest valid value."""

    bound: float


@dataclass(frozen=True)
class Above:
    """Value that all valid ones exceed."""

    bound: float


@dataclass(frozen=True)
class AtMost:
    """Largest valid value."""

    bound: float


@dataclass(frozen=True)
class Gap:
    """Open interval within a range that holds no real value: one in it was given in another unit."""

    low: float
    high: float


@dataclass(frozen=True)
class Count:
    """Number of entries of a list."""

    entries: int


def short(value: float) -> str:
    """Return `value` with at most six digits and no padded exponent: 1.2e6, not 1.2e+06."""
    return f"{value:g}".replace("e+0", "e").replace("e-0", "e-").replace("e+", "e")


def read_number(text: str) -> float:
    """Return the number in `text`; ValueError also for 1_5, which `float` reads as 15."""
    if "_" in text:
        raise ValueError(f"{text!r}: no number")
    return float(text)


@cache
def ranges_of(kind: type) -> dict[str, Range]:
    """Return the range of every field of dataclass `kind` that is annotated with one."""
    return {
        name: mark
        for name, hint in get_type_hints(kind, include_extras=True).items()
        if get_origin(hint) is Annotated
        for mark in hint.__metadata__
        if isinstance(mark, Range)
    }


def check_ranges(value: object) -> None:
    """Raise ValueError naming class, field, found and expected when a field of `value` leaves its range."""
    kind: type[Any] = type(value)
    for name, span in ranges_of(cast(Hashable, kind)).items():
        found = getattr(value, name)
        if not (isfinite(found) and span.low <= found <= span.high):
            raise ValueError(f"{kind.__name__}.{name}: found {found!r}, expected {span}")


def check_wiring(channels: Any, table: str, output_range: float) -> None:
    """Raise ValueError if a stroke exceeds its output's range (V), or a broken cable reads as a pressure.

    `channels` are settings of analogue channels in `table` of the configuration.
    """
    for centre in channels.centre:
        if not channels.span <= centre <= output_range - channels.span:
            stroke = f"{centre:g} V -+ {channels.span:g} V"
            raise ValueError(f"{table}centre: the full stroke, {stroke}, within 0 to {output_range:g} V")
    if channels.pressure_at_full_scale <= channels.pressure_at_zero:
        raise ValueError(f"{table}pressure_at_full_scale: more than pressure_at_zero")
    if channels.pressure_at_zero >= channels.lowest_pressure:
        raise ValueError(f"{table}lowest_pressure: more than pressure_at_zero, which a cut cable reads")
    if channels.pressure_at_full_scale <= channels.highest_pressure:
        raise ValueError(
            f"{table}highest_pressure: less than pressure_at_full_scale, which a short circuit reads"
        )
