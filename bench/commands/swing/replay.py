"""Output of a replay, as a table and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from math import inf, isfinite
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.base.errors import BenchError
from bench.commands.common.output import finite, plain_table
from bench.commands.common.progress import progress_of
from bench.commands.common.session import show_json
from bench.records.telemetry.cycle_record import ENUMERATIONS
from bench.records.telemetry.recorder import read_swing
from bench.simulation.replay import INPUTS, MEASURED, TOLERANCE, Difference, Replay, replay_cycles


def replay_command(path: Path, tolerance: float, json_: bool) -> bool:
    """Replay the record at `path`, print the result, and return whether it is equal.

    Raises:
        BenchError, ExceptionGroup: as `bench.simulation.replay.replay_cycles`.
    """
    if not 0.0 <= tolerance < inf:
        action = f"Leave it out for {TOLERANCE:g}."
        raise BenchError("replay: --tolerance", f"{tolerance}", "a finite number of at least 0", action)
    cycles, metadata = read_swing(path)
    with progress_of(f"replaying {path.name}", len(cycles)) as show:
        replay = replay_cycles(cycles, metadata, str(path), lambda done, total: show(done))
    differences = replay.differences(tolerance)
    equal = not any(difference.ticks for difference in differences)
    if json_:
        show_json(replay_json(replay, differences, metadata, tolerance))
        return equal
    console = Console()
    same = [d.field for d in differences if d.greatest == 0.0]
    if len(same) < len(differences):
        console.print(replay_table(differences))
    console.print(f"the same bit for bit: {', '.join(same) or 'no field'}", highlight=False)
    console.print(replay_summary(replay, metadata, tolerance), highlight=False)
    first = min((d for d in differences if d.ticks), key=lambda d: d.tick or 0, default=None)
    if first is None:
        console.print("Equal: today's controller does what was recorded.", style="green", highlight=False)
    else:
        told = f"Different: first in tick {first.tick}, {first.field}."
        console.print(told, style="red", highlight=False)
    return equal


def replay_table(differences: Sequence[Difference]) -> Table:
    """Return a table of the fields that are not the same bit for bit; those within the tolerance are dim."""
    figures = ("greatest", "ticks", "from tick", "recorded", "replayed")
    table = plain_table("field", *figures, right=figures)
    for d in differences:
        if d.greatest == 0.0:
            continue
        name, greatest = f"{d.field} {d.component}".strip(), f"{d.greatest:.2g}"
        if not d.ticks:
            table.add_row(name, greatest, "0", "", "", "", style="dim")
            continue
        values = _shown(d.field, d.recorded), _shown(d.field, d.replayed)
        table.add_row(Text(name, "red"), greatest, str(d.ticks), f"{d.tick}", *values)
    return table


def replay_summary(replay: Replay, metadata: Mapping[str, Any], tolerance: float) -> str:
    """Return the extent of the replay, and the settings and versions that may explain differences."""
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
            {key: finite(value) for key, value in d._asdict().items()}
            if d.ticks
            else {"field": d.field, "greatest": finite(d.greatest), "ticks": 0}
            for d in differences
        ],
        "inputs": sorted(INPUTS),
        "not_compared": sorted(MEASURED),
        "default_settings": list(replay.defaults),
        "changed_versions": changed_versions(metadata),
    }


def _shown(field: str, value: float) -> str:
    names = ENUMERATIONS.get(field)
    return names.get(str(int(value)), str(int(value))) if names and isfinite(value) else f"{value:.6g}"
