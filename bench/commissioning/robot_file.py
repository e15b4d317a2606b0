"""robot.toml: the commissioned robot as a configuration over the one it began with."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from datetime import date

from bench.commissioning.known_robot import FoundValue, KnownRobot, value_at
from bench.control.settings import EnvelopeSettings

GUESSES = (
    "lengths",
    "masses and inertias whose standard error is 7 %",
    "damping of the spools",
    "Stribeck speeds",
    "polytropic exponent of the chambers",
    "feed, manifold, dump and vent conductances of the supply",
    "end stops",
    "ball and ground",
)
"""Parts of the plant that no step measures yet: they stay as configured."""


_CLUB, _SUPPLY = "robot.club", "supply.pressure"


def robot_file(
    known: KnownRobot,
    base: str,
    made: date,
    envelope: EnvelopeSettings | None = None,
    following: Mapping[str, tuple[float, float, float]] | None = None,
) -> str:
    """Return TOML of the robot in `known` over the configuration file `base`, commissioned on `made`.

    The limits of the supply's pressure, of `envelope`, follow the supply that was found; `following` are
    those of following errors, by phase.
    """
    lines = [
        f"# Commissioned on {made.isoformat()}: values with standard errors, and the steps that found them.",
        "# Stayed a guess, as configured: " + "; ".join(GUESSES) + ".",
        f"base = {json.dumps(base)}",
    ]
    tables: dict[str, list[str]] = {}
    for key, found in _keys(known.found.values()).items():
        table, _, name = key.rpartition(".")
        value = value_at(known.plant, key)
        text = "[" + ", ".join(map(repr, value)) + "]" if isinstance(value, tuple) else repr(value)
        errors = ", ".join(f"{one.error:.3g}" for one in found)
        unit = f" {found[0].unit}" if found[0].unit else ""
        note = f"± {errors}{unit}; {found[0].step}"
        tables.setdefault(table, []).append(f"{name} = {text}  # {note}")
    for table in sorted(tables):
        place = f"clubs.{known.plant.robot.club.name}" if table == _CLUB else f"plant.{table}".rstrip(".")
        lines += ["", f"[{place}]", *tables[table]]
    if envelope is not None and _SUPPLY in known.found:
        share = known.plant.supply.pressure / known.nominal.supply.pressure
        low, high = share * envelope.min_supply_pressure, share * envelope.max_supply_pressure
        lines += ["", "[envelope]"]
        lines += [f"min_supply_pressure = {low:.0f}.0", f"max_supply_pressure = {high:.0f}.0"]
    if following:
        lines += ["", "[envelope.following]"]
        lines += [f"{phase} = {list(limits)}" for phase, limits in following.items()]
    return "\n".join(lines) + "\n"


def _keys(found: Iterable[FoundValue]) -> dict[str, list[FoundValue]]:
    """Return the values by their keys, elements of a list under the list's."""
    keys: dict[str, list[FoundValue]] = {}
    for value in found:
        name, _, last = value.key.rpartition(".")
        keys.setdefault(name if last.isdigit() else value.key, []).append(value)
    return keys
