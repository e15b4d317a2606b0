"""Levels compared within blocks, and the units of a split-plot.

Levels compared within blocks: block effects fixed, a linear drift if there is one, intervals exact. Model of
one shot: y = block + level + slope * time + noise, the noise normal and the same for all. Blocks are taken
out by subtracting their means (Frisch, Waugh and Lovell), so that ten thousand shots are a small problem; the
estimates are those of the full least-squares fit.

Split-plots: clubs stay mounted while balls take turns, so that each question has an error of its own. A
*mounting* is one club in one block, with all its hits. What a mounting does to a club, its hits share: clubs
are compared by their mountings (whole plots), not by their shots. Balls alternate while a club is mounted and
share its mounting: within each club they are compared by shots and balls (sub-plots), each complete set of
balls being a block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from bench.campaign.plan import CampaignPlan
from bench.shot.shot import Shot

Array = NDArray[np.float64]
Codes = NDArray[np.intp]


class Contrast(NamedTuple):
    """The difference of two levels."""

    estimate: float
    error: float
    """Standard error; 0 without scatter."""
    freedom: float

    def interval(self, confidence: float) -> tuple[float, float]:
        """Return Student's interval."""
        half = float(special.stdtrit(self.freedom, (1 + confidence) / 2)) * self.error
        return self.estimate - half, self.estimate + half

    @property
    def p(self) -> float:
        """Two-sided p value of the difference."""
        if not self.error:
            return 1.0 if not self.estimate else 0.0
        return float(2 * special.stdtr(self.freedom, -abs(self.estimate) / self.error))

    def widened(self, *common: float) -> Contrast:
        """Return it with standard uncertainties that more shots do not reduce (Welch and Satterthwaite)."""
        extra = hypot(*common)
        if not extra:
            return self
        error = hypot(self.error, extra)
        ratio = error / max(self.error, 1e-6 * error)
        return Contrast(self.estimate, error, min(self.freedom * ratio**4, 1e9))

    def p_same(self, margin: float) -> float:
        """P value of two one-sided tests: small if the difference is reliably less than `margin`."""
        if not self.error:
            return 0.0 if abs(self.estimate) < margin else 1.0
        return float(special.stdtr(self.freedom, (abs(self.estimate) - margin) / self.error))


class BlockFit(NamedTuple):
    """A fitted model."""

    effects: Array
    """Effects of levels 0, 1, ... relative to level 0, then of time, then of covariates."""
    inverse: Array
    """(X'X)^-1 of the same; level 0 is left out."""
    deviation: float
    """Of one shot."""
    freedom: float
    residuals: Array
    estimable: Array
    """Projection onto what can be estimated."""
    design: Array
    """(n, columns): levels but the first, then what else was fitted, less their blocks' means."""
    block: Codes
    """Block of each shot, from 0."""

    def contrast(self, first: int, second: int) -> Contrast | None:
        """Return level `first` less level `second`; None if no blocks connect the two."""
        weights = np.zeros(len(self.inverse))
        for level, sign in ((first, 1.0), (second, -1.0)):
            if level:
                weights[level - 1] += sign
        if self.freedom < 1 or np.abs(self.estimable @ weights - weights).max(initial=0.0) > 1e-8:
            return None
        error = self.deviation * sqrt(max(float(weights @ self.inverse @ weights), 0.0))
        return Contrast(float(self.effects[first] - self.effects[second]), error, self.freedom)


def fit_blocks(
    y: Array,
    level: Codes,
    block: Codes,
    levels: int,
    time: Array | None = None,
    covariates: Array | None = None,
) -> BlockFit:
    """Fit y (n,) on `level` (0 ... levels - 1), `block` (any codes), `time` (n,) and `covariates` (n, m)."""
    columns = [(level == index).astype(float) for index in range(1, levels)]
    if time is not None:
        columns.append(np.asarray(time, dtype=float))
    if covariates is not None:
        columns += list(np.asarray(covariates, dtype=float).T)
    design = np.column_stack(columns) if columns else np.zeros((len(y), 0))
    _, codes = np.unique(block, return_inverse=True)
    counts = np.bincount(codes)

    def within(values: Array) -> Array:
        return values - (np.bincount(codes, values) / counts)[codes]

    response = within(np.asarray(y, dtype=float))
    reduced = np.column_stack([within(column) for column in design.T]) if columns else design
    # The same unit for all columns, so that the rank does not hang on that of time.
    scale = np.sqrt((reduced**2).sum(axis=0))
    scale[scale == 0] = 1.0
    _, singular, right = np.linalg.svd(reduced / scale, full_matrices=False)
    kept = singular > 1e-10 * max(len(y), 1)
    basis = right[kept] / scale
    inverse = (basis.T / singular[kept] ** 2) @ basis
    slopes = inverse @ (reduced.T @ response)
    residuals = response - reduced @ slopes
    freedom = float(len(y) - len(counts) - kept.sum())
    variance = float(residuals @ residuals) / freedom if freedom >= 1 else float("nan")
    spanned = right[kept] * scale
    projection = np.linalg.pinv(spanned) @ spanned if kept.any() else np.zeros_like(inverse)
    effects = np.concatenate([[0.0], slopes])
    deviation = sqrt(variance) if variance >= 0 else float("nan")
    return BlockFit(effects, inverse, deviation, freedom, residuals, projection, reduced, codes)


