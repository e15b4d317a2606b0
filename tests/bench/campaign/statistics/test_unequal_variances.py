"""Errors of differences are those of textbooks, and hold for balls that are hit again."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from bench.campaign.statistics._unequal_variances import UnitLayout, together, units_of
from bench.campaign.statistics.block_model import fit_blocks


def test_unit_layout_two_levels_match_paired_t_test() -> None:
    random, balls, hits = np.random.default_rng(3), 12, 8
    block = np.arange(balls * hits)
    one, two = (random.normal(size=balls)[block % balls] + random.normal(size=len(block)) for _ in range(2))
    y = np.column_stack([one, two]).ravel()
    level, ball = np.tile([0, 1], len(block)), np.repeat(block % balls, 2)
    fit = fit_blocks(y, level, np.repeat(block, 2), 2)
    found = UnitLayout(fit, units_of(level, ball, 2)).estimate(fit.residuals).contrast(fit, 0, 1)
    means = [np.bincount(block % balls, values) / hits for values in (one, two)]
    known = stats.ttest_rel(means[0], means[1])
    assert found is not None
    assert found.dof == pytest.approx(balls - 1)
    assert found.p == pytest.approx(float(known.pvalue))
    low, high = known.confidence_interval(0.95)
    assert found.interval(0.95) == pytest.approx((low, high))


def test_unit_layout_error_matches_mixed_model() -> None:
    from statsmodels.regression.mixed_linear_model import MixedLM

    # Balanced and away from the boundary, REML's error of a difference is that of the balls' means.
    random, count, balls, hits = np.random.default_rng(8), 3, 60, 3
    blocks = balls * hits
    level, block = np.tile(np.arange(count), blocks), np.repeat(np.arange(blocks), count)
    turns = np.column_stack([random.permutation(np.arange(blocks) % balls) for _ in range(count)]).ravel()
    ball = level * balls + turns
    y = 3 * random.normal(size=count * balls)[ball] + random.normal(size=len(level))
    fit = fit_blocks(y, level, block, count)
    errors = UnitLayout(fit, units_of(level, turns, count)).estimate(fit.residuals)
    ours = np.mean([errors.of_pair(*pair)[0] ** 2 for pair in combinations(range(count), 2)])
    known = MixedLM(y, (level[:, None] == np.arange(count)).astype(float), ball).fit(reml=True)
    assert ours == pytest.approx(2 * float(known.bse_fe[0]) ** 2, rel=0.05)
    assert errors.ratio == pytest.approx(float(known.cov_re[0, 0]) / known.scale, rel=0.2)


def test_unit_layout_three_levels_give_pairwise_variances() -> None:
    # With three levels Grubbs' estimates are exact: each difference keeps the variance of its own blocks.
    random = np.random.default_rng(5)
    y = random.normal(size=(20, 3)) * np.array([1.0, 1.0, 4.0])
    level, block = np.tile(np.arange(3), 20), np.repeat(np.arange(20), 3)
    fit = fit_blocks(y.ravel(), level, block, 3)
    errors = UnitLayout(fit, units_of(level, block, 3)).estimate(fit.residuals)
    for one, two in combinations(range(3), 2):
        error, dof = errors.of_pair(one, two)
        assert error == pytest.approx((y[:, one] - y[:, two]).std(ddof=1) / np.sqrt(20))
        assert dof == pytest.approx(19)


def test_units_of_single_ball_uses_shots_as_units() -> None:
    level = np.tile([0, 1], 20)
    units = units_of(level, np.where(level == 0, 0, np.arange(40) // 2 % 5), 2)
    assert list(units.balls) == [1, 5]
    assert list(np.bincount(units.level)) == [20, 5]


def test_units_of_many_shots_limits_unit_count() -> None:
    units = units_of(np.tile(np.arange(10), 1000), np.repeat(np.arange(1000), 10), 10)
    assert len(units.level) == 240
    assert list(units.balls) == [1000] * 10


@pytest.mark.parametrize(("count", "known"), [(3, 2.3437), (5, 2.7278), (10, 3.1634)])
def test_together_all_pairs_match_tukey(count: int, known: float) -> None:
    # Studentized range at 5 % with many degrees of freedom, over the square root of 2.
    level, block = np.tile(np.arange(count), 400), np.repeat(np.arange(400), count)
    fit = fit_blocks(np.zeros(len(level)), level, block, count)
    layout = UnitLayout(fit, units_of(level, block, count))
    joint = together(layout.foreseen(np.ones(count), 0.0), list(combinations(range(count), 2)), 1e9)
    single = joint.single(0.05)
    assert stats.norm.isf(single / 2) == pytest.approx(known, abs=0.12 if count == 10 else 0.06)
    assert joint.adjusted(single) == pytest.approx(0.05, abs=0.003)
    assert joint.adjusted(1e-9) == pytest.approx(1e-9 * len(list(combinations(range(count), 2))))


def test_unit_layout_zero_scatter_has_zero_error() -> None:
    fit = fit_blocks(np.tile([1.0, 2.0, 4.0], 5), np.tile([0, 1, 2], 5), np.repeat(np.arange(5), 3), 3)
    errors = UnitLayout(fit, units_of(np.tile([0, 1, 2], 5), np.arange(15), 3)).estimate(fit.residuals)
    found = errors.contrast(fit, 2, 0)
    assert found is not None
    assert found.estimate == pytest.approx(3.0)
    assert found.error == pytest.approx(0.0, abs=1e-12)
