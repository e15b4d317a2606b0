"""Power, sample size and interim analyses of a comparison.

Each interim analysis has a significance level with which all together keep the confidence. Alpha spending
(Lan and DeMets 1983) uses a function like O'Brien and Fleming's: nearly nothing early, nearly all at the end.
The level follows from the share of the plan's shots that are done and from the earlier analyses; neither
their number nor their times need be planned.

Power, resolution and size of a test series are predicted by the model that evaluates it. The plan's order
of shots and its turns of balls give each difference its error and degrees of freedom
(`bench.campaign.statistics._unequal_variances`); other sizes are scaled from there. A series is balls and
shots: many hits of one ball do not replace balls of its model.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import cache, lru_cache
from itertools import combinations
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy import optimize, special, stats

from bench.campaign.plan.plan import CampaignPlan, levels
from bench.campaign.plan.shot_sequence import Role, block_trials, is_settled, looks_after, sections
from bench.campaign.statistics._unequal_variances import (
    Draws,
    UnitLayout,
    are_pooled,
    drawn_pairs,
    together,
    units_of,
)
from bench.campaign.statistics.block_model import Array, Codes, enough_mountings, fit_blocks
from bench.records.shot.shot import Shot

_MAX_BLOCKS = 1_000_000
"""Max number of blocks that is searched."""


def power_of_shift(shift: float, dof: float, alpha: float) -> float:
    """Return the power for a difference of `shift` true standard errors, two-sided at `alpha`."""
    if alpha <= 0 or dof <= 0:
        return 0.0
    shift = abs(shift)
    limit = -special.stdtrit(dof, alpha / 2)
    # Beyond that the other tail is nothing, and scipy's noncentral t loses its footing.
    lower = special.nctdtr(dof, shift, -limit) if shift < 5 else 0.0
    return float(1 - special.nctdtr(dof, shift, limit) + lower)


def same_power_of_error(
    margin: float, error: float, dof: float, alpha: float, difference: float = 0.0
) -> float:
    """Return the power of two one-sided tests at `alpha` to show that a true `difference` is below `margin`.

    `error` is the difference's true standard error. Exact: the normal probability of the estimate, averaged
    over the distribution of the observed standard deviation.
    """
    if dof <= 0 or margin <= 0 or alpha <= 0:
        return 0.0
    if error <= 0:
        return float(abs(difference) < margin)
    steps = (np.arange(500) + 0.5) / 500
    seen = np.sqrt(2 * special.gammaincinv(dof / 2, steps) / dof)
    half = margin + special.stdtrit(dof, alpha) * error * seen
    inside = special.ndtr((half - difference) / error) - special.ndtr((-half - difference) / error)
    return float(np.where(half > 0, inside, 0.0).mean())


def blocks_needed(chance: Callable[[int], float], power: float) -> int | None:
    """Return the min number of blocks whose `chance` reaches `power`; None if no feasible number does."""
    high = 2
    while chance(high) < power:
        high *= 2
        if high > _MAX_BLOCKS:
            return None
    return bisect_left(range(high), power, lo=max(2, high // 2), key=chance)


_POINTS = 201
"""Points of the grid of each look's statistic."""


class Look(NamedTuple):
    """One look at one section."""

    share: float
    """Share of the section's planned shots that are done."""
    number: int
    """Number of the look, from 1, looks at fewer shots counted."""
    alpha: float
    """Two-sided significance level of this interim analysis."""


def spent(alpha: float, share: float) -> float:
    """Return the error that all analyses up to this share of the shots may spend together."""
    if share >= 1:
        return alpha
    return float(4 * stats.norm.sf(stats.norm.isf(alpha / 4) / sqrt(share))) if share > 0 else 0.0


