"""Campaigns at the terminal: progress and list."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.markup import escape
from rich.progress import Progress
from rich.table import Column, Table
from rich.text import Text

from bench.campaign.course import is_settled
from bench.campaign.plan import CampaignPlan
from bench.campaign.runner import Watcher
from bench.campaign.sequence import all_trials
from bench.shot.shot import Shot, ShotStatus
from bench.store.campaigns import CampaignEntry, Standing

Listed = Sequence[tuple[CampaignEntry, Standing, Counter[str]]]


class ProgressWatcher(Watcher):
    """Moves a progress bar: one step for each planned shot that is done with."""

    def __init__(self, bar: Progress, plan: CampaignPlan) -> None:
        self._bar, self._plan = bar, plan
        self._task = bar.add_task("warming up", total=len(all_trials(plan)))
        self._invalid = 0

    def shot(self, shot: Shot) -> None:
        """Show a shot."""
        self._invalid += shot.status is not ShotStatus.VALID
        text = f"shot {shot.shot}, block {shot.block}" + (
            f", {self._invalid} invalid" if self._invalid else ""
        )
        self._bar.update(self._task, advance=int(is_settled(self._plan, shot)), description=text)

    def say(self, text: str) -> None:
        """Print above the bar."""
        self._bar.console.print(escape(text), highlight=False)


def listing(found: Listed, console: Console) -> Table:
    """Return the campaigns as a table for `console`, wider than it where whole ids do not fit."""
    longest = max((len(entry.id) for entry, _, _ in found), default=0)
    identity = Column("campaign", width=longest, no_wrap=True)
    others = (Column("begun, UTC", min_width=10), Column("state", min_width=9), "shots", "valid")
    table = Table(identity, *others, box=SIMPLE_HEAD)
    for entry, standing, counts in found:
        reason = [Text(standing.reason, style="dim", no_wrap=False)] if standing.reason else []
        table.add_row(
            Group(Text(entry.id), *reason),
            f"{entry.date:%Y-%m-%d %H:%M}",
            f"{standing.state}{' (sim)' if entry.simulated else ''}",
            str(sum(counts.values())),
            str(counts[ShotStatus.VALID]),
        )
    whole = console.measure(table, options=console.options.update(max_width=1000)).minimum
    table.width = max(console.width, whole)
    return table


def listing_record(found: Listed) -> list[dict[str, Any]]:
    """Return the campaigns for a program to read."""
    return [
        {
            "id": entry.id,
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
