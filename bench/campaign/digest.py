"""Digests of a campaign's records: of plan and data as a whole, and of each shot."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from datetime import datetime
from hashlib import sha256
from typing import Any

from bench.shot.shot import Shot
from bench.store.records import CampaignEntry, Event, Prompt, ShotExclusion, ShotNote

SHOT_DIGITS = 8
"""Hex digits of a shot's digest on a page."""
NO_DATA = frozenset({"look", "issue"})
"""Kinds of events that say what was made of the data, not what they are."""


def shot_digests(shots: Iterable[Shot]) -> list[str]:
    """Return the digest of each shot, all its columns; 64 hex digits."""
    return [_digest([*vars(shot).values()]) for shot in shots]


def parts_digests(
    entry: CampaignEntry,
    shots: Sequence[str],
    events: Iterable[Event],
    prompts: Iterable[Prompt],
    notes: Iterable[ShotNote],
    exclusions: Sequence[ShotExclusion] = (),
) -> dict[str, str]:
    """Return the digests of plan, campaign, shots, events, prompts, notes, and exclusions if any.

    `shots` are those of the shots.
    """
    begun = asdict(entry)
    plan = begun.pop("plan")
    return {
        "plan": _digest(plan),
        "campaign": _digest(begun),
        "shots": _digest(shots),
        "events": _digest([one for one in events if one.kind not in NO_DATA]),
        "prompts": _digest(list(prompts)),
        "notes": _digest(list(notes)),
        **({"exclusions": _digest(exclusions)} if exclusions else {}),
    }


def whole_digest(parts: dict[str, str]) -> str:
    """Return one digest of all parts, 64 hex digits (SHA-256)."""
    return _digest(parts)


def _digest(value: Any) -> str:
    return sha256(_text(value).encode()).hexdigest()


def _text(value: Any) -> str:
    """Return JSON that is the same for the same values, figures with all their digits."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, default=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.isoformat()
    raise TypeError(f"{type(value).__name__} has no digest")