def holm(p: Sequence[float]) -> list[float]:
    """Return probabilities adjusted by Holm's step-down: all tests together err with the level of one."""
    order = np.argsort(p)
    steps = np.asarray(p, dtype=float)[order] * np.arange(len(p), 0, -1)
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(value) for value in adjusted]


_OWN_SCATTER = 10
"""Mountings of each club from which on each club's scatter is estimated for itself."""


def within_club(plan: CampaignPlan, club: str) -> CampaignPlan:
    """Return the plan of the comparison of balls within `club`, of a split-plot."""
    d = plan.design
    design = replace(
        d, compare="ball", clubs=(club,), blocks=d.blocks * d.hits_per_mounting, hits_per_mounting=0
    )
    analysis = replace(plan.analysis, reference="")
    return replace(plan, design=design, stop=replace(plan.stop, rule="fixed"), analysis=analysis)


def shots_within(plan: CampaignPlan, club: str, shots: Sequence[Shot]) -> list[Shot]:
    """Return the shots with `club`, each complete set of balls as a block."""
    mine = [shot for shot in shots if shot.club == club]
    return [replace(shot, block=code) for shot, code in zip(mine, set_codes(plan, mine), strict=True)]


def set_codes(plan: CampaignPlan, shots: Sequence[Shot]) -> list[int]:
    """Return the number, from 1, of the complete set of balls that each shot with its club belongs to."""
    hits, balls = plan.design.hits_per_mounting, len(plan.design.balls)
    return [(shot.block - 1) * hits + (shot.position - 1) // balls % hits + 1 for shot in shots]


def independent_codes(plan: CampaignPlan, shots: Sequence[Shot]) -> Codes:
    """Return which shots of a level belong together: those of a ball, or of a mounting in a split-plot."""
    return np.array([shot.block if plan.split else shot.sample for shot in shots], int)


def ball_columns(plan: CampaignPlan, shots: Sequence[Shot]) -> Array | None:
    """Return columns (n, m) that take the balls out of a comparison of clubs; None if there is one ball.

    A club's effect beside them is its mean over all balls, missing shots or not.
    """
    balls, clubs = plan.design.balls, plan.design.clubs
    if not plan.split or len(balls) < 2:
        return None
    ball = np.array([balls.index(shot.ball) for shot in shots], int)
    club = np.array([clubs.index(shot.club) for shot in shots], int)
    centred = (ball[:, None] == np.arange(1, len(balls))) - 1 / len(balls)
    return np.hstack([centred * (club == code)[:, None] for code in range(len(clubs))])


def enough_mountings(level: Codes, block: Codes, levels: int) -> bool:
    """Return whether mountings leave degrees of freedom for their own scatter beside blocks and levels."""
    plots = np.unique(np.column_stack([level, block]), axis=0)
    return fit_blocks(np.zeros(len(plots)), plots[:, 0], plots[:, 1], levels).freedom >= 1


def are_pooled(mountings: Codes) -> bool:
    """Return whether all clubs' mountings are taken to scatter alike; else each club's for itself."""
    return int(mountings.min()) < _OWN_SCATTER


def fully_randomised(plan: CampaignPlan) -> CampaignPlan:
    """Return the plan with as many shots whose clubs change from shot to shot."""
    d = plan.design
    blocks = d.blocks * max(d.hits_per_mounting, 1)
    return replace(plan, design=replace(d, blocks=blocks, hits_per_mounting=0))


def as_split_plot(plan: CampaignPlan) -> CampaignPlan | None:
    """Return the plan with as many shots and fewer club changes; None without a layout worth naming.

    The fewest mountings that leave four degrees of freedom for their scatter.
    """
    d = plan.design
    if d.compare != "club" or plan.split or plan.control.ball or plan.stop.rule != "fixed":
        return None
    for blocks in range(2, d.blocks // 2 + 1):
        if d.blocks % blocks == 0 and (blocks - 1) * (len(d.clubs) - 1) >= 4:
            return replace(plan, design=replace(d, blocks=blocks, hits_per_mounting=d.blocks // blocks))
    return None
