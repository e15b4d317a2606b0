"""What a replay found, for people and for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from math import isfinite
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from bench.replay import INPUTS, MEASURED, Difference, Replay
from bench.telemetry.recorder import ENUMERATIONS


def replay_table(differences: Sequence[Difference]) -> Table:
    """Return a table of all fields that were compared."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for column in ("", "field", "greatest difference", "ticks", "first tick", "time", "recorded", "replayed"):
        table.add_column(column, justify="left" if column in {"", "field"} else "right")
    for d in differences:
        mark = Text("differs", "bold red") if d.ticks else Text("equal", "green")
        where: tuple[str, ...] = ("", "", "", "", "")
        if d.ticks:
            values = (_shown(d.field, d.recorded), _shown(d.field, d.replayed))
            where = (str(d.ticks), str(d.tick), f"{d.time:.4f} s", *values)
        name = f"{d.field} {d.component}".strip()
        table.add_row(mark, name, f"{d.greatest:.3g}" if d.greatest else "0", *where)
    return table


def replay_summary(replay: Replay, metadata: Mapping[str, Any], tolerance: float) -> str:
    """Return what was replayed, and what must be known to judge differences."""
    ticks = replay.recorded["tick"]
    lines = [
        f"{len(ticks)} ticks, {ticks[0]} to {ticks[-1]}, through today's cycle; "
        f"equal means within {tolerance:g} + {tolerance:g} times the value, codes exactly"
    ]
    if replay.defaults:
        lines.append(f"older than these settings, taken by default: {', '.join(replay.defaults)}")
    if changed := changed_versions(metadata):
        told = ", ".join(f"{name} {old} (now {new})" for name, (old, new) in changed.items())
        lines.append(f"written with {told}")
    return "\n".join(lines)


def changed_versions(metadata: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return the packages that the record was written with in another version: name -> (then, now)."""
    recorded = metadata.get("versions")
    found = {}
    for name in ("golfbench", "numpy", "numba"):
        old = str(recorded.get(name, "unknown")) if isinstance(recorded, Mapping) else "unknown"
        if old != version(name):
            found[name] = (old, version(name))
    return found


def replay_json(
    replay: Replay, differences: Sequence[Difference], metadata: Mapping[str, Any], tolerance: float
) -> dict[str, Any]:
    """Return the same for a program; a value that is no number, or infinite, is null."""
    ticks = replay.recorded["tick"]
    return {
        "version": 1,
        "equal": not any(d.ticks for d in differences),
        "ticks": len(ticks),
        "first_tick": int(ticks[0]),
        "last_tick": int(ticks[-1]),
        "tolerance": tolerance,
        "fields": [
            {key: _finite(value) for key, value in d._asdict().items()} if d.ticks
            else {"field": d.field, "greatest": _finite(d.greatest), "ticks": 0}
            for d in differences
        ],
        "inputs": sorted(INPUTS),
        "not_compared": sorted(MEASURED),
        "default_settings": list(replay.defaults),
        "changed_versions": changed_versions(metadata),
    }  # fmt: skip


def _shown(field: str, value: float) -> str:
    names = ENUMERATIONS.get(field)
    return names.get(str(int(value)), str(int(value))) if names and isfinite(value) else f"{value:.12g}"


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not isfinite(value) else value
