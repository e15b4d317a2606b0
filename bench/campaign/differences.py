"""The differences of all levels to the reference, side by side over clubs, balls and swings.

Nothing is estimated here: each difference is a pair of its section's analysis, with the interval that holds
for all pairs of that section simultaneously.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from bench.campaign.analysis import COLUMN, Level, Pair, SectionAnalysis
from bench.campaign.plan import CampaignPlan, levels, reference_level
from bench.campaign.quantities import QUANTITIES
from bench.campaign.randomization import sections

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
                "comparison with its own error level, and the plan compares nothing between columns."
            )
    if tables:
        compared = COLUMN.get(plan.analysis.quantity, plan.analysis.quantity)
        others = ", ".join(name for column, name in QUANTITIES.items() if column != compared)
        yield f"Other quantities ({others}) are described, not compared: the plan compares {quantity} only."
