"""A mixed model beside the confirmatory analysis: would other balls, and other blocks, say the same?

Levels are fixed, blocks are random, and where several physical balls of a model were hit, so is the ball
within its model: then the interval holds for balls that were not hit, too. Restricted maximum likelihood by
Henderson's equations; blocks, each with a random effect of its own, are eliminated first, so that what is
left is as small as the number of levels and balls.

Not left to statsmodels: for blocks and balls at once it works with one dense matrix of all shots
(1,200 shots: 5 s instead of 0.01 s, the same result), and its standard errors are good to some thousandths
only. The tests compare both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import exp, inf, log, sqrt
from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize, stats

from bench.campaign.analysis import values_of
from bench.campaign.block_model import Array, Codes, holm
from bench.campaign.plan import CampaignPlan, levels
from bench.campaign.sequence import Role
from bench.campaign.split_plot import ball_columns
from bench.shot.shot import Shot

_LEAST, _MOST = -8.0, 18.0
"""Bounds of log(variance of a shot / variance of an effect); at the upper one the effect is zero."""

_BALLS = 300
"""Max number of balls with an effect each; with more, each is hit too seldom."""


@dataclass(frozen=True)
class MixedPair:
    """Two levels: `first` less `second`; the interval is that of this pair alone."""

    first: str
    second: str
    difference: float
    low: float
    high: float
    p_adjusted: float


@dataclass(frozen=True)
class MixedModel:
    """Result of the mixed model."""

    block_deviation: float
    ball_deviation: float | None
    """Standard deviation between balls of one model; None if each model had one ball only, or very many.
    Between mountings of one club in a split-plot."""
    deviation: float
    """Of one shot."""
    freedom: float
    """Containment: balls less levels where balls are random, mountings less levels and blocks in a
    split-plot, else what is left beside blocks and levels."""
    converged: bool
    pairs: tuple[MixedPair, ...]


class Reml(NamedTuple):
    """A fit by restricted maximum likelihood."""

    effects: Array
    covariance: Array
    variance: float
    """Variance of one observation."""
    block_variance: float
    group_variance: float
    converged: bool


def mixed_model(plan: CampaignPlan, shots: Sequence[Shot]) -> MixedModel | None:
    """Return the mixed model of one section's `shots`; None if there are too few."""
    names, factor = levels(plan), plan.design.compare
    every, values = values_of(plan, [shot for shot in shots if shot.role == Role.TEST])
    present = [name for name in names if sum(getattr(s, factor) == name for s in every) >= 2]
    chosen = [index for index, s in enumerate(every) if getattr(s, factor) in present]
    if len(present) < 2 or len(chosen) < len(present) + 4:
        return None
    kept, y = [every[index] for index in chosen], values[chosen]
    level = np.array([present.index(getattr(s, factor)) for s in kept])
    _, block = np.unique([s.block for s in kept], return_inverse=True)
    named = [(s.club, s.block) if plan.split else (s.ball, s.sample) for s in kept]
    balls = {ball: code for code, ball in enumerate(sorted(set(named)))}
    nested = factor == "ball" or plan.split
    by_ball = nested and len(present) < len(balls) <= min(_BALLS, len(kept) - 1)
    ball = np.array([balls[name] for name in named]) if by_ball else None
    fit = fit_reml(y, level, block, ball, ball_columns(plan, kept))
    freedom = float(len(balls) - len(present) if by_ball else len(kept) - len(present) - block.max())
    freedom -= float(block.max()) if plan.split else 0.0
    if freedom < 1:
        return None
    found = []
    for one, two in combinations(range(len(present)), 2):
        covariance = fit.covariance
        variance = covariance[one, one] + covariance[two, two] - 2 * covariance[one, two]
        found.append(
            (present[one], present[two], fit.effects[one] - fit.effects[two], sqrt(max(variance, 0.0)))
        )
    p = [float(2 * stats.t.sf(abs(d) / e, freedom)) if e else float(d == 0) for _, _, d, e in found]
    half = float(stats.t.ppf((1 + plan.analysis.confidence) / 2, freedom))
    return MixedModel(
        sqrt(fit.block_variance),
        sqrt(fit.group_variance) if by_ball else None,
        sqrt(fit.variance),
        freedom,
        fit.converged,
        tuple(
            MixedPair(first, second, float(d), float(d - half * e), float(d + half * e), float(adjusted))
            for (first, second, d, e), adjusted in zip(found, holm(p), strict=True)
        ),
    )


