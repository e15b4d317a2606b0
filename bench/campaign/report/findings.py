"""All results of a campaign in one value: quantities, differences, ranking; for report, JSON and baseline.

Nothing is estimated here: each difference is a pair of its section's analysis, with the interval that holds
for all pairs of that section simultaneously.

Ranking of a section's levels with letters: those without a letter in common differ, all pairs together.
Compact letter display by insertion and absorption (Piepho 2004), from the decisions of the confirmatory
analysis at its familywise level. A shared letter means that no difference was shown, not equality.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from bench.base.json_schema import json_value
from bench.campaign.plan.plan import NAMES, CampaignPlan, levels, reference_level
from bench.campaign.plan.shot_sequence import Role, sections, tests_by_level
from bench.campaign.report._conformity import RuleFinding, judge_rules
from bench.campaign.report.report_format import UnitSystem
from bench.campaign.report.verdicts import Needed, Verdict, section_notes, section_verdicts
from bench.campaign.statistics.analysis import Comparison, Level, Pair, SectionAnalysis, analyse
from bench.campaign.statistics.block_model import (
    Repeatability,
    Spread,
    independent_codes,
    repeatability,
    spread,
    within_club,
)
from bench.campaign.statistics.control_chart import (
    ControlChart,
    DispersionEllipse,
    control_charts,
    dispersion_ellipses,
)
from bench.campaign.statistics.sample_size import series_needed
from bench.records.shot.shot import Shot, ShotStatus

QUANTITIES = (
    *("ball_speed_mps", "launch_angle_deg", "spin_rpm", "landing_angle_deg"),
    *("apex_m", "carry_m", "total_m", "carry_side_m"),
)
"""Columns of the table of all quantities."""


@dataclass(frozen=True)
class LevelQuantities:
    """All quantities of one level in one section, of valid shots."""

    name: str
    control: bool
    """Whether it is the control ball."""
    balls: int
    hits: int
    """Number of shots that hit a ball, valid or not."""
    valid: int
    spreads: Mapping[str, Spread]
    """Mean and standard deviation with their intervals, by column."""


def level_quantities(plan: CampaignPlan, shots: Sequence[Shot]) -> tuple[LevelQuantities, ...]:
    """Return all quantities of a section's levels, those of the control ball last."""
    by_level = tests_by_level(plan, shots)
    found = [_quantities(plan, name, mine, control=False) for name, mine in by_level.items()]
    if controls := [shot for shot in shots if shot.role == Role.CONTROL]:
        found.append(_quantities(plan, plan.control.ball, controls, control=True))
    return tuple(found)


def _quantities(plan: CampaignPlan, name: str, shots: Sequence[Shot], *, control: bool) -> LevelQuantities:
    valid = [shot for shot in shots if shot.status is ShotStatus.VALID]
    spreads = {}
    for column in QUANTITIES:
        measured = [shot for shot in valid if getattr(shot, column) is not None]
        values = np.array([getattr(shot, column) for shot in measured], dtype=float)
        spreads[column] = spread(values, independent_codes(plan, measured), plan.analysis.confidence)
    return LevelQuantities(
        name,
        control,
        len({shot.sample for shot in valid}),
        sum(shot.status is not ShotStatus.FAILED for shot in shots),
        len(valid),
        spreads,
    )


_FACTORS = ("ball", "club", "swing")


class ComparedLevel(NamedTuple):
    """One level and its difference to the reference."""

    level: Level
    pair: Pair | None
    """Level less reference; None of the reference itself, and where they were not compared."""


class DifferenceColumn(NamedTuple):
    """The levels of one comparison, in the plan's order."""

    name: str
    """Value of the factors that differ between columns; empty in a table of one column."""
    confidence: float | None
    """Simultaneous confidence of its intervals; None without a comparison."""
    compared: Sequence[ComparedLevel]


class DifferenceTable(NamedTuple):
    """Comparisons of the same levels, one per column."""

    factor: str
    across: str
    """Factors that differ between the columns; empty in a table of one column."""
    reference: str
    columns: Sequence[DifferenceColumn]


def difference_to(reference: str, name: str, pairs: Sequence[Pair]) -> Pair | None:
    """Return the pair `name` less `reference`; None if the `pairs` lack it."""
    for pair in pairs:
        if (pair.first, pair.second) == (name, reference):
            return pair
        if (pair.first, pair.second) == (reference, name):
            return pair.reversed()
    return None


