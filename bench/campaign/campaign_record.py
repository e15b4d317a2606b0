"""A campaign with all its data in the database, and the issues of its report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from bench.campaign.exclusions import reasons_by_hand, with_exclusions
from bench.campaign.plan import CampaignPlan
from bench.campaign.plan_file import plan_from_record
from bench.shot.shot import Shot, ShotStatus
from bench.store.campaigns import CampaignStore
from bench.store.records import (
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

ISSUE = "issue"
"""Kind of an event: the report was issued."""


@dataclass(frozen=True)
class CampaignRecord:
    """A campaign as stored in the database."""

    entry: CampaignEntry
    standing: Standing
    plan: CampaignPlan
    shots: Sequence[Shot]
    """As they count: what a person excluded is excluded."""
    events: Sequence[Event]
    hits: Counter[Hit]
    prompts: Sequence[Prompt] = ()
    notes: Sequence[ShotNote] = ()
    runs: Sequence[CampaignRun] = ()
    exclusions: Sequence[ShotExclusion] = ()
    """By hand, in the order in which they were made."""

    @property
    def issues(self) -> list[Event]:
        """Issues of its report in order; the last one supersedes those before it."""
        return [event for event in self.events if event.kind == ISSUE]

    @property
    def shots_as_taken(self) -> list[Shot]:
        """Its shots without what a person excluded later."""
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
    text = f"look at {shots} shots: {occasion}"
    store.add(record.entry, (), [Event(datetime.now(UTC), shots + 1, KIND, text)])
    return [*looks, shots]
