"""Campaigns of the database as a list, at the terminal and for programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.table import Column, Table
from rich.text import Text

from bench.records.shot.shot import ShotStatus
from bench.store.records import CampaignEntry, Standing

Listed = Sequence[tuple[CampaignEntry, Standing, Counter[str]]]


def listing(found: Listed, console: Console) -> Table:
    """Return the campaigns as a table for `console`, wider than it where whole ids do not fit."""
    longest = max((len(entry.id) for entry, _, _ in found), default=0)
    bench = max((len(entry.bench) for entry, _, _ in found), default=0)
    identity = Column("campaign", width=longest, no_wrap=True), Column("bench", min_width=bench, no_wrap=True)
    others = (Column("start, UTC", min_width=10), Column("state", min_width=9), "shots", "valid", "excluded")
    table = Table(*identity, *others, box=SIMPLE_HEAD)
    for entry, standing, counts in found:
        reason = [Text(standing.reason, style="dim", no_wrap=False)] if standing.reason else []
        table.add_row(
            Group(Text(entry.id), *reason),
            Text(entry.bench),
            f"{entry.date:%Y-%m-%d %H:%M}",
            f"{standing.state}{' (sim)' if entry.simulated else ''}",
            str(sum(counts.values())),
            str(counts[ShotStatus.VALID]),
            str(counts[ShotStatus.EXCLUDED]),
        )
    whole = console.measure(table, options=console.options.update(max_width=1000)).minimum
    table.width = max(console.width, whole)
    return table


def listing_record(found: Listed) -> list[dict[str, Any]]:
    """Return the campaigns for a program to read."""
    return [
        {
            "id": entry.id,
            "bench": entry.bench,
            "name": entry.name,
            "date": entry.date.isoformat(),
            "simulated": entry.simulated,
            "seed": entry.seed,
            "plan": entry.digest,
            "state": str(standing.state),
            "reason": standing.reason,
            "shots": {str(status): counts[status] for status in ShotStatus},
        }
        for entry, standing, counts in found
    ]
