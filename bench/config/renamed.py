"""Keys of a configuration that have a new name; the old one is still read."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from bench.from_toml import SUFFIXES

RENAMED: Mapping[str, str] = {
    "envelope.greatest_speed": "max_speed",
    "envelope.greatest_opening": "max_opening",
    "envelope.greatest_slew": "max_slew",
    "envelope.greatest_gap": "max_gap",
    "envelope.greatest_supply": "max_supply_pressure",
    "envelope.least_supply": "min_supply_pressure",
    "envelope.least_lever": "min_lever",
    "launch_monitor.plausible.least_speed": "min_speed",
    "launch_monitor.plausible.greatest_speed": "max_speed",
    "launch_monitor.plausible.greatest_launch_angle": "max_launch_angle",
    "launch_monitor.plausible.greatest_direction": "max_direction",
    "launch_monitor.plausible.greatest_spin": "max_spin",
    "launch_monitor.plausible.least_smash": "min_smash",
    "launch_monitor.plausible.greatest_smash": "max_smash",
}
"""Dotted old key -> new key in the same table."""

_SUFFIX = re.compile(rf"_({'|'.join(SUFFIXES)})$")

Names = tuple[str, str]
"""Dotted old and new key."""


def rename_keys(tables: Mapping[str, Any]) -> tuple[dict[str, Any], list[Names], list[Names]]:
    """Return `tables` of a file with today's keys, the names that were replaced, and those given twice.

    The new key wins where both are given.
    """
    renamed: list[Names] = []
    twice: list[Names] = []

    def today(table: Mapping[str, Any], path: str) -> dict[str, Any]:
        found = {}
        bare = {_SUFFIX.sub("", key) for key in table}
        for key, value in table.items():
            name = _SUFFIX.sub("", key)
            new = RENAMED.get(path + name)
            if new is None:
                found[key] = today(value, f"{path}{key}.") if isinstance(value, dict) else value
            elif new in bare:
                twice.append((path + key, path + new))
            else:
                found[new + key.removeprefix(name)] = value
                renamed.append((path + key, path + new))
        return found

    return today(tables, ""), renamed, twice


def with_new_names(effective: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored effective configuration, maybe of an older version, with today's keys."""
    return rename_keys(effective)[0]
