"""Shipped plans with other values, rows of their shots, and the comparison of a section."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from bench.campaign.plan.gate import Centre
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.plan.shot_sequence import PlannedShot, Step
from bench.campaign.run.shot_source import shot_row
from bench.campaign.statistics.analysis import Comparison, analyse
from bench.config import load_configuration
from bench.records.shot.shot import Shot, ShotStatus

SHIPPED = load_configuration(Path("shipped"))
NOW = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)


@cache
def _loaded(name: str) -> CampaignPlan:
    return load_plan(Path(name), SHIPPED)


def with_values(plan: CampaignPlan, **sections: dict[str, Any]) -> CampaignPlan:
    """Return `plan` with other values in some `sections`."""
    return replace(plan, **{name: replace(getattr(plan, name), **new) for name, new in sections.items()})


def shipped_plan(name: str, **sections: dict[str, Any]) -> CampaignPlan:
    """Return the shipped plan `name` with other values in some `sections`."""
    return with_values(_loaded(name), **sections)


def row_of(trial: PlannedShot, number: int, sample: int = 1, attempt: int = 1, **columns: Any) -> Shot:
    """Return the row of a valid shot, taken as `trial`, with some `columns`."""
    row = shot_row(Step(trial, attempt, Centre()), number, sample, NOW, ShotStatus.VALID, "")
    return replace(row, **columns)


def compared(plan: CampaignPlan, shots: Sequence[Shot], looks: Sequence[int] | None = ()) -> Comparison:
    """Return the comparison of a section's `shots`, which must be possible."""
    found = analyse(plan, shots, 1, "", looks).confirmatory
    assert found is not None
    return found
