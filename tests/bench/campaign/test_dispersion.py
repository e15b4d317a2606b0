"""Ellipses of the landing points: share, area and its interval by drawn points with known truth."""

from __future__ import annotations

from math import pi, radians

import numpy as np
import pytest
from scipy import stats

from bench.campaign.statistics.control_chart import _ellipse, total_covariance

TRUTH = np.array([[9.0, 2.4], [2.4, 4.0]])
AREA = pi * stats.chi2.ppf(0.95, 2) * np.sqrt(np.linalg.det(TRUTH))


@pytest.mark.release
def test_ellipse_area_is_unbiased_and_interval_covers_truth() -> None:
    random, areas, inside = np.random.default_rng(1), [], 0
    ball = np.zeros(12, int)
    for _ in range(3000):
        found = _ellipse("a", random.multivariate_normal([0, 200], TRUTH, 12), ball, 0.95)
        areas.append(found.area)
        inside += found.area_low <= AREA <= found.area_high
    assert np.mean(areas) == pytest.approx(AREA, rel=0.02)
    assert inside / 3000 == pytest.approx(0.95, abs=0.012)


def test_ellipse_repeated_hits_count_as_one_ball() -> None:
    random, areas, inside, tries = np.random.default_rng(2), [], 0, 2000
    ball = np.repeat(np.arange(12), 4)
    for _ in range(tries):
        off = random.multivariate_normal([0, 0], TRUTH / 2, 12)[ball]
        found = _ellipse("a", off + random.multivariate_normal([0, 200], TRUTH / 2, 48), ball, 0.95)
        areas.append(found.area)
        inside += found.area_low <= AREA <= found.area_high
    assert np.mean(areas) == pytest.approx(AREA, rel=0.03)
    assert 0.93 <= inside / tries <= 0.97


def test_ellipse_large_sample_matches_true_axes_and_tilt() -> None:
    points = np.random.default_rng(3).multivariate_normal([1, 200], TRUTH, 20_000)
    found = _ellipse("a", points, np.arange(20_000), 0.95)
    out, cross, along = found.covariance
    inverse = np.linalg.inv([[out, cross], [cross, along]])
    off = points - found.centre
    inside = np.einsum("ni,ij,nj->n", off, inverse, off) <= stats.chi2.ppf(0.95, 2)
    assert inside.mean() == pytest.approx(0.95, abs=0.005)
    assert found.area == pytest.approx(pi / 4 * found.long_axis * found.short_axis, rel=1e-3)
    values, vectors = np.linalg.eigh(TRUTH)
    assert found.long_axis == pytest.approx(2 * np.sqrt(stats.chi2.ppf(0.95, 2) * values[1]), rel=0.03)
    tilt = np.arctan(vectors[0, 1] / vectors[1, 1])
    assert found.tilt == pytest.approx(tilt, abs=radians(2))


def test_total_covariance_one_ball_or_one_hit_each_is_plain() -> None:
    points = np.random.default_rng(4).normal(size=(9, 2))
    for ball in (np.zeros(9, int), np.arange(9)):
        covariance, dof = total_covariance(points, ball)
        assert covariance == pytest.approx(np.cov(points.T))
        assert dof == 8
