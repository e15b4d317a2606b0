"""Differences to the reference: the analysis' own pairs, whichever level the plan names."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import sections
from bench.campaign.report.findings import difference_tables, difference_to, not_compared, section_labels
from bench.campaign.statistics.analysis import SectionAnalysis, analyse
from tests.bench.campaign.plans import shipped_plan, with_values
from tests.benchmarks.campaign_statistics import Truth, campaign_shots


def _analysed(name: str, **design: Any) -> tuple[CampaignPlan, list[SectionAnalysis]]:
    plan = shipped_plan(name, design=design)
    shots = campaign_shots(plan, Truth(sd=1.0, difference=6.0), 1)
    return plan, [
        analyse(plan, [shot for shot in shots if shot.section == one.number], one.number, one.name, ())
        for one in sections(plan)
    ]


def _referred(plan: CampaignPlan, reference: str) -> CampaignPlan:
    return with_values(plan, analysis={"reference": reference})


def test_difference_tables_three_swings_have_one_column_each() -> None:
    plan, analyses = _analysed("ten-balls", blocks=4)
    (table,) = difference_tables(plan, analyses)
    assert (table.factor, table.across, table.reference) == ("ball", "swing", "a")
    assert [column.name for column in table.columns] == list(plan.design.swings) == section_labels(plan)
    for column, analysis in zip(table.columns, analyses, strict=True):
        assert analysis.confirmatory is not None
        assert column.compared[0].pair is None
        for one in column.compared[1:]:
            assert one.pair is not None
            (pair,) = (p for p in analysis.confirmatory.pairs if {p.first, p.second} == {"a", one.level.name})
            assert one.pair.difference == -pair.difference
            assert (one.pair.low_together, one.pair.high_together) == (
                -pair.high_together,
                -pair.low_together,
            )
            assert (one.pair.low, one.pair.high) == (-pair.high, -pair.low)
            assert (one.pair.verdict, one.pair.p_adjusted) == (pair.verdict, pair.p_adjusted)


def test_difference_tables_reference_changes_no_result() -> None:
    plan, analyses = _analysed("ten-balls", blocks=4, swings=("default",))
    (table,) = difference_tables(_referred(plan, "c"), analyses)
    assert (table.reference, table.across, table.columns[0].name) == ("c", "", "")
    assert [one.level.name for one in table.columns[0].compared if one.pair is None] == ["c"]
    assert analyses[0].confirmatory is not None
    first, last = table.columns[0].compared[0].pair, table.columns[0].compared[-1].pair
    assert first in analyses[0].confirmatory.pairs
    assert last is not None
    assert difference_to("j", "c", analyses[0].confirmatory.pairs) == last.reversed()


def test_difference_tables_split_plot_compares_balls_within_clubs() -> None:
    plan, analyses = _analysed("clubs-split-plot")
    clubs, balls = difference_tables(_referred(plan, "driver-9"), analyses)
    assert (clubs.factor, clubs.reference, clubs.across) == ("club", "driver-9", "")
    assert (balls.factor, balls.reference, balls.across) == ("ball", "tour", "club")
    assert [column.name for column in balls.columns] == list(plan.design.clubs)
    assert balls.columns[1].compared[1].pair is not None


def test_not_compared_lists_missing_pairs_interaction_and_other_quantities() -> None:
    plan, analyses = _analysed("ten-balls", blocks=4)
    assert analyses[1].confirmatory is not None
    kept = tuple(pair for pair in analyses[1].confirmatory.pairs if "d" not in {pair.first, pair.second})
    analyses[1] = replace(analyses[1], confirmatory=replace(analyses[1].confirmatory, pairs=kept))
    analyses[2] = replace(analyses[2], confirmatory=None)
    missing, interaction, others = not_compared(plan, difference_tables(plan, analyses), "carry")
    assert "lack of valid shots" in missing
    assert "d (driver-90mph), b (default)" in missing
    assert "interaction of ball and swing" in interaction
    assert "carry" not in others.split(":")[0]


@pytest.mark.parametrize("quantity", ["launch_angle", "spin_rpm"])
def test_not_compared_omits_compared_quantity(quantity: Any) -> None:
    plan, analyses = _analysed("ten-balls", blocks=2, swings=("default",))
    plan = with_values(plan, analysis={"quantity": quantity})
    (others,) = not_compared(plan, difference_tables(plan, analyses), "x")
    assert quantity.partition("_")[0] not in others
    assert "carry" in others


def test_difference_tables_single_level_is_empty() -> None:
    plan, analyses = _analysed("repeatability", blocks=4)
    assert difference_tables(plan, analyses) == ()
    assert list(not_compared(plan, (), "club speed")) == []
