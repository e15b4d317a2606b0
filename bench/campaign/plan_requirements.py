"""Needs of a plan on a running bench: disk, work by hand, and settings of the bench that do not suit it."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from bench.campaign.bench_setup import load_lists
from bench.campaign.plan import CampaignPlan
from bench.campaign.randomization import all_trials, is_mounted
from bench.campaign.split_plot import as_split_plot, fully_randomised
from bench.swing.profile import Profile

BYTES = 1_400_000
"""Size of a shot's record in real time, bytes."""
_SCATTER_VENTED = 1.8
"""Largest error of the club speed seen in simulation on a bench that vents after each swing, m/s."""


class Needs(NamedTuple):
    """Needs of a plan, without repeats; of the warm-ups the shortest count for the feeder only."""

    swings: int
    bytes: int
    club_changes: int
    feeder_fills: int
    hand_work: float
    """Expected time of both, s."""


def needs(plan: CampaignPlan) -> Needs:
    """Return the needs of `plan`."""
    trials, work = all_trials(plan), plan.hand_work
    changes = sum(not is_mounted(plan, one, two) for one, two in pairwise(trials))
    fills = len(load_lists(plan, {}))
    seconds = changes * work.club_change + fills * work.feeder_fill
    return Needs(len(trials), len(trials) * BYTES, changes, fills, seconds)


def free_space(folder: Path) -> int:
    """Return the room on the disk of `folder`, which may not exist yet, bytes."""
    there = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    return shutil.disk_usage(there).free


def needs_words(plan: CampaignPlan, free: int) -> list[str]:
    """Return the needs in words; `free` is the room on the disk, bytes."""
    found = needs(plan)
    room = f"Records: about {found.bytes / 1e9:.2f} GB of {free / 1e9:.1f} GB free."
    if found.bytes > free:
        room += " Not enough: free some space, or name another bench.data_dir."
    if not found.club_changes and not found.feeder_fills:
        return [room, "Work by hand: none is planned."]
    parts = [f"{found.club_changes} club changes", f"{found.feeder_fills} feeder fills"]
    words = [room, f"Work by hand: {', '.join(parts)}, about {found.hand_work / 60:.0f} min in all."]
    return words + _other_layout(plan)


def _other_layout(plan: CampaignPlan) -> list[str]:
    """Return the club changes of the same shots in the other layout; empty without one."""
    if plan.split:
        other = needs(fully_randomised(plan))
        return [f"Fully randomised it would be {_changes(other)}."]
    layout = as_split_plot(plan)
    if layout is None:
        return []
    d = layout.design
    return [
        f"As a split-plot (design.blocks = {d.blocks}, hits_per_mounting = {d.hits_per_mounting}) it would "
        f"be {_changes(needs(layout))}."
    ]


def _changes(found: Needs) -> str:
    return f"{found.club_changes} club changes, about {found.hand_work / 60:.0f} min of work by hand"


def needs_series(plan: CampaignPlan, profiles: Iterable[Profile]) -> bool:
    """Return whether the gate of `plan` is narrower than what venting between swings scatters.

    `profiles` are the plan's. With planned air at their addresses it scatters no more than a series.
    """
    return 0 < plan.gate.club_speed < _SCATTER_VENTED and not all(profile.air for profile in profiles)


def series_words(plan: CampaignPlan) -> str:
    """Return why a bench that vents after each swing does not suit `plan`."""
    return (
        "a bench that vents after each swing, whose next arming leaves other air: that moves the club speed "
        f"by up to {_SCATTER_VENTED:g} m/s in simulation, and the gate accepts ± {plan.gate.club_speed:g} m/s"
    )


START_SERIES = (
    "Start the bench with golfbench run --series, or set [lifecycle] series = true for it, "
    "or plan the air of its profiles: golfbench profile address."
)
"""Action of a bench that vents after each swing."""