@lru_cache(maxsize=4096)
def look_level(alpha: float, shares: tuple[float, ...]) -> float:
    """Return the two-sided level of the last interim analysis at the increasing plan fractions `shares`."""
    if len(shares) == 1:
        return spent(alpha, shares[0])
    grid, weights, before = _inside(alpha, shares[:-1])
    budget = spent(alpha, shares[-1]) - spent(alpha, shares[-2])
    error = sqrt(shares[-1] - shares[-2])
    if budget < 1e-14:
        return 0.0

    def crossing(limit: float) -> float:
        edge = limit * sqrt(shares[-1])
        beyond = stats.norm.sf((edge - grid) / error) + stats.norm.cdf((-edge - grid) / error)
        return float(weights @ (before * beyond)) - budget

    # Never more than what one look could spend, never less than its own share alone.
    least = float(stats.norm.isf(spent(alpha, shares[-1]) / 2)) - 1e-9
    most = float(stats.norm.isf(budget / 2)) + 1e-9
    if crossing(least) <= 0:
        return spent(alpha, shares[-1])
    return 2 * float(stats.norm.sf(optimize.brentq(crossing, least, most, xtol=1e-9)))


@lru_cache(maxsize=4096)
def _inside(alpha: float, shares: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """Return grid, weights and density of the score after these looks, where none has crossed its limit."""
    level = look_level(alpha, shares)
    limit = min(float(stats.norm.isf(level / 2)) if level > 0 else 9.0, 9.0) * sqrt(shares[-1])
    grid, weights = np.polynomial.legendre.leggauss(_POINTS)
    grid, weights = grid * limit, weights * limit
    if len(shares) == 1:
        return grid, weights, stats.norm.pdf(grid, scale=sqrt(shares[0]))
    old, old_weights, before = _inside(alpha, shares[:-1])
    error = sqrt(shares[-1] - shares[-2])
    moved = stats.norm.pdf(grid[:, None] - old[None, :], scale=error)
    return grid, weights, moved @ (old_weights * before)


def share_done(plan: CampaignPlan, shots: Iterable[Shot]) -> float:
    """Return the share of a section's planned shots that its `shots` have settled."""
    planned = plan.design.blocks * len(levels(plan)) * plan.shots_per_mounting
    return min(sum(s.role == Role.TEST and is_settled(plan, s) for s in shots) / planned, 1.0)


def look_now(plan: CampaignPlan, shots: Sequence[Shot], looks: Sequence[int] | None) -> Look:
    """Return the look at a section's `shots` now.

    `looks` are the numbers of shots at which results were looked at before; None: unknown, then an unfinished
    section counts as looked at after each of its blocks. The stopping rule's own looks are added.
    """
    alpha, now = 1 - plan.analysis.confidence, share_done(plan, shots)
    first = min((shot.block for shot in shots if shot.block), default=1)
    rule = {number / plan.design.blocks for number in looks_after(plan)}
    if looks is not None:
        rule |= {share_done(plan, [s for s in shots if s.shot <= count]) for count in looks}
    elif now < 1 and not rule:
        blocks = {shot.block - first + 1 for shot in shots if shot.block}
        rule = {number / plan.design.blocks for number in blocks}
    before = sorted(share for share in rule if 0 < share < now - 1e-9)
    shares = tuple(round(share, 9) for share in (*before, now))
    return Look(now, len(shares), look_level(alpha, shares) if now > 0 else 0.0)


_REFERENCE = 40
"""Max number of blocks laid out as planned; larger series are scaled from there."""


class SeriesSize(NamedTuple):
    """Size of a series for each level."""

    balls: int
    """Different balls, or mountings of a club in a split-plot; 0 where the level is neither."""
    shots: int
    """Valid shots in all."""


class PredictedPrecision(NamedTuple):
    """Predicted precision of a plan's differences, if all its shots are valid."""

    error: float
    """Standard error of a difference, mean over the pairs."""
    dof: float
    single: float
    """Significance level of one pair."""
    pairs: int
    draws: Draws
    sd: float
    ball_sd: float
    """Between balls, or mountings in a split-plot."""
    units: int
    """Balls, mountings, or shots where they count for themselves, of each level."""
    shots: int
    """Shots of each level."""

    def power(self, difference: float) -> float:
        """Return the power for a true `difference` of one pair."""
        return power_of_shift(difference / self.error, self.dof, self.single)

    def resolution(self, power: float) -> float:
        """Return the smallest difference that is found with probability `power`."""
        high = self.error * (stats.t.isf(self.single / 2, self.dof) + stats.t.ppf(power, self.dof) + 8)
        return float(optimize.brentq(lambda d: self.power(d) - power, 0.0, high, xtol=1e-9 * high))

    def same(self, margin: float, alpha: float) -> float:
        """Return the chance that a pair of truly equal levels is called the same, Holm over all pairs."""
        if self.pairs < 2:
            return same_power_of_error(margin, self.error, self.dof, alpha)
        differences, variances, dof = self.draws
        p = np.sort(stats.t.sf((margin - np.abs(differences)) / np.sqrt(variances), dof), axis=1)
        steps = np.maximum.accumulate(p * np.arange(self.pairs, 0, -1), axis=1)
        return float((steps < alpha).mean())


def predict_precision(
    plan: CampaignPlan, sd: float, ball_sd: float, blocks: int = 0
) -> PredictedPrecision | None:
    """Return the predicted precision of a section of `plan`; None with one level.

    `sd` is the standard deviation of one shot, after covariates; `ball_sd` is that between balls, or between
    mountings in a split-plot.
    """
    count, controls = len(levels(plan)), bool(plan.control.ball)
    if count < 2 or sd <= 0:
        return None
    blocks = blocks or plan.design.blocks
    level, block, ball = _planned(plan, blocks)
    if count * blocks < 3:
        return None
    time = np.arange(len(level), dtype=float) if controls and plan.analysis.drift == "linear" else None
    if time is None and controls:  # the control ball is in no other term then
        kept = level < count
        level, block, ball = level[kept], block[kept], ball[kept]
        controls = False
    delivery = None
    if plan.analysis.covariates:  # which values they take changes next to nothing
        delivery = np.random.default_rng(1).normal(size=(len(level), len(plan.analysis.covariates)))
    levels_ = count + controls
    fit = fit_blocks(np.zeros(len(level)), level, block, levels_, time, delivery)
    if fit.dof < 1 or (plan.split and not enough_mountings(level, block, levels_)):
        return None
    units = units_of(level, ball, levels_)
    errors = UnitLayout(fit, units, pooled=are_pooled(units, split=plan.split)).foreseen(
        np.full(levels_, sd**2), (ball_sd / sd) ** 2
    )
    pairs = list(combinations(range(count), 2))
    each = np.array([errors.of_pair(*pair) for pair in pairs])
    joint = together(errors, pairs, fit.dof)
    own = int((units.level == 0).sum())
    return PredictedPrecision(
        float(np.sqrt((each[:, 0] ** 2).mean())),
        float(min(1 / (1 / each[:, 1]).mean(), fit.dof)),
        joint.single(alpha_at_end(plan)),
        len(pairs),
        drawn_pairs(errors, pairs, fit.dof),
        sd,
        ball_sd if units.balls[0] > 1 and (plan.split or plan.design.compare == "ball") else 0.0,
        own,
        blocks * plan.shots_per_mounting,
    )


def alpha_at_end(plan: CampaignPlan) -> float:
    """Return the significance level of the last analysis, after the interim analyses of the plan's rule."""
    shares = sorted(round(number / plan.design.blocks, 9) for number in looks_after(plan))
    return look_level(1 - plan.analysis.confidence, (*(share for share in shares if share < 1), 1.0))


def series_needed(
    plan: CampaignPlan, sd: float, ball_sd: float
) -> tuple[SeriesSize | None, SeriesSize | None]:
    """Return the series that finds the difference worth finding, and that calls equal levels the same.

    Each with the wished power, by the plan's balls if they may be hit often enough, else by more balls. None:
    too many to name, or not asked.
    """
    a = plan.analysis
    if sd <= 0:
        return SeriesSize(2, 2), SeriesSize(2, 2) if a.equivalence_margin else None
    known = predict_precision(plan, sd, ball_sd, _REFERENCE)
    if known is None:
        return None, None
    alpha = alpha_at_end(plan)
    balls = plan.ball_handling.samples if plan.design.compare == "ball" else 1

    @cache
    def foreseen(shots: int, units: int) -> tuple[float, float, float] | None:
        """Return standard error, degrees of freedom and level of a pair, as planned or scaled from there."""
        if plan.split or shots > _REFERENCE or units != (min(shots, balls) if balls > 1 else shots):
            return *_scaled(known, shots, units), known.single
        laid_out = predict_precision(plan, sd, ball_sd, shots)
        return laid_out and (laid_out.error, laid_out.dof, laid_out.single)

    def found(shots: int, units: int) -> float:
        if (precision := foreseen(shots, units)) is None:
            return 0.0
        error, dof, single = precision
        return power_of_shift(a.target_difference / error, dof, single)

    def same(shots: int, units: int) -> float:
        if (precision := foreseen(shots, units)) is None:
            return 0.0
        error, dof, _ = precision
        return same_power_of_error(a.equivalence_margin, error, dof, alpha / known.pairs)

    return _series(plan, found), _series(plan, same) if a.equivalence_margin else None


def _series(plan: CampaignPlan, chance: Callable[[int, int], float]) -> SeriesSize | None:
    """Return the smallest series whose `chance` by shots and units has the plan's power; None: too large."""
    power = plan.analysis.power
    if plan.split:
        hits = plan.shots_per_mounting
        mountings = blocks_needed(lambda n: chance(n * hits, n), power)
        return None if mountings is None else SeriesSize(mountings, mountings * hits)
    balls = plan.ball_handling.samples if plan.design.compare == "ball" else 0
    limit = balls * plan.ball_handling.hits if balls else _MAX_BLOCKS
    shots = blocks_needed(lambda n: chance(n, min(n, balls) if balls > 1 else n), power)
    if shots is not None and shots <= limit:
        return SeriesSize(min(shots, balls), shots)
    hits = max(1, round(plan.design.blocks / balls)) if balls else 1
    more = blocks_needed(lambda n: chance(n * hits, n), power) if balls > 1 else None
    return None if more is None else SeriesSize(more, more * hits)


def _scaled(known: PredictedPrecision, shots: int, units: int) -> tuple[float, float]:
    between = known.ball_sd**2

    def plain(n: int, balls: int) -> float:
        return 2 * (between / balls + known.sd**2 / n)

    # Degrees of freedom are nearly proportional to the units less one.
    reference = known.shots
    error = known.error * sqrt(plain(shots, units) / plain(reference, known.units))
    return error, max(known.dof / max(known.units - 1, 1) * (units - 1), 1e-3)


def balls_of_each(plan: CampaignPlan) -> int:
    """Return the fewest different balls that a level's planned shots hit; controls also turn the balls."""
    level, _, ball = _planned(plan, plan.design.blocks)
    return min(len(np.unique(ball[level == each])) for each in range(len(levels(plan))))


def _planned(plan: CampaignPlan, blocks: int) -> tuple[Codes, Codes, Codes]:
    """Return level, block and ball of each shot of the first section's first `blocks`, in order."""
    section, names = sections(plan)[0], levels(plan)
    code = {name: index for index, name in enumerate(names)}
    hits: Counter[str] = Counter()
    rows: list[tuple[int, int, int]] = []
    for number in range(1, blocks + 1):
        for trial in block_trials(plan, section, number):
            arm = trial.arm
            level = len(names) if trial.role is Role.CONTROL else code[getattr(arm, plan.design.compare)]
            ball = hits[arm.ball] % plan.ball_handling.samples
            hits[arm.ball] += 1
            unit = number if plan.split else ball if plan.design.compare == "ball" else len(rows)
            rows.append((level, number, unit))
    level, block, ball = np.array(rows, dtype=np.intp).T
    return level, block, ball
