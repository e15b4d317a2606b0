"""Levels compared within blocks, the units of a split-plot, and components of variance.

Block effects are fixed, a linear drift if there is one, intervals exact. Model of one shot: y = block + level
+ slope * time + noise, the noise normal and the same for all. Blocks are taken out by subtracting their means
(Frisch, Waugh and Lovell), so that ten thousand shots are a small problem; the estimates are those of the
full least-squares fit.

Clubs stay mounted while balls take turns, so that each question has a separate error. A *mounting* is one
club in one block, with all its hits. Its hits share the mounting's effect, so clubs are compared by their
mountings (whole plots), not by their shots. Balls alternate while a club is mounted and share its
mounting: within each club they are compared by shots and balls (sub-plots), each complete set of balls being
a block.

Repeatability (ISO 5725) is the scatter between shots of one block; intermediate precision adds what differs
between the blocks of one bench (one-way random effects). It is not reproducibility, which takes other
laboratories. Where no block has two shots, repeatability is that of successive shots (von Neumann's mean
squared successive difference), which a slow drift does not enter. Intervals: chi-square for the first,
Satterthwaite's approximation for the second.

Comparison of scatter: the ratio of two levels' standard deviations. Levels hit in the same blocks share each
block's condition. For their shots u and v in a block, u - v and u + r v are uncorrelated exactly if
var(u) = r var(v): the block effect cancels. Inverting the t test of that correlation gives the ratio an exact
interval for normal scatter (Maloney and Rastogi 1970, after Grubbs). The block effect estimated from other
levels is subtracted from both first, which only makes the interval sharper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot, inf, isfinite, sqrt
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from bench.campaign.plan.plan import CampaignPlan, Delivered
from bench.records.shot.shot import Shot, ShotStatus

Array = NDArray[np.float64]
Codes = NDArray[np.intp]


class Contrast(NamedTuple):
    """The difference of two levels."""

    estimate: float
    error: float
    """Standard error; 0 without scatter."""
    dof: float

    def interval(self, confidence: float) -> tuple[float, float]:
        """Return Student's interval."""
        half = float(special.stdtrit(self.dof, (1 + confidence) / 2)) * self.error
        return self.estimate - half, self.estimate + half

    @property
    def p(self) -> float:
        """Two-sided p value of the difference."""
        if not self.error:
            return 1.0 if not self.estimate else 0.0
        return float(2 * special.stdtr(self.dof, -abs(self.estimate) / self.error))

    def widened(self, *common: float) -> Contrast:
        """Return the contrast with systematic uncertainties `common` added (Welch and Satterthwaite)."""
        extra = hypot(*common)
        if not extra:
            return self
        error = hypot(self.error, extra)
        ratio = error / max(self.error, 1e-6 * error)
        return Contrast(self.estimate, error, min(self.dof * ratio**4, 1e9))

    def p_same(self, margin: float) -> float:
        """P value of two one-sided tests: small if the difference is reliably less than `margin`."""
        if not self.error:
            return 0.0 if abs(self.estimate) < margin else 1.0
        return float(special.stdtr(self.dof, (abs(self.estimate) - margin) / self.error))


class BlockFit(NamedTuple):
    """A fitted model."""

    effects: Array
    """Effects of levels 0, 1, ... relative to level 0, then of time, then of covariates."""
    inverse: Array
    """(X'X)^-1 of the same; level 0 is left out."""
    sd: float
    """Standard deviation of one shot."""
    dof: float
    residuals: Array
    estimable: Array
    """Projection onto the estimable effects."""
    design: Array
    """(n, columns): levels but the first, then the other fitted columns, less their blocks' means."""
    block: Codes
    """Block of each shot, from 0."""

    def contrast(self, first: int, second: int) -> Contrast | None:
        """Return level `first` less level `second`; None if no blocks connect the two."""
        weights = np.zeros(len(self.inverse))
        for level, sign in ((first, 1.0), (second, -1.0)):
            if level:
                weights[level - 1] += sign
        if self.dof < 1 or np.abs(self.estimable @ weights - weights).max(initial=0.0) > 1e-8:
            return None
        error = self.sd * sqrt(max(float(weights @ self.inverse @ weights), 0.0))
        return Contrast(float(self.effects[first] - self.effects[second]), error, self.dof)


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
    dof = float(len(y) - len(counts) - kept.sum())
    variance = float(residuals @ residuals) / dof if dof >= 1 else float("nan")
    spanned = right[kept] * scale
    projection = np.linalg.pinv(spanned) @ spanned if kept.any() else np.zeros_like(inverse)
    effects = np.concatenate([[0.0], slopes])
    sd = sqrt(variance) if variance >= 0 else float("nan")
    return BlockFit(effects, inverse, sd, dof, residuals, projection, reduced, codes)


