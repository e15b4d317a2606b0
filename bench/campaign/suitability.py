"""Needs of a plan on a running bench: disk, work by hand, and settings of the bench that do not suit it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from bench.campaign.plan import CampaignPlan
from bench.campaign.sequence import all_trials
from bench.config import Configuration

BYTES = 1_400_000
"""Size of a shot's record in real time, bytes."""
_SCATTER_VENTED = 1.8
"""Largest error of the club speed seen in simulation on a bench that vents after each swing, m/s."""


class Needs(NamedTuple):
    """Needs of a plan, without warm-up and repeats."""

    bytes: int
    club_changes: int
    feeder_fills: int
    hand_work: float
    """Expected time of both, s."""


def needs(plan: CampaignPlan) -> Needs:
    """Return the needs of `plan`."""
    trials, magazine, work = all_trials(plan), plan.ball_handling.magazine, plan.hand_work
    changes = sum(one.arm.club != two.arm.club for one, two in pairwise(trials))
    fills = -(-len(trials) // magazine) if magazine else 0
    seconds = changes * work.club_change + fills * work.feeder_fill
    return Needs(len(trials) * BYTES, changes, fills, seconds)


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
    return [room, f"Work by hand: {', '.join(parts)}, about {found.hand_work / 60:.0f} min in all."]


def unsuitable(plan: CampaignPlan, configuration: Configuration) -> Iterator[str]:
    """Yield what in the bench's configuration does not suit `plan`, and what to set."""
    gate = plan.gate.club_speed
    if not configuration.lifecycle.series and 0 < gate < _SCATTER_VENTED:
        yield (
            "On a running bench: lifecycle.series = false vents the robot after each swing, and the air of "
            f"the next arming moved the club speed by up to {_SCATTER_VENTED:g} m/s in simulation; the gate "
            f"accepts ± {gate:g} m/s. Set [lifecycle] series = true and restart the bench with it."
        )