def difference_tables(plan: CampaignPlan, analyses: Sequence[SectionAnalysis]) -> tuple[DifferenceTable, ...]:
    """Return the table of the compared factor; in a split-plot also that of the balls within each club."""
    fixed, places, tables = _fixed_factors(plan), section_labels(plan), []
    if len(levels(plan)) > 1:
        columns = [_column(*each, reference_level(plan)) for each in zip(places, analyses, strict=True)]
        across = " and ".join(fixed)
        tables.append(DifferenceTable(plan.design.compare, across, reference_level(plan), columns))
    if any(analysis.within for analysis in analyses):
        balls = plan.design.balls[0]
        columns = [
            _column(", ".join(filter(None, (place, inner.name))), inner, balls)
            for place, analysis in zip(places, analyses, strict=True)
            for inner in analysis.within
        ]
        across = " and ".join([*fixed, "club"]) if len(columns) > 1 else ""
        tables.append(DifferenceTable("ball", across, balls, columns))
    return tuple(tables)


def section_labels(plan: CampaignPlan) -> list[str]:
    """Return club, ball or swing of each section, those that differ between sections; empty if none does."""
    fixed = _fixed_factors(plan)
    return [", ".join(getattr(section.arms[0], name) for name in fixed) for section in sections(plan)]


def _fixed_factors(plan: CampaignPlan) -> list[str]:
    """Return the factors with several values that are constant within a section."""
    varied = [name for name in _FACTORS if len(getattr(plan.design, f"{name}s")) > 1]
    return [name for name in varied if name == "swing" or not plan.split if name != plan.design.compare]


def _column(name: str, analysis: SectionAnalysis, reference: str) -> DifferenceColumn:
    result = analysis.confirmatory
    pairs = result.pairs if result else ()
    compared = [ComparedLevel(one, difference_to(reference, one.name, pairs)) for one in analysis.levels]
    return DifferenceColumn(name, result.confidence if result else None, compared)


def not_compared(plan: CampaignPlan, tables: Sequence[DifferenceTable], quantity: str) -> Iterator[str]:
    """Yield the questions that the `tables` leave open, with the reason; `quantity` is the compared one."""
    for table in tables:
        missing = [
            f"{one.level.name}{f' ({column.name})' if column.name else ''}"
            for column in table.columns
            for one in column.compared
            if one.pair is None and one.level.name != table.reference
        ]
        if missing:
            yield (
                f"Not compared with {table.reference}, for lack of valid shots in common blocks: "
                f"{', '.join(missing)}."
            )
        if table.across:
            yield (
                f"The interaction of {table.factor} and {table.across} was not tested: each column is a "
                "comparison at a separate significance level, and the plan compares nothing between columns."
            )
    if tables:
        others = ", ".join(NAMES[column] for column in QUANTITIES if column != plan.column)
        yield f"Other quantities ({others}) are described, not compared: the plan compares {quantity} only."


@dataclass(frozen=True)
class RankedLevel:
    """One level at its place, in descending order."""

    rank: int
    name: str
    effect: float
    """Level less the mean of all levels, by the confirmatory model."""
    letters: str
    scatter_letters: str
    """Levels without one in common scatter differently; empty where scatter was not compared."""


def ranking(comparison: Comparison | None) -> tuple[RankedLevel, ...]:
    """Return the compared levels in descending order; empty without a comparison."""
    if comparison is None or not comparison.pairs:
        return ()
    pairs = comparison.pairs
    names = list(dict.fromkeys(name for pair in pairs for name in (pair.first, pair.second)))
    effects = _effects(names, pairs)
    order = sorted(names, key=lambda name: (-effects[name], name))
    different = [(p.first, p.second) for p in pairs if p.verdict in {"different", "both"}]
    letters = compact_letters(order, different)
    scatter: dict[str, str] = {}
    if comparison.scatter:
        unequal = [
            (r.first, r.second) for r in comparison.scatter if r.p_adjusted < 1 - comparison.confidence
        ]
        compared = {name for ratio in comparison.scatter for name in (ratio.first, ratio.second)}
        scatter = compact_letters([name for name in order if name in compared], unequal)
    return tuple(
        RankedLevel(place, name, effects[name], letters[name], scatter.get(name, ""))
        for place, name in enumerate(order, 1)
    )


