"""All results of a campaign in one value, for the report, JSON and the baseline."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any

import numpy as np

from bench.campaign.analysis import COLUMN, SectionAnalysis, analyse, shots_still_needed
from bench.campaign.mixed_model import MixedModel, mixed_model
from bench.campaign.plan import CampaignPlan
from bench.campaign.repeatability import Repeatability, repeatability
from bench.campaign.rules import rule_sets
from bench.campaign.sequence import sections
from bench.campaign.verdicts import Verdict, section_verdicts
from bench.shot.shot import Shot, ShotStatus

SCHEMA = 1
"""Version of the JSON."""


@dataclass(frozen=True)
class RuleFinding:
    """One level judged by one dated rule set."""

    rule: str
    text: str
    level: str
    value: float
    """Mean in the rule's quantity; for a symmetry rule the max difference of means."""
    at_most: float
    holds: bool
    source: str


@dataclass(frozen=True)
class Findings:
    """Results of a campaign."""

    shots: int
    by_status: Mapping[str, int]
    sections: tuple[SectionAnalysis, ...]
    mixed: tuple[MixedModel | None, ...]
    """One for each section."""
    verdicts: tuple[tuple[Verdict, ...], ...]
    """For each section."""
    needed: tuple[tuple[int | None, int | None], ...]
    """For each section: valid shots of each level to find a difference, and to call them the same."""
    repeatability: Mapping[tuple[str, str], Sequence[Repeatability]]
    """For each (swing, club)."""
    rules: tuple[RuleFinding, ...]


def findings(plan: CampaignPlan, shots: Sequence[Shot]) -> Findings:
    """Return all figures of the campaign's `shots`."""
    analyses, models = [], []
    for section in sections(plan):
        mine = [shot for shot in shots if shot.section == section.number]
        analyses.append(analyse(plan, mine, section.number, section.name))
        models.append(mixed_model(plan, mine))
    return Findings(
        len(shots),
        Counter(str(shot.status) for shot in shots),
        tuple(analyses),
        tuple(models),
        tuple(section_verdicts(plan, analysis) for analysis in analyses),
        tuple(_needed(plan, analysis) for analysis in analyses),
        repeatability(shots),
        tuple(_rules(plan, shots)),
    )


def _needed(plan: CampaignPlan, analysis: SectionAnalysis) -> tuple[int | None, int | None]:
    comparison = analysis.confirmatory
    if comparison is None or not comparison.pairs:
        return None, None
    return shots_still_needed(plan, comparison)


def _rules(plan: CampaignPlan, shots: Sequence[Shot]) -> list[RuleFinding]:
    known, found = rule_sets(), []
    for name in plan.rules.apply:
        rule = known[name]
        column = COLUMN.get(rule.quantity, rule.quantity)
        means: dict[str, float] = {}
        for ball in plan.design.balls:
            values = [
                value
                for shot in shots
                if shot.ball == ball and shot.role == "test" and shot.status is ShotStatus.VALID
                if (value := getattr(shot, column)) is not None
            ]
            if values:
                means[ball] = float(np.mean(values))
        if name == "symmetry":
            if len(means) > 1:
                gap = max(means.values()) - min(means.values())
                words = " against ".join(means)
                found.append(
                    RuleFinding(name, rule.text, words, gap, rule.at_most, gap <= rule.at_most, rule.source)
                )
            continue
        for ball, mean in means.items():
            found.append(
                RuleFinding(name, rule.text, ball, mean, rule.at_most, mean <= rule.at_most, rule.source)
            )
    return found


def findings_record(found: Findings) -> dict[str, Any]:
    """Return the findings for JSON; unknown values are null."""
    return {
        "schema": SCHEMA,
        "shots": found.shots,
        "by_status": dict(found.by_status),
        "sections": [
            _plain(asdict(analysis))
            | {
                "mixed": None if mixed is None else _plain(asdict(mixed)),
                "verdicts": [verdict._asdict() for verdict in verdicts],
                "shots_needed": {"different": needed[0], "same": needed[1]},
            }
            for analysis, mixed, verdicts, needed in zip(
                found.sections, found.mixed, found.verdicts, found.needed, strict=True
            )
        ],
        "repeatability": [
            {"swing": swing, "club": club, "figures": [_plain(asdict(figure)) for figure in figures]}
            for (swing, club), figures in found.repeatability.items()
        ],
        "rules": [asdict(rule) for rule in found.rules],
    }


def _plain(value: Any) -> Any:
    match value:
        case dict():
            return {key: _plain(item) for key, item in value.items()}
        case tuple() if hasattr(value, "_asdict"):
            return _plain(value._asdict())
        case list() | tuple():
            return [_plain(item) for item in value]
        case float():
            return value if isfinite(value) else None
        case _:
            return value
