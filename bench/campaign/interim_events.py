"""Every look at a campaign before its end is an event, so that the error it costs is known afterwards."""

from __future__ import annotations

from datetime import UTC, datetime

from bench.campaign.campaign_record import CampaignRecord
from bench.store.campaigns import CampaignStore
from bench.store.records import CampaignState, Event

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
