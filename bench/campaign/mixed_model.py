"""A mixed model beside the confirmatory analysis: would other balls, or other blocks, say the same?

Levels are fixed. Where several physical balls of each model were hit, the ball is a random effect within its
model, so that the interval holds for balls that were not hit, too; the blocks' effects of the confirmatory
fit are taken out first. With one ball each it cannot be told from its model, and blocks are random instead.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import sqrt

import numpy as np
import statsmodels.api as sm
from scipy import stats
from statsmodels.stats.multitest import multipletests

from bench.campaign.analysis import values_of
from bench.campaign.block_model import fit_blocks
from bench.campaign.plan import Plan, levels
from bench.campaign.sequence import Role
from bench.campaign.shot import Shot


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
    """What the mixed model says."""

    random: str
    """What is random: "ball" or "block"."""
    random_deviation: float
    deviation: float
    """Of one shot."""
    converged: bool
    pairs: tuple[MixedPair, ...]


def mixed_model(plan: Plan, shots: Sequence[Shot]) -> MixedModel | None:
    """Return the mixed model of one section's `shots`; None when there is too little for one."""
    names, factor = levels(plan), plan.design.compare
    kept, y = values_of(plan, [shot for shot in shots if shot.role == Role.TEST])
    present = [name for name in names if sum(getattr(s, factor) == name for s in kept) >= 2]
    kept_values = [(s, v) for s, v in zip(kept, y, strict=True) if getattr(s, factor) in present]
    if len(present) < 2 or len(kept_values) < len(present) + 4:
        return None
    kept, y = [s for s, _ in kept_values], np.array([v for _, v in kept_values])
    level = np.array([present.index(getattr(s, factor)) for s in kept])
    block = np.array([s.block for s in kept])
    samples = [(getattr(s, factor), s.ball, s.sample) for s in kept]
    by_ball = len(set(samples)) > len(present) and len(set(samples)) < len(kept)
    _, group = np.unique([str(sample) for sample in samples] if by_ball else block, return_inverse=True)
    if by_ball:
        y = _without_blocks(y, level, block, len(present))
    design = np.column_stack([(level == index).astype(float) for index in range(len(present))])
    scale = float(y.std()) or 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a variance at its bound of zero is no mistake
        fit = sm.MixedLM((y - y.mean()) / scale, design, group).fit(reml=True)
    covariance = np.asarray(fit.cov_params())[: len(present), : len(present)] * scale**2
    found = []
    for one, two in combinations(range(len(present)), 2):
        difference = float(fit.fe_params[one] - fit.fe_params[two]) * scale
        variance = covariance[one, one] + covariance[two, two] - 2 * covariance[one, two]
        found.append((present[one], present[two], difference, sqrt(max(float(variance), 0.0))))
    p = [float(2 * stats.norm.sf(abs(d) / e)) if e else 1.0 for _, _, d, e in found]
    adjusted = multipletests(p, method="holm")[1]
    half = float(stats.norm.ppf((1 + plan.analysis.confidence) / 2))
    return MixedModel(
        "ball" if by_ball else "block",
        scale * sqrt(max(float(np.asarray(fit.cov_re)[0, 0]), 0.0)),
        scale * sqrt(float(fit.scale)),
        bool(fit.converged),
        tuple(
            MixedPair(first, second, d, d - half * e, d + half * e, float(a))
            for (first, second, d, e), a in zip(found, adjusted, strict=True)
        ),
    )


def _without_blocks(y: np.ndarray, level: np.ndarray, block: np.ndarray, count: int) -> np.ndarray:
    """Return `y` with the blocks' effects of the fixed fit taken out."""
    fit = fit_blocks(y, level, block, count)
    adjusted: np.ndarray = fit.effects[level] + fit.residuals + y.mean()
    return adjusted