def fit_reml(
    y: Array, level: Codes, block: Codes, group: Codes | None, covariates: Array | None = None
) -> Reml:
    """Fit y (n,) with levels fixed, blocks and, if given, groups random; codes count from 0.

    `covariates` (n, m) are fixed beside the levels.
    """
    levels_ = int(level.max()) + 1
    fixed = (level[:, None] == np.arange(levels_)).astype(float)
    if covariates is not None:
        fixed = np.hstack([fixed, covariates[:, np.abs(covariates).sum(axis=0) > 0]])
    count = fixed.shape[1]
    width = 0 if group is None else int(group.max()) + 1
    random = np.zeros((len(y), 0)) if group is None else (group[:, None] == np.arange(width)).astype(float)
    design = np.hstack([fixed, random])
    blocks = np.bincount(block).astype(float)
    sums = np.zeros((len(blocks), design.shape[1]))
    np.add.at(sums, block, design)
    middle, scale = float(y.mean()), float(y.std()) or 1.0
    z = (y - middle) / scale
    problem = _Problem(
        design.T @ design,
        design.T @ z,
        sums,
        np.bincount(block, z).astype(float),
        blocks,
        float(z @ z),
        len(y),
        count,
    )

    def of_blocks(block_log: float) -> float:
        return problem.solve(0.0, block_log).criterion

    def of_both(logs: Array) -> float:
        return problem.solve(float(logs[0]), float(logs[1])).criterion

    if group is None:
        one = optimize.minimize_scalar(of_blocks, bounds=(_LEAST, _MOST), method="bounded")
        group_log, block_log, converged = 0.0, float(one.x), bool(one.success)
    else:
        both = optimize.minimize(
            of_both,
            np.array([2.0, 2.0]),
            method="Nelder-Mead",
            bounds=[(_LEAST, _MOST)] * 2,
            options={"xatol": 1e-5, "fatol": 1e-8, "maxiter": 2000},
        )
        group_log, block_log, converged = float(both.x[0]), float(both.x[1]), bool(both.success)
    best = problem.solve(group_log, block_log)
    variance = best.variance * scale**2
    return Reml(
        best.effects[:levels_] * scale + middle,
        best.inverse[:levels_, :levels_] * variance,
        variance,
        variance * exp(-block_log),
        variance * exp(-group_log) if width else 0.0,
        converged,
    )


class _Solution(NamedTuple):
    criterion: float
    """-2 log of the restricted likelihood, but for a constant."""
    effects: Array
    inverse: Array
    variance: float


class _Problem(NamedTuple):
    """Sums that Henderson's equations are made of."""

    product: Array
    right: Array
    block_sums: Array
    block_right: Array
    blocks: Array
    square: float
    n: int
    levels: int

    def solve(self, group_log: float, block_log: float) -> _Solution:
        """Solve with log variance ratios of groups and blocks."""
        width = len(self.product) - self.levels
        diagonal = self.blocks + exp(block_log)
        shared = self.block_sums / diagonal[:, None]
        ridge = np.diag(np.r_[np.zeros(self.levels), np.full(width, exp(group_log))])
        matrix = self.product + ridge - self.block_sums.T @ shared
        right = self.right - shared.T @ self.block_right
        try:
            factor = linalg.cho_factor(matrix)
        except linalg.LinAlgError:
            nothing = np.zeros(self.levels)
            return _Solution(inf, nothing, np.zeros((self.levels, self.levels)), 0.0)
        solved = linalg.cho_solve(factor, right)
        rest = self.square - float(self.block_right @ (self.block_right / diagonal)) - float(right @ solved)
        freedom = self.n - self.levels
        variance = max(rest, 1e-300) / freedom
        logs = 2 * float(np.log(np.diag(factor[0])).sum()) + float(np.log(diagonal).sum())
        criterion = freedom * log(variance) + logs - width * group_log - len(self.blocks) * block_log
        inverse = linalg.cho_solve(factor, np.eye(len(matrix)))[: self.levels, : self.levels]
        return _Solution(criterion, solved[: self.levels], inverse, variance)
