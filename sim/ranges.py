"""Physical ranges of values that come from configuration, checked when the value is made."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import NamedTuple


class Range(NamedTuple):
    """Closed interval that a quantity can physically lie in, with its unit for the message."""

    low: float
    high: float
    unit: str


def check_ranges(value: object, ranges: Mapping[str, Range]) -> None:
    """Raise ValueError naming class, field, found and expected when a field of `value` leaves its range."""
    for name, (low, high, unit) in ranges.items():
        found = getattr(value, name)
        if not (isfinite(found) and low <= found <= high):
            expected = f"expected {low:g} to {high:g} {unit}".rstrip()
            raise ValueError(f"{type(value).__name__}.{name}: found {found!r}, {expected}")