def compact_letters(order: Sequence[str], different: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the letters of each name of `order`, so that exactly the `different` pairs share none."""
    groups: list[frozenset[str]] = [frozenset(order)]
    for one, two in different:
        split: list[frozenset[str]] = []
        for group in groups:
            split += [group - {one}, group - {two}] if {one, two} <= group else [group]
        unique = list(dict.fromkeys(split))
        groups = [group for group in unique if not any(group < other for other in unique)]
    place = {name: number for number, name in enumerate(order)}
    groups.sort(key=lambda group: sorted(place[name] for name in group))
    return {
        name: "".join(_letter(number) for number, group in enumerate(groups) if name in group)
        for name in order
    }


def _letter(number: int) -> str:
    """Return a to z, then a' to z' and so on."""
    return chr(ord("a") + number % 26) + "'" * (number // 26)


def _effects(names: Sequence[str], pairs: Sequence[Pair]) -> dict[str, float]:
    """Return the effects that the differences have in common, with mean 0."""
    code = {name: index for index, name in enumerate(names)}
    rows = np.zeros((len(pairs) + 1, len(names)))
    for row, pair in zip(rows, pairs, strict=False):
        row[code[pair.first]], row[code[pair.second]] = 1.0, -1.0
    rows[-1] = 1.0
    found = np.linalg.lstsq(rows, np.array([*(pair.difference for pair in pairs), 0.0]), rcond=None)[0]
    return {name: float(value) for name, value in zip(names, found, strict=True)}


SCHEMA = 6


@dataclass(frozen=True)
class SectionFindings:
    """Results of one section."""

    label: str
    """Club, ball or swing that other sections have otherwise; empty in the only one."""
    analysis: SectionAnalysis
    verdicts: tuple[Verdict, ...]
    needed: Needed
    notes: tuple[str, ...]
    """Sentences: interim looks, covariates, and the benefit of more shots."""
    quantities: tuple[LevelQuantities, ...]
    ranking: tuple[RankedLevel, ...]
    dispersion: tuple[DispersionEllipse, ...]
    control_charts: tuple[ControlChart, ...]


@dataclass(frozen=True)
class Findings:
    """Results of a campaign."""

    shots: int
    by_status: Mapping[str, int]
    sections: tuple[SectionFindings, ...]
    differences: tuple[DifferenceTable, ...]
    repeatability: Mapping[tuple[str, str], Sequence[Repeatability]]
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
    found, named = [], as_flown(plan, shots)
    for section, label in zip(sections(plan), section_labels(plan), strict=True):
        mine = [shot for shot in shots if shot.section == section.number]
        analysis = analyse(plan, mine, section.number, section.name, looks)
        needed = _needed(plan, analysis)
        found.append(
            SectionFindings(
                label,
                analysis,
                _verdicts(named, analysis, needed, units),
                needed,
                section_notes(named, analysis, needed, units),
                level_quantities(plan, mine),
                ranking(analysis.confirmatory),
                dispersion_ellipses(plan, mine),
                control_charts(plan, mine),
            )
        )
    return Findings(
        len(shots),
        Counter(str(shot.status) for shot in shots),
        tuple(found),
        difference_tables(plan, [one.analysis for one in found]),
        repeatability(shots),
        tuple(judge_rules(plan, shots, units)),
        None if looks is None else tuple(looks),
    )


def _verdicts(
    plan: CampaignPlan, analysis: SectionAnalysis, needed: Needed, units: UnitSystem
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


def _needed(plan: CampaignPlan, analysis: SectionAnalysis) -> Needed:
    comparison = analysis.confirmatory
    if comparison is None or not comparison.pairs:
        return None, None
    return series_needed(plan, comparison.sd, comparison.ball_sd or 0.0)


def findings_record(found: Findings) -> dict[str, Any]:
    """Return the findings for JSON; unknown values are null."""
    return {
        "schema": SCHEMA,
        "shots": found.shots,
        "by_status": dict(found.by_status),
        "sections": [_section_record(section) for section in found.sections],
        "repeatability": [
            {"swing": swing, "club": club, "figures": [json_value(asdict(figure)) for figure in figures]}
            for (swing, club), figures in found.repeatability.items()
        ],
        "rules": [asdict(rule) for rule in found.rules],
    }


def _section_record(found: SectionFindings) -> dict[str, Any]:
    """Return the findings of a section for JSON, of a control chart without the shots' own values."""
    needed = zip(("different", "same"), (size and size._asdict() for size in found.needed), strict=True)
    record: dict[str, Any] = json_value(asdict(found.analysis))
    return record | {
        "verdicts": [verdict._asdict() for verdict in found.verdicts],
        "needed": dict(needed),
        "notes": list(found.notes),
        "quantities": [json_value(asdict(one)) for one in found.quantities],
        "ranking": [json_value(asdict(one)) for one in found.ranking],
        "dispersion": [json_value(asdict(one)) for one in found.dispersion],
        "control_charts": [
            {
                "column": chart.column,
                "values": len(chart.values),
                "centre": chart.centre,
                "sd": chart.sd,
                "signals": {str(rule): list(shots) for rule, shots in chart.signals.items()},
            }
            for chart in found.control_charts
        ],
    }
