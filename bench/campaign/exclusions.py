"""Shots that a person excludes, with name and reason: never deleted, each exclusion kept and reported.

The shot's record stays as it was taken, so that a campaign that goes on goes on as planned: the shot is not
repeated. Reports, figures and tables see it as excluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime

from bench.errors import Refused
from bench.shot.shot import Shot, ShotStatus
from bench.store.campaigns import CampaignStore
from bench.store.records import ShotExclusion

LONGEST_REASON = 500
"""Max number of characters of a reason."""


def with_exclusions(shots: Sequence[Shot], exclusions: Sequence[ShotExclusion]) -> list[Shot]:
    """Return `shots`, those that are excluded by hand with that status and reason."""
    reasons = reasons_by_hand(exclusions)
    return [
        replace(shot, status=ShotStatus.EXCLUDED, reason=f"excluded by hand: {reasons[shot.shot]}")
        if shot.shot in reasons and shot.status is ShotStatus.VALID
        else shot
        for shot in shots
    ]


def reasons_by_hand(exclusions: Sequence[ShotExclusion]) -> dict[int, str]:
    """Return the reasons of the shots that are excluded by hand now: the last word on a shot holds."""
    last = {exclusion.shot: exclusion for exclusion in exclusions}
    return {shot: one.reason for shot, one in last.items() if one.excluded}


def exclude_shot(
    store: CampaignStore, campaign: str, shot: int, reason: str, by: str, now: datetime, *, undo: bool = False
) -> None:
    """Exclude a shot, or with `undo` let it count again; `by` decides.

    Raises:
        Refused: the shot is not there or does not count already; name or reason are missing or too long.
    """
    place, reason, by = f"campaign {campaign}, shot {shot}", reason.strip(), by.strip()
    if not 1 <= len(reason) <= LONGEST_REASON:
        found = f"a reason of {len(reason)} characters"
        raise Refused(place, found, f"1 to {LONGEST_REASON}", "Give the reason in short, with --reason.")
    if not by:
        raise Refused(place, "no name", "the name of who decides", "Name the person with --by.")
    taken = {stored.shot.shot: stored.shot for stored in store.shots(campaign)}
    if shot not in taken:
        expected = f"a shot from 1 to {max(taken)}" if taken else "a shot, once there is one"
        raise Refused(place, "no such shot", expected, "See the numbers in golfbench campaign export.")
    by_hand = shot in reasons_by_hand(store.exclusions(campaign))
    if undo and not by_hand:
        raise Refused(place, "not excluded by hand", "one that is", "The report lists them.")
    if by_hand and not undo:
        raise Refused(
            place, "excluded by hand already", "a shot that counts", "Add --undo to let it count again."
        )
    if not undo and taken[shot].status is not ShotStatus.VALID:
        found = f"{taken[shot].status} already: {taken[shot].reason}"
        raise Refused(place, found, "a shot that counts", "Comment it with golfbench campaign mark.")
    store.add_exclusion(campaign, ShotExclusion(shot, now, by, reason, not undo, max(taken)))
