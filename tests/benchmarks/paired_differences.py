"""Joint intervals of few blocks: paired differences, exact for each pair, beside variances of the levels.

Written without the product's code: five levels hit once in each of five blocks. Paired: Student's t of the
differences of two levels within blocks, exact whatever their scatter. By levels: variances of the levels by
the method of moments, as `bench.campaign.unit_errors` estimates them. The critical value of both is drawn
where all levels scatter alike, which few blocks cannot tell from a design where one scatters threefold.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import combinations
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.row import Row

TITLE = "paired differences"
LEVELS, BLOCKS = 5, 5
ALIKE, ONE_THREEFOLD = (1.0,) * LEVELS, (3.0,) + (1.0,) * (LEVELS - 1)
FLOOR = 0.1
"""Least share of the pooled variance that is believed of a pair."""

Array = NDArray[np.float64]


class Tests(NamedTuple):
    """Of each campaign."""

    largest: Array
    """Largest |t| of all pairs."""
    error: Array
    """Standard errors' mean over the pairs without the scattered level."""


def drawn(scale: Sequence[float], campaigns: int, seed: int) -> tuple[Tests, Tests]:
    """Return tests without a difference between levels of scatter `scale`: paired, and by levels."""
    shots = np.random.default_rng(seed).normal(size=(campaigns, BLOCKS, LEVELS)) * np.array(scale)
    means = shots.mean(axis=1)
    left = shots - shots.mean(axis=2, keepdims=True)
    left = left - left.mean(axis=1, keepdims=True)
    squares = (left**2).sum(axis=1) / (BLOCKS - 1)
    pooled = squares.sum(axis=1) / (LEVELS - 1)
    of_level = (squares - pooled[:, None] / LEVELS) / (1 - 2 / LEVELS)
    ratios: tuple[list[Array], list[Array]] = [], []
    errors: tuple[list[Array], list[Array]] = [], []
    for one, two in combinations(range(LEVELS), 2):
        paired = (shots[:, :, one] - shots[:, :, two]).var(axis=1, ddof=1)
        likely = np.maximum(of_level[:, one] + of_level[:, two], FLOOR * 2 * pooled)
        for variance, ratio, error in zip((paired, likely), ratios, errors, strict=True):
            deviation = np.sqrt(variance / BLOCKS)
            ratio.append(np.abs(means[:, one] - means[:, two]) / deviation)
            if one:
                error.append(deviation)
    first, second = (
        Tests(np.max(ratio, axis=0), np.mean(error, axis=0))
        for ratio, error in zip(ratios, errors, strict=True)
    )
    return first, second


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return false "different" of any pair, and half widths of joint intervals, of both; some seconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=100_000)
    campaigns = parser.parse_args(arguments).campaigns
    alike, scattered = drawn(ALIKE, campaigns, 1), drawn(ONE_THREEFOLD, campaigns, 2)
    rows, widths = [], []
    names = ("paired differences", "variances of levels")
    for name, equal, hard in zip(names, alike, scattered, strict=True):
        limit = float(np.quantile(equal.largest, 0.95))
        wrong = float((hard.largest > limit).mean())
        error = sqrt(0.05 * 0.95 / campaigns)
        rows.append(
            Row(
                TITLE,
                f'{name}, one level threefold: false "different", any pair',
                wrong,
                "",
                f"of {campaigns}, binomial error {error:.4f}; largest |t| beyond {limit:.2f}",
            )
        )
        widths.append(limit * float(equal.error.mean()))
        rows.append(Row(TITLE, f"{name}, scatter alike: half width of joint intervals", widths[-1], "SD"))
    rows.append(Row(TITLE, "paired intervals wider by", 100 * (widths[0] / widths[1] - 1), "%"))
    return rows
