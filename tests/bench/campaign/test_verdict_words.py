"""The first page agrees with the results: models and balls, all pairs, scatter, covariates."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.report.findings import findings
from bench.campaign.report.verdicts import Verdict, _sd
from bench.campaign.statistics.block_model import scatter_ratios, successive_scatter
from bench.campaign.statistics.sample_size import predict_precision, series_needed
from bench.records.shot.shot import Shot
from tests.bench.campaign.known_truth import Case, Known, cases, drawn
from tests.bench.campaign.plans import SHIPPED, compared, with_values


def _case(part: str) -> Case:
    return next(case for case in cases() if part in case.name)


def _first(plan: CampaignPlan, shots: Sequence[Shot]) -> Verdict:
    return findings(plan, shots).sections[0].verdicts[0]


@pytest.mark.parametrize(("sd", "text"), [(1.234, "1.23"), (0.1, "0.10"), (0.00346, "0.0035"), (0.0, "0.00")])
def test_sd_small_value_keeps_two_digits(sd: float, text: str) -> None:
    assert _sd(sd) == text


def test_verdict_one_ball_holds_for_ball_not_model() -> None:
    case = _case("one ball of each x 20, balls differ")
    shots, _ = drawn(case, 9.0, 1)
    verdict = _first(case.plan, shots)
    assert "more carry (launch monitor) than" in verdict.headline
    assert "20 valid shots of each with 1 ball" in verdict.detail
    assert "holds for this ball, not for its model" in verdict.detail
    many = _case("ball SD half")
    assert "not for its model" not in _first(many.plan, drawn(many, 9.0, 1)[0]).detail


@pytest.mark.parametrize("shift", [9.0, -9.0])
def test_verdict_difference_has_higher_level_first(shift: float) -> None:
    case = _case("one ball of each x 20, balls differ")
    verdict = _first(case.plan, drawn(case, shift, 1)[0])
    ahead, behind = re.match(r"(\S+) has .* than (\S+)\.$", verdict.headline).groups()  # type: ignore[union-attr]
    assert f"Difference {ahead} − {behind}: +" in verdict.detail


def test_analyse_repeated_hits_count_as_one_ball() -> None:
    case = _case("ball SD as the shot's")
    comparison = compared(case.plan, drawn(case, 0.0, 2)[0])
    (pair,) = comparison.pairs
    assert (pair.shots, pair.balls, pair.models) == (96, 12, True)
    assert pair.dof == pytest.approx(11)
    assert comparison.ball_sd == pytest.approx(2.0, rel=0.6)
    assert comparison.sd == pytest.approx(2.0, rel=0.2)
    naive = np.sqrt(2 * comparison.sd**2 / 96)
    assert pair.error > 2 * naive


@pytest.fixture(scope="module")
def ten() -> Case:
    analysis = {"equivalence_margin": 4.0, "target_difference": 4.0}
    return Case(
        "ten equal ones", with_values(_case("10 levels, 12 balls").plan, analysis=analysis), Known(sd=1.0)
    )


def test_verdict_ten_equal_levels_are_same(ten: Case) -> None:
    verdict = _first(ten.plan, drawn(ten, 0.0, 3)[0])
    assert verdict.resolved
    assert verdict.headline.startswith("All 10 balls are the same in carry (launch monitor), within 4 m")
    headline = _first(ten.plan, drawn(ten, 2.0, 3)[0]).headline
    assert headline.startswith("All 10 balls are the same in carry (launch monitor), within 4 m (")
    assert "by less than that" in headline


def test_verdict_one_distant_level_counts_pairs(ten: Case) -> None:
    headline = _first(ten.plan, drawn(ten, 12.0, 4)[0]).headline
    assert headline == "9 of 45 pairs differ in carry (launch monitor), 36 are the same within 4 m."


def test_verdict_differences_below_margin_count_as_different(ten: Case) -> None:
    shots, _ = drawn(ten, 3.45, 5)
    found = findings(ten.plan, shots)
    pairs = found.sections[0].analysis.confirmatory.pairs  # type: ignore[union-attr]
    apart = [pair for pair in pairs if pair.low_together > 0 or pair.high_together < 0]
    less = [pair for pair in apart if pair.verdict == "both"]
    headline = found.sections[0].verdicts[0].headline
    assert 0 < len(less) < len(apart)
    assert headline.startswith(
        f"{len(apart)} of 45 pairs differ in carry (launch monitor), {len(less)} of them by less"
    )


def test_verdict_enough_shots_reports_no_shortage(ten: Case) -> None:
    # All are about a margin apart: neither different by more nor the same, however many shots.
    shots, _ = drawn(ten, 4.0, 5)
    found = findings(ten.plan, shots)
    verdicts = {pair.verdict for pair in found.sections[0].analysis.confirmatory.pairs}  # type: ignore[union-attr]
    assert "not enough shots" not in verdicts
    assert "not enough" not in found.sections[0].verdicts[0].headline


def test_analyse_pair_differs_if_joint_interval_excludes_zero(ten: Case) -> None:
    for pair in compared(ten.plan, drawn(ten, 1.2, 6)[0]).pairs:
        assert (pair.p_adjusted < 0.05) == (pair.low_together > 0 or pair.high_together < 0)
        assert pair.p <= pair.p_adjusted <= min(1.0, 45 * pair.p) + 1e-12


@pytest.mark.parametrize("truth", [1.0, 2.5])
def test_scatter_ratios_cover_truth(truth: float) -> None:
    random, covered, false = np.random.default_rng(9), 0, 0
    block, level = np.repeat(np.arange(24), 3), np.tile(np.arange(3), 24)
    for _ in range(400):
        scale = np.array([truth, 1.0, 1.0])[level]
        y = 4 * random.normal(size=24)[block] + scale * random.normal(size=72)
        found = scatter_ratios(block, y, level, block, ("a", "b", "c"), 0.95)
        covered += found[0].low <= truth <= found[0].high
        false += found[2].p_adjusted < 0.05
        assert found[0].low <= found[0].ratio <= found[0].high
    assert covered / 400 == pytest.approx(0.95, abs=0.035)
    assert false / 400 < 0.06


def test_analyse_covariate_removes_explained_scatter() -> None:
    case = _case("club speed as covariate")
    shots, _ = drawn(case, 0.0, 7)
    with_it = compared(case.plan, shots)
    without = compared(with_values(case.plan, analysis={"covariates": (), "expected_r_squared": 0.0}), shots)
    assert with_it.covariates is not None
    assert with_it.covariates.share == pytest.approx(0.8, abs=0.15)
    assert with_it.covariates.slopes[0] == pytest.approx(3.0, rel=0.3)
    assert with_it.sd < 0.7 * without.sd
    (note, _) = findings(case.plan, shots).sections[0].notes
    assert "Corrected by club speed, as planned" in note
    shots[0] = replace(shots[0], club_speed_mps=None)
    left = compared(case.plan, shots).covariates
    assert left is not None
    assert left.missing == 1


def test_load_plan_covariate_equal_to_quantity_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(
        '[campaign]\nname = "x"\n[design]\ncompare = "club"\nballs = ["tour"]\nclubs = ["driver"]\n'
        '[analysis]\nquantity = "club_speed_mps"\ncovariates = ["club_speed_mps"]\n'
    )
    with pytest.raises(ExceptionGroup) as refused:
        load_plan(file, SHIPPED)
    words = " ".join(map(str, refused.value.exceptions))
    assert "none unless balls are compared" in words
    assert "not the quantity" in words


def test_series_needed_large_ball_scatter_requires_more_balls() -> None:
    plan = with_values(_case("ball SD half").plan, analysis={"target_difference": 1.0})
    few, _ = series_needed(plan, 1.0, 0.2)
    assert few is not None
    assert few.balls <= 12
    many, _ = series_needed(plan, 1.0, 2.0)
    assert many is not None
    assert many.balls > 12
    assert many.shots == 8 * many.balls


@pytest.mark.parametrize("blocks", [3, 12])
def test_series_needed_three_levels_is_fewest_blocks_laid_out(blocks: int) -> None:
    plan = _case("10 levels, 12 balls").plan
    design = {"balls": plan.design.balls[:3], "blocks": blocks}
    plan = with_values(plan, design=design, analysis={"target_difference": 3.0})
    needed, _ = series_needed(plan, 2.0, 1.0)
    assert needed is not None
    chances = [predict_precision(plan, 2.0, 1.0, needed.shots + more) for more in (-1, 0)]
    before, at = (found.power(3.0) for found in chances if found is not None)
    assert before < plan.analysis.power <= at


def test_predict_precision_uses_ball_degrees_of_freedom() -> None:
    plan = _case("2 levels, 12 balls").plan
    ahead = predict_precision(plan, 2.0, 1.0)
    assert ahead is not None
    assert ahead.dof == pytest.approx(11)
    assert ahead.error == pytest.approx(np.sqrt(2 * (1 / 12 + 4 / 96)))
    assert ahead.power(ahead.resolution(0.8)) == pytest.approx(0.8, abs=1e-6)


def test_successive_scatter_ignores_drift() -> None:
    random = np.random.default_rng(1)
    drifting = 0.02 * np.arange(400) + random.normal(size=400)
    found = successive_scatter(drifting)
    assert found.sd == pytest.approx(1.0, rel=0.1)
    assert found.low < found.sd < found.high
    assert drifting.std() > 2 * found.sd
