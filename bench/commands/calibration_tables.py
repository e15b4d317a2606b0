"""Calibrations for people."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from rich.table import Table
from rich.text import Text

from bench.calibration.calibration import Calibration, Entry
from bench.calibration.values import CalibrationKind, in_words
from bench.commands.output import plain_table


def listing(entries: Sequence[Entry], in_force: Calibration, now: datetime) -> Table:
    """Return all `entries`, the newest of each kind last, each with who, how and why."""
    table = Table.grid(padding=(0, 2, 1, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for entry in sorted(entries, key=lambda entry: (list(CalibrationKind).index(entry.kind), entry.version)):
        title = Text.assemble(
            (" ".join(filter(None, (entry.kind, entry.subject))), "bold"), f"\nversion {entry.version}\n"
        )
        title.append_text(_mark(entry, in_force, now))
        lines = (
            f"{entry.date:%Y-%m-%d %H:%M} to {entry.expires:%Y-%m-%d %H:%M} UTC, by {entry.by}",
            in_words(entry.values),
            "; ".join(filter(None, (entry.method, entry.note))),
        )
        table.add_row(title, Text("\n".join(lines)))
    return table


def overview(in_force: Calibration, now: datetime) -> Table:
    """Return a table of what is in force, kind by kind."""
    table = plain_table("kind", "version", "date (UTC)", "expires", "values", "")
    for kind in CalibrationKind:
        entry = in_force.of(kind)
        if entry is None:
            mark = Text("missing", "bold red") if in_force.required else Text("nominal", "dim")
            table.add_row(kind, "", "", "", "as the configuration has it", mark)
            continue
        table.add_row(
            *(" ".join(filter(None, (kind, entry.subject))), str(entry.version)),
            *(f"{entry.date:%Y-%m-%d %H:%M}", f"{entry.expires:%Y-%m-%d}"),
            *(in_words(entry.values), _mark(entry, in_force, now)),
        )
    return table


def _mark(entry: Entry, in_force: Calibration, now: datetime) -> Text:
    if in_force.of(entry.kind) != entry:
        return Text("other club" if entry.subject not in {"", in_force.club} else "superseded", "dim")
    return Text("expired", "bold red") if entry.expired(now) else Text("in force", "green")
