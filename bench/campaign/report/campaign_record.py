"""A campaign with all its data in the database: digests, exclusions, issues of its report.

A person can exclude shots, with name and reason. They are never deleted; each exclusion is kept and reported.
The shot's record stays as taken, so that an unfinished campaign continues as planned: the shot is not
repeated. Reports, figures and tables see it as excluded.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from hashlib import sha256
from typing import Any, NamedTuple

from bench.base.errors import Refused
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.plan_file import plan_from_record
from bench.records.shot.shot import Shot, ShotStatus
from bench.store.campaigns import CampaignStore
from bench.store.rows import (
    CampaignEntry,
    CampaignRun,
    CampaignState,
    Event,
    Hit,
    Prompt,
    ShotExclusion,
    ShotNote,
    Standing,
)

SHOT_DIGITS = 8
"""Hex digits of a shot's digest on a page."""
NO_DATA = frozenset({"look", "issue"})
"""Kinds of events that record a use of the data, not the data."""


def _digest(value: Any) -> str:
    """Return the digest of JSON that is the same for the same values, figures with all their digits."""
    text = json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, default=datetime.isoformat
    )
    return sha256(text.encode()).hexdigest()


MAX_REASON_LENGTH = 500


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
    if not 1 <= len(reason) <= MAX_REASON_LENGTH:
        found = f"a reason of {len(reason)} characters"
        raise Refused(place, found, f"1 to {MAX_REASON_LENGTH}", "Give the reason in short, with --reason.")
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
        action = "Add --undo to let it count again."
        raise Refused(place, "excluded by hand already", "a shot that counts", action)
    if not undo and taken[shot].status is not ShotStatus.VALID:
        found = f"{taken[shot].status} already: {taken[shot].reason}"
        raise Refused(place, found, "a shot that counts", "Comment it with golfbench campaign mark.")
    store.add_exclusion(campaign, ShotExclusion(shot, now, by, reason, not undo, max(taken)))


ISSUE = "issue"
"""Kind of an event: the report was issued."""


@dataclass(frozen=True)
class CampaignRecord:
    """A campaign as stored in the database."""

    entry: CampaignEntry
    standing: Standing
    plan: CampaignPlan
    shots: Sequence[Shot]
    """Shots as they count: those that a person excluded are excluded."""
    events: Sequence[Event]
    hits: Counter[Hit]
    prompts: Sequence[Prompt] = ()
    notes: Sequence[ShotNote] = ()
    runs: Sequence[CampaignRun] = ()
    exclusions: Sequence[ShotExclusion] = ()
    """Exclusions by hand, oldest first."""

    @property
    def issues(self) -> list[Event]:
        """Issues of its report in order; the last one supersedes those before it."""
        return [event for event in self.events if event.kind == ISSUE]

    @property
    def shots_as_taken(self) -> list[Shot]:
        """Its shots without the later exclusions by a person."""
        by_hand = reasons_by_hand(self.exclusions)
        return [
            replace(shot, status=ShotStatus.VALID, reason="") if shot.shot in by_hand else shot
            for shot in self.shots
        ]

    @property
    def number(self) -> str:
        """Number of its report: that of the last issue, or of a draft."""
        issues = len(self.issues)
        return f"{self.entry.id}-R{issues}" if issues else f"{self.entry.id}-draft"


class Digests(NamedTuple):
    """SHA-256 digests of a campaign, 64 hex digits each."""

    shots: list[str]
    """Digest of each shot, all its columns."""
    parts: dict[str, str]
    """Digests of plan, campaign, shots, events, prompts, notes, exclusions."""
    whole: str


def record_digests(record: CampaignRecord) -> Digests:
    """Return the digests of a campaign."""
    shots = [_digest([*vars(shot).values()]) for shot in record.shots]
    begun = asdict(record.entry)
    parts = {
        "plan": _digest(begun.pop("plan")),
        "campaign": _digest(begun),
        "shots": _digest(shots),
        "events": _digest([one for one in record.events if one.kind not in NO_DATA]),
        "prompts": _digest(list(record.prompts)),
        "notes": _digest(list(record.notes)),
        "exclusions": _digest(list(record.exclusions)),
    }
    return Digests(shots, parts, _digest(parts))


def load_record(store: CampaignStore, entry: CampaignEntry) -> CampaignRecord:
    """Return a campaign with all its data in the database."""
    exclusions = store.exclusions(entry.id)
    return CampaignRecord(
        entry,
        store.standing(entry.id),
        plan_from_record(entry.plan, f"campaign {entry.id}"),
        with_exclusions([stored.shot for stored in store.shots(entry.id)], exclusions),
        store.events(entry.id),
        store.hits(entry.hit_scope),
        store.prompts(entry.id),
        store.notes(entry.id),
        store.runs(entry.id),
        exclusions,
    )


KIND = "look"


def note_look(store: CampaignStore, record: CampaignRecord, occasion: str) -> list[int]:
    """Store a look at an unfinished campaign; return the numbers of shots at which there was one, this too.

    A second look at the same shots adds nothing: it is not counted. At the end of the plan there is
    nothing to pay for.
    """
    shots = len(record.shots)
    looks = [event.before_shot - 1 for event in record.events if event.kind == KIND]
    if record.standing.state is CampaignState.FINISHED or not shots or shots in looks:
        return looks
    text = f"interim analysis of {shots} shots: {occasion}"
    store.add(record.entry, (), [Event(datetime.now(UTC), shots + 1, KIND, text)])
    return [*looks, shots]
