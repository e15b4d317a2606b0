"""All results of a campaign in one value, for the report, JSON and the baseline."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite
from typing import Any

from bench.campaign.analysis import SectionAnalysis, analyse
from bench.campaign.conformity import RuleFinding, judge_rules
from bench.campaign.control_chart import ControlChart, control_charts
from bench.campaign.dispersion import DispersionEllipse, dispersion_ellipses
from bench.campaign.display_units import UnitSystem
from bench.campaign.plan import CampaignPlan
from bench.campaign.quantities import LevelQuantities, level_quantities
from bench.campaign.randomization import sections
from bench.campaign.ranking import RankedLevel, ranking
from bench.campaign.repeatability import Repeatability, repeatability
from bench.campaign.sample_size import SeriesSize, series_needed
from bench.campaign.split_plot import within_club
from bench.campaign.verdicts import Verdict, section_notes, section_verdicts
from bench.shot.shot import Shot

SCHEMA = 3
"""Version of the JSON."""


@dataclass(frozen=True)
class SectionViews:
    """Further views of one section's shots."""

    quantities: tuple[LevelQuantities, ...]
    """All quantities by level."""
    ranking: tuple[RankedLevel, ...]
    dispersion: tuple[DispersionEllipse, ...]
    control_charts: tuple[ControlChart, ...]


@dataclass(frozen=True)
class Findings:
    """Results of a campaign."""

    shots: int
    by_status: Mapping[str, int]
    sections: tuple[SectionAnalysis, ...]
    views: tuple[SectionViews, ...]
    """One for each section."""
    verdicts: tuple[tuple[Verdict, ...], ...]
    """For each section."""
    needed: tuple[tuple[SeriesSize | None, SeriesSize | None], ...]
    """For each section: balls and hits of each level to find a difference, and to call them the same."""
    notes: tuple[tuple[str, ...], ...]
    """For each section: looks, covariates and what more shots would do, in sentences."""
    repeatability: Mapping[tuple[str, str], Sequence[Repeatability]]
    """For each (swing, club)."""
    rules: tuple[RuleFinding, ...]
    looks: tuple[int, ...] | None = None
    """Numbers of shots after which results were looked at, as they were given."""


def findings(
    plan: CampaignPlan,
    shots: Sequence[Shot],
    looks: Sequence[int] | None = None,
    units: UnitSystem = UnitSystem.SI,
) -> Findings:
    """Return all figures of the campaign's `shots`: numbers in SI, sentences in `units`.

    `looks` are the numbers of shots after which results were looked at before; None: not known, then an
    unfinished campaign counts as looked at after each block.
    """
    analyses, views = [], []
    named = as_flown(plan, shots)
    for section in sections(plan):
        mine = [shot for shot in shots if shot.section == section.number]
        analyses.append(analyse(plan, mine, section.number, section.name, looks))
        views.append(
            SectionViews(
                level_quantities(plan, mine),
                ranking(analyses[-1].confirmatory),
                dispersion_ellipses(plan, mine),
                control_charts(plan, mine),
            )
        )
    needed = tuple(_needed(plan, analysis) for analysis in analyses)
    return Findings(
        len(shots),
        Counter(str(shot.status) for shot in shots),
        tuple(analyses),
        tuple(views),
        tuple(_verdicts(named, *each, units) for each in zip(analyses, needed, strict=True)),
        needed,
        tuple(section_notes(named, *each, units) for each in zip(analyses, needed, strict=True)),
        repeatability(shots),
        tuple(judge_rules(plan, shots, units)),
        None if looks is None else tuple(looks),
    )


def _verdicts(
    plan: CampaignPlan,
    analysis: SectionAnalysis,
    needed: tuple[SeriesSize | None, SeriesSize | None],
    units: UnitSystem,
) -> tuple[Verdict, ...]:
    """Return a section's verdicts, in a split-plot with those on balls within each club."""
    found = list(section_verdicts(plan, analysis, needed, units))
    for inner in analysis.within:
        own = within_club(plan, inner.name)
        verdicts = section_verdicts(own, inner, _needed(own, inner), units)
        found += [one._replace(headline=f"With {inner.name}: {one.headline}") for one in verdicts]
    return tuple(found)


def as_flown(plan: CampaignPlan, shots: Sequence[Shot]) -> CampaignPlan:
    """Return the plan that names the carry its shots have: simulated balls may not have been measured."""
    if {shot.carry_source for shot in shots if shot.carry_source} != {"simulated"}:
        return plan
    return replace(plan, analysis=replace(plan.analysis, carry=""))


def _needed(plan: CampaignPlan, analysis: SectionAnalysis) -> tuple[SeriesSize | None, SeriesSize | None]:
    comparison = analysis.confirmatory
    if comparison is None or not comparison.pairs:
        return None, None
    return series_needed(plan, comparison.deviation, comparison.ball_deviation or 0.0)


def findings_record(found: Findings) -> dict[str, Any]:
    """Return the findings for JSON; unknown values are null."""
    return {
        "schema": SCHEMA,
        "shots": found.shots,
        "by_status": dict(found.by_status),
        "sections": [
            _section_record(analysis)
            | {
                "verdicts": [verdict._asdict() for verdict in verdicts],
                "needed": dict(zip(("different", "same"), (n and n._asdict() for n in needed), strict=True)),
                "notes": list(notes),
            }
            | _views_record(views)
            for analysis, verdicts, needed, notes, views in zip(
                found.sections, found.verdicts, found.needed, found.notes, found.views, strict=True
            )
        ],
        "repeatability": [
            {"swing": swing, "club": club, "figures": [_plain(asdict(figure)) for figure in figures]}
            for (swing, club), figures in found.repeatability.items()
        ],
        "rules": [asdict(rule) for rule in found.rules],
    }


def _section_record(analysis: SectionAnalysis) -> dict[str, Any]:
    """Return an analysis for JSON; balls within clubs only of a split-plot."""
    record: dict[str, Any] = _plain(asdict(analysis))
    if not analysis.within:
        del record["within"]
    return record


def _views_record(views: SectionViews) -> dict[str, Any]:
    """Return the views for JSON, of a control chart without the shots' own values."""
    record: dict[str, Any] = _plain(asdict(replace(views, control_charts=())))
    record["control_charts"] = [
        {
            "column": chart.column,
            "values": len(chart.values),
            "centre": chart.centre,
            "deviation": chart.deviation,
            "signals": {str(signal.rule): list(signal.shots) for signal in chart.signals},
        }
        for chart in views.control_charts
    ]
    return record


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