def holm(p: Sequence[float]) -> list[float]:
    """Return probabilities adjusted by Holm's step-down: all tests together err with the level of one."""
    order = np.argsort(p)
    steps = np.asarray(p, dtype=float)[order] * np.arange(len(p), 0, -1)
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(value) for value in adjusted]


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

    With them, a club's effect is its mean over all balls, even if shots are missing.
    """
    balls, clubs = plan.design.balls, plan.design.clubs
    if not plan.split or len(balls) < 2:
        return None
    ball = np.array([balls.index(shot.ball) for shot in shots], int)
    club = np.array([clubs.index(shot.club) for shot in shots], int)
    centred = (ball[:, None] == np.arange(1, len(balls))) - 1 / len(balls)
    return np.hstack([centred * (club == code)[:, None] for code in range(len(clubs))])


def enough_mountings(level: Codes, block: Codes, levels: int) -> bool:
    """Return whether blocks and levels leave degrees of freedom for the scatter of mountings."""
    plots = np.unique(np.column_stack([level, block]), axis=0)
    return fit_blocks(np.zeros(len(plots)), plots[:, 0], plots[:, 1], levels).dof >= 1


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


@dataclass(frozen=True)
class Scatter:
    """A standard deviation with its 95 % interval; NaN with too few shots."""

    sd: float
    low: float
    high: float


@dataclass(frozen=True)
class Repeatability:
    """One figure of the delivery with one swing and club."""

    column: str
    n: int
    blocks: int
    mean: float
    within: Scatter
    successive: bool
    """Whether `within` is from successive shots, no block having two."""
    overall: Scatter
    """Intermediate precision: within and between blocks."""
    smallest: float
    largest: float


def repeatability(shots: Sequence[Shot]) -> dict[tuple[str, str], list[Repeatability]]:
    """Return the repeatability of the delivery in the valid `shots`, for each (swing, club)."""
    groups: dict[tuple[str, str], list[Shot]] = {}
    for shot in shots:
        if shot.status is ShotStatus.VALID and shot.block:
            groups.setdefault((shot.swing, shot.club), []).append(shot)
    columns = get_args(Delivered)
    return {key: [r for name in columns if (r := _figure(name, mine))] for key, mine in groups.items()}


def _figure(column: str, shots: Sequence[Shot]) -> Repeatability | None:
    found = [(getattr(shot, column), shot.block) for shot in shots if getattr(shot, column) is not None]
    if not found:
        return None
    values = np.array([value for value, _ in found], dtype=float)
    _, codes = np.unique([block for _, block in found], return_inverse=True)
    within, overall = variance_components(values, codes)
    successive = int(codes.max()) + 1 == len(values) > 2
    if successive:
        within = successive_scatter(values)
    return Repeatability(
        column,
        len(values),
        int(codes.max()) + 1,
        float(values.mean()),
        within,
        successive,
        overall,
        float(values.min()),
        float(values.max()),
    )


def variance_components(values: Array, group: Codes, confidence: float = 0.95) -> tuple[Scatter, Scatter]:
    """Return the scatter within groups (0, 1, ...) and within and between them together."""
    nan = Scatter(float("nan"), float("nan"), float("nan"))
    counts = np.bincount(group)
    n, k = len(values), len(counts)
    means = np.bincount(group, values) / counts
    inside, between = n - k, k - 1
    if k < 2 or inside < 1:
        one_each = _interval(float(values.var(ddof=1)), n - 1, confidence) if n > 1 else nan
        return (nan, one_each) if k > 1 else (one_each, one_each)
    mean_square = float(((values - means[group]) ** 2).sum()) / inside
    between_square = float((counts * (means - values.mean()) ** 2).sum()) / between
    size = (n - float((counts**2).sum()) / n) / between
    share = 1 / size
    if between_square <= mean_square:
        total, dof = mean_square, float(inside)
    else:
        total = share * between_square + (1 - share) * mean_square
        parts = (share * between_square) ** 2 / between + ((1 - share) * mean_square) ** 2 / inside
        dof = total**2 / parts
    return _interval(mean_square, inside, confidence), _interval(total, dof, confidence)


def successive_scatter(values: Array, confidence: float = 0.95) -> Scatter:
    """Return the scatter from each value to the next one (n at least 3)."""
    n = len(values)
    variance = float((np.diff(values) ** 2).sum()) / (2 * (n - 1))
    return _interval(variance, 2 * (n - 1) ** 2 / (3 * n - 4), confidence)


def _interval(variance: float, dof: float, confidence: float) -> Scatter:
    sd = sqrt(variance)
    tails = [(1 + confidence) / 2, (1 - confidence) / 2]
    low, high = sd * np.sqrt(dof / stats.chi2.ppf(tails, dof))
    return Scatter(sd, float(low), float(high))


class Spread(NamedTuple):
    """Mean and standard deviation of one shot, with intervals for untested balls; NaN with too few."""

    n: int
    """Number of shots."""
    balls: int
    """Number of balls in a split-plot of mountings; with one ball, the values hold for that ball only."""
    mean: float
    low: float
    high: float
    sd: float
    sd_low: float
    sd_high: float


def spread(values: Array, ball: Codes | None = None, confidence: float = 0.95) -> Spread:
    """Return mean and standard deviation of one shot of (n,) values, balls being random where known.

    With more than one ball the mean's interval is that of the balls' means (Student), the standard deviation
    holds scatter between and within balls (Satterthwaite); else shots count for themselves.
    """
    n, nan = len(values), float("nan")
    codes = np.zeros(n, int) if ball is None else np.unique(ball, return_inverse=True)[1]
    balls = int(codes.max()) + 1 if n else 0
    if n < 2:
        return Spread(n, balls, float(values[0]) if n else nan, nan, nan, nan, nan, nan)
    mean, (error, dof) = float(values.mean()), mean_error(values, codes)
    grouped = codes if 1 < balls < n else np.zeros(n, int)
    whole = variance_components(values, grouped, confidence)[1]
    half = float(special.stdtrit(dof, (1 + confidence) / 2)) * error
    return Spread(n, balls, mean, mean - half, mean + half, whole.sd, whole.low, whole.high)


def mean_error(values: Array, codes: Codes) -> tuple[float, float]:
    """Return standard uncertainty and degrees of freedom of the mean of n >= 2 `values` (n,) by `codes`."""
    n, balls, mean = len(values), int(codes.max()) + 1, float(values.mean())
    if 1 < balls < n:
        hits = np.bincount(codes)
        sums = np.bincount(codes, values - mean)
        # Unbiased for the mean's variance whatever each ball's hits, if balls scatter alike.
        variance, dof = float((sums**2).sum()) / n**2 * balls / (balls - 1), float(balls - 1)
        dof = min(dof, float(n**2 / (hits**2).sum()) - 1) if hits.max() > hits.min() else dof
        return sqrt(variance), max(dof, 1.0)
    return float(values.std(ddof=1)) / sqrt(n), float(n - 1)


class ScatterRatio(NamedTuple):
    """Standard deviation of one shot of `first` over that of `second`."""

    first: str
    second: str
    ratio: float
    """Infinite or 0 where the blocks hide one of the two."""
    low: float
    high: float
    p_adjusted: float
    """Holm, over all pairs."""


def scatter_ratios(
    block: Codes, values: Array, level: Codes, ball: Codes, names: Sequence[str], confidence: float
) -> tuple[ScatterRatio, ...]:
    """Return the ratios of all pairs of the first `names` levels that share at least five blocks.

    `values` (n,) are the measured ones of `block` (from 0) with time and covariates taken off; where a ball
    was hit more than once its mean is also taken off: the scatter is that from hit to hit.
    """
    count, blocks = int(level.max()) + 1, int(block.max()) + 1
    cells, lost = np.full((count, blocks), np.nan), np.zeros(count)
    for code in range(count):
        mine = level == code
        inside, fewer = _within_balls(values[mine], ball[mine])
        lost[code] = fewer / max(mine.sum(), 1)
        own = block[mine]
        hits = np.bincount(own, minlength=blocks)
        with np.errstate(invalid="ignore"):
            cells[code] = np.bincount(own, inside, minlength=blocks) / np.where(hits, hits, np.nan)
    found: list[tuple[str, str, tuple[float, float, float], float]] = []
    for first in range(len(names)):
        for second in range(first + 1, len(names)):
            both = np.isfinite(cells[first]) & np.isfinite(cells[second])
            others = np.delete(cells, [first, second], axis=0)[:, both]
            dof = both.sum() * (1 - max(lost[first], lost[second])) - 1
            if dof < 4:
                continue
            u, v = cells[first][both], cells[second][both]
            common = _common(u, v, others)
            interval = _ratio(u - common, v - common, dof, confidence)
            if interval is not None:
                *figures, p = interval
                found.append((names[first], names[second], (figures[0], figures[1], figures[2]), p))
    adjusted = holm([p for *_, p in found]) if found else []
    return tuple(
        ScatterRatio(a, b, *figures, p) for (a, b, figures, _), p in zip(found, adjusted, strict=True)
    )


def _within_balls(values: Array, ball: Codes) -> tuple[Array, float]:
    """Return values less their ball's mean, of equal variance, and the degrees of freedom this takes.

    Where most balls were hit once only, the level's mean is taken off: balls and hits scatter together.
    """
    _, own, hits = np.unique(ball, return_inverse=True, return_counts=True)
    if len(hits) == 1 or 2 * len(hits) > len(values):
        return values - values.mean(), 1.0
    means = np.bincount(own, values) / hits
    share = np.where(hits > 1, hits / np.maximum(hits - 1.0, 1.0), np.nan)
    return (values - means[own]) * np.sqrt(share)[own], float(len(hits))


def _common(u: Array, v: Array, others: Array) -> Array:
    """Return the effect of each block estimated from the `others` (levels, blocks), optimally shrunk."""
    seen = np.isfinite(others)
    count = seen.sum(axis=0)
    if not len(others) or count.min(initial=0) == 0:
        return np.zeros(len(u))
    mean = np.where(seen, others, 0.0).sum(axis=0) / count
    middle = (u + v) / 2
    spread = float(np.var(mean))
    weight = float(np.mean((mean - mean.mean()) * (middle - middle.mean()))) / spread if spread > 0 else 0.0
    return np.asarray(mean * min(max(weight, 0.0), 1.0))


def _ratio(u: Array, v: Array, dof: float, confidence: float) -> tuple[float, float, float, float] | None:
    """Return the ratio of standard deviations with its interval, and the p value of a ratio of 1."""
    (a, c), (_, b) = np.cov(u, v)
    x, y, d = a - c, c - b, a + b - 2 * c  # covariances of u - v with u and v, its variance
    if d <= 0:
        return None

    def correlation(q: float) -> float:
        return float((x + q * y) / sqrt(max(d * (a + 2 * q * c + q * q * b), 1e-300)))

    r = correlation(1.0)
    p = float(2 * special.stdtr(dof - 1, -abs(r) * sqrt((dof - 1) / max(1 - r * r, 1e-12))))
    t = float(special.stdtrit(dof - 1, (1 + confidence) / 2))
    limit = t * t / (t * t + dof - 1)
    two, one, none = y * y - limit * d * b, x * y - limit * d * c, x * x - limit * d * a
    inner = one * one - two * none
    edges = []
    if two and inner >= 0:
        edges = sorted(q for sign in (-1, 1) if (q := (-one + sign * sqrt(inner)) / two) > 0)
    inside = [q for q in (0.0, *edges, inf) if isfinite(q)]
    low = next((q for q in inside if correlation(q * (1 + 1e-6) + 1e-12) ** 2 <= limit * (1 + 1e-9)), 0.0)
    above = [q for q in edges if q > low]
    high = above[0] if above else inf
    estimate = sqrt(-x / y) if y < 0 < x else (0.0 if x <= 0 else inf)
    return estimate, sqrt(low), sqrt(high) if isfinite(high) else inf, p
