"""Analysis of a campaign, fixed by its plan beforehand: levels described and compared.

Confirmatory: block effects are fixed (`bench.campaign.statistics.block_model`). The control ball corrects
drift if the plan demands it; covariates of the plan adjust for the delivery. Balls are random where a model
had more than one, and each level has its own variance, or all share one if most have fewer than three balls
or shots (`bench.campaign.statistics._unequal_variances`): a statement on a difference holds for balls that
were not hit, or for "this ball" where there was one only. All pairs of a section err together with the plan's
level (the distribution of the largest |t|, single step: a pair differs exactly if its joint interval leaves
out 0); two one-sided tests (TOST), adjusted by Holm, say "the same". Before the plan's end an interim
analysis spends its share of the error rate (`bench.campaign.statistics.sample_size`). In a split-plot the
unit for clubs is the mounting and, within each club, for balls the shot
(`bench.campaign.statistics.block_model`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import sqrt
from typing import NamedTuple

import numpy as np

from bench.campaign.plan.gate import OUTSIDE
from bench.campaign.plan.plan import CampaignPlan, levels
from bench.campaign.plan.shot_sequence import Role, looks_after, tests_by_level
from bench.campaign.statistics._unequal_variances import (
    JointErrors,
    UnitErrors,
    UnitLayout,
    are_pooled,
    common_errors,
    together,
    units_of,
)
from bench.campaign.statistics.block_model import (
    Array,
    BlockFit,
    Codes,
    Contrast,
    ScatterRatio,
    Spread,
    ball_columns,
    enough_mountings,
    fit_blocks,
    holm,
    independent_codes,
    scatter_ratios,
    set_codes,
    shots_within,
    spread,
    within_club,
)
from bench.campaign.statistics.sample_size import Look, look_now, power_of_shift, same_power_of_error
from bench.records.shot.shot import Shot, ShotStatus

OUTLIER = 3.5
"""Robust z (Iglewicz and Hoaglin 1993) from which a shot is flagged; it stays in the analysis."""


@dataclass(frozen=True)
class Level:
    """One level of the compared factor in one section."""

    name: str
    hit: int
    valid: int
    excluded: int
    failed: int
    reasons: dict[str, int]
    """Number of invalid shots by reason."""
    spread: Spread


@dataclass(frozen=True)
class Pair:
    """Two levels compared: `first` less `second`, in the quantity's unit."""

    first: str
    second: str
    difference: float
    error: float
    dof: float
    low: float
    high: float
    """Interval of this pair alone, at the comparison's `confidence`."""
    low_together: float
    high_together: float
    """Interval that holds together with all pairs'; without 0 exactly if they are called different."""
    p: float
    p_adjusted: float
    """p value adjusted for all pairs."""
    p_same: float | None
    """TOST, Holm-adjusted; None without a margin."""
    shots: int
    """Valid shots of the level with fewer."""
    balls: int
    """Balls of the level with fewer; mountings in a split-plot; 0 where neither is known."""
    models: bool
    """Whether the comparison holds for the models; otherwise for these specimens only: one ball, or clubs."""
    power: float
    """Power to find the difference worth finding, with the measured scatter."""
    verdict: str
    """"different", "same", "both" (different, but by less than the margin), "not enough shots" or "open"."""

    def reversed(self) -> Pair:
        """Return it as `second` less `first`."""
        return replace(
            self,
            first=self.second,
            second=self.first,
            difference=-self.difference,
            low=-self.high,
            high=-self.low,
            low_together=-self.high_together,
            high_together=-self.low_together,
        )


class Covariates(NamedTuple):
    """Effect of the plan's covariates, the delivery of the club."""

    names: tuple[str, ...]
    slopes: tuple[float, ...]
    """Effect of one unit of each."""
    share: float
    """Fraction of the variance within blocks that the covariates explain."""
    missing: int
    """Valid shots left out because a covariate was not measured."""


@dataclass(frozen=True)
class Comparison:
    """Result of one model for one section."""

    method: str
    confidence: float
    """True level of each pair's interval: that of this look."""
    sd: float
    """Standard deviation of one shot, other effects and that between balls removed."""
    ball_sd: float | None
    """Between balls of one model, the levels' mean; None if no ball was hit twice. In a split-plot: between
    mountings of one club."""
    dof: float
    """Degrees of freedom of the residuals; each pair has its own."""
    single: float
    """Significance level of one pair."""
    pairs: tuple[Pair, ...]
    drift: float | None
    """Drift of the quantity per shot, from the control ball; None if it is not in the model."""
    drift_error: float | None
    covariates: Covariates | None
    scatter: tuple[ScatterRatio, ...]
    """Ratios of the levels' standard deviations."""
    pooled: bool
    """Whether all levels are taken to scatter alike."""


@dataclass(frozen=True)
class SectionAnalysis:
    """Results of one section."""

    number: int
    name: str
    levels: tuple[Level, ...]
    control: Level | None
    confirmatory: Comparison | None
    look: Look
    """Completed part of the plan, and the significance level of this analysis."""
    values: tuple[float, ...]
    """Valid values of a section's only level, in order; empty where levels are compared."""
    outliers: tuple[tuple[int, float], ...]
    """(shot, robust z) of outliers among valid shots; never removed."""
    within: tuple[SectionAnalysis, ...] = ()
    """Comparisons of balls within each club of a split-plot, by the club's name."""


def analyse(
    plan: CampaignPlan, shots: Sequence[Shot], number: int, name: str, looks: Sequence[int] | None = None
) -> SectionAnalysis:
    """Return the analysis of one section's `shots`; `looks` as `look_now` takes them."""
    return _analysed(plan, shots, number, name, look_now(plan, shots, looks))


def _analysed(
    plan: CampaignPlan, shots: Sequence[Shot], number: int, name: str, look: Look
) -> SectionAnalysis:
    tests = [shot for shot in shots if shot.role == Role.TEST]
    controls = [shot for shot in shots if shot.role == Role.CONTROL]
    confirmatory, fit = None, None
    if plan.control.ball and plan.analysis.drift == "linear":
        method = "drift removed by the control ball"
        confirmatory, fit = _compared(plan, tests, controls, method, look.alpha)
    if confirmatory is None:
        method = "mountings of a club random" if plan.split else "raw"
        confirmatory, without = _compared(plan, tests, [], method, look.alpha)
        fit = fit or without
    return SectionAnalysis(
        number,
        name,
        tuple(_level(plan, *each) for each in tests_by_level(plan, tests).items()),
        _level(plan, f"{plan.control.ball} (control)", controls) if controls else None,
        confirmatory,
        look,
        tuple(map(float, values_of(plan, tests)[1])) if len(levels(plan)) < 2 else (),
        _outliers(fit),
        _within(plan, tests, number, look),
    )


def _within(
    plan: CampaignPlan, tests: Sequence[Shot], number: int, look: Look
) -> tuple[SectionAnalysis, ...]:
    """Return the balls compared within each club of a split-plot."""
    if not plan.split or len(plan.design.balls) < 2:
        return ()
    return tuple(
        _analysed(within_club(plan, club), shots_within(plan, club, tests), number, club, look)
        for club in plan.design.clubs
    )


def values_of(plan: CampaignPlan, shots: Sequence[Shot]) -> tuple[list[Shot], Array]:
    """Return the valid shots that have the plan's quantity, and its values."""
    column = plan.column
    kept = [shot for shot in shots if shot.status is ShotStatus.VALID and getattr(shot, column) is not None]
    return kept, np.array([getattr(shot, column) for shot in kept], dtype=float)


_Fit = tuple[BlockFit, list[Shot]]
"""A fitted model, and its shots."""


class _Data(NamedTuple):
    shots: list[Shot]
    y: Array
    level: Codes
    block: Codes
    ball: Codes
    time: Array | None
    delivery: Array | None
    """(n, covariates)"""
    beside: Array | None
    """Columns (n, m) of factors whose effects are removed: the balls of a split-plot."""
    missing: int

    def fit(self, levels: int) -> BlockFit:
        """Fit all of it."""
        columns = [each for each in (self.beside, self.delivery) if each is not None]
        more = np.hstack(columns) if columns else None
        return fit_blocks(self.y, self.level, self.block, levels, self.time, more)


def _data(plan: CampaignPlan, tests: Sequence[Shot], controls: Sequence[Shot]) -> _Data:
    names, wanted = levels(plan), plan.analysis.covariates
    every, values = values_of(plan, [*tests, *controls])
    delivered = [[getattr(s, name) for name in wanted] for s in every]
    chosen = [index for index, row in enumerate(delivered) if None not in row]
    kept = [every[index] for index in chosen]
    index = {name: code for code, name in enumerate(names)}
    factor = plan.design.compare
    level = np.array([len(names) if s.role == Role.CONTROL else index[getattr(s, factor)] for s in kept], int)
    # The compared balls, and mountings, are nested in their levels. Else clubs and swings share balls in an
    # order drawn by lot, which spreads them like shots.
    nested = factor == "ball" or plan.split
    ball = independent_codes(plan, kept) if nested else np.arange(len(kept))
    return _Data(
        kept,
        values[chosen],
        level,
        np.array([s.block for s in kept], int),
        ball,
        np.array([s.shot for s in kept], dtype=float) if controls else None,
        np.array([delivered[index] for index in chosen], dtype=float) if wanted else None,
        ball_columns(plan, kept),
        len(every) - len(kept),
    )


def _compared(
    plan: CampaignPlan, tests: Sequence[Shot], controls: Sequence[Shot], method: str, alpha: float
) -> tuple[Comparison | None, _Fit | None]:
    """Return all pairs by one model; any `controls` are a separate level, and time is in the model."""
    names, data = levels(plan), _data(plan, tests, controls)
    if len(data.shots) < 3:
        return None, None
    count = len(names) + bool(controls)
    fit = data.fit(count)
    kept = fit, data.shots
    units = units_of(data.level, data.ball, count)
    if fit.dof < 1 or (plan.split and not enough_mountings(data.level, data.block, count)):
        return None, kept
    errors = UnitLayout(fit, units, pooled=are_pooled(units, split=plan.split)).estimate(fit.residuals)
    hits = np.bincount(data.level, minlength=count)
    found, common = [], common_errors(plan, data.shots)
    for one, two in combinations(range(len(names)), 2):
        enough = min(hits[one], hits[two]) if not plan.split else min(units.balls[[one, two]]) - 1
        contrast = errors.contrast(fit, one, two) if enough > 0 else None
        if contrast is not None:
            found.append((one, two, contrast.widened(*(common.get(names[n], 0.0) for n in (one, two)))))
    if not found and len(names) > 1:
        return None, kept
    joint = together(errors, [(one, two) for one, two, _ in found], fit.dof)
    slope = slope_error = None
    if controls:
        slope = float(fit.effects[count])
        slope_error = fit.sd * sqrt(max(float(fit.inverse[count - 1, count - 1]), 0.0))
    sd, between = _sds(errors, units.balls, hits, fit, len(names))
    return (
        Comparison(
            method,
            1 - alpha,
            sd,
            between,
            fit.dof,
            joint.single(alpha),
            _judged(plan, found, joint, alpha, hits, units.balls),
            slope,
            slope_error,
            _explained(plan, data, fit, count),
            _scatter(plan, data, fit, names),
            errors.pooled,
        ),
        kept,
    )


def _sds(
    errors: UnitErrors, balls: Codes, hits: Codes, fit: BlockFit, count: int
) -> tuple[float, float | None]:
    """Return the standard deviations of one shot and between balls, means of the compared levels."""
    again = balls[:count] < hits[:count]
    if not (again & (balls[:count] > 1)).any():
        return fit.sd, None
    if not errors.ratio:  # balls' sums that scatter less than their hits by chance say little of one shot
        return fit.sd, 0.0
    variance = float(np.average(errors.variances[:count], weights=np.maximum(hits[:count], 1e-9)))
    return sqrt(max(variance, 0.0)), sqrt(max(variance * errors.ratio, 0.0))


def _explained(plan: CampaignPlan, data: _Data, fit: BlockFit, count: int) -> Covariates | None:
    if data.delivery is None:
        return None
    without = fit_blocks(data.y, data.level, data.block, count, data.time)
    share = 1 - (fit.sd / without.sd) ** 2 if without.sd else 0.0
    slopes = fit.effects[len(fit.effects) - len(plan.analysis.covariates) :]
    return Covariates(plan.analysis.covariates, tuple(map(float, slopes)), max(share, 0.0), data.missing)


def _scatter(
    plan: CampaignPlan, data: _Data, fit: BlockFit, names: Sequence[str]
) -> tuple[ScatterRatio, ...]:
    """Return the ratios of all levels' scatter, what time and delivery explain taken off."""
    if len(names) < 2:
        return ()
    explained = [column for column in (data.time, data.beside, data.delivery) if column is not None]
    values, block = data.y, fit.block
    if explained:
        columns = np.column_stack(explained)
        values = values - columns @ fit.effects[len(fit.effects) - columns.shape[1] :]
    if plan.split:  # shots at the same place in two mountings of a block
        block = np.unique(set_codes(plan, data.shots), return_inverse=True)[1]
    return scatter_ratios(block, values, data.level, data.ball, names, plan.analysis.confidence)


def _judged(
    plan: CampaignPlan,
    found: Sequence[tuple[int, int, Contrast]],
    joint: JointErrors,
    alpha: float,
    hits: Codes,
    balls: Codes,
) -> tuple[Pair, ...]:
    """Adjust all pairs together and put each into one word; `hits` and `balls` are those of each level."""
    a, single, names = plan.analysis, joint.single(alpha), levels(plan)
    same: Sequence[float | None] = [None] * len(found)
    if a.equivalence_margin:
        same = list[float | None](holm([c.p_same(a.equivalence_margin) for _, _, c in found]))
    pairs = []
    for (one, two, c), equal in zip(found, same, strict=True):
        adjusted = joint.adjusted(c.p)
        power = power_of_shift(a.target_difference / c.error, c.dof, single) if c.error else 1.0
        enough = power >= a.power and (
            not a.equivalence_margin
            or same_power_of_error(a.equivalence_margin, c.error, c.dof, alpha / len(found)) >= a.power
        )
        models = plan.design.compare == "ball"
        fewest = int(min(balls[one], balls[two])) if models or plan.split else 0
        pairs.append(
            Pair(
                names[one],
                names[two],
                c.estimate,
                c.error,
                c.dof,
                *c.interval(1 - alpha),
                *c.interval(1 - single),
                c.p,
                adjusted,
                equal,
                int(min(hits[one], hits[two])),
                fewest,
                models and fewest > 1,
                power,
                _verdict(adjusted < alpha, equal is not None and equal < alpha, enough),
            )
        )
    return tuple(pairs)


def _verdict(different: bool, same: bool, enough: bool) -> str:
    if different:
        return "both" if same else "different"
    if same:
        return "same"
    return "open" if enough else "not enough shots"


def _level(plan: CampaignPlan, name: str, shots: Sequence[Shot]) -> Level:
    by = Counter(shot.status for shot in shots)
    reasons = Counter(OUTSIDE.get(shot.gate_figure, shot.reason) for shot in shots if shot.reason)
    kept, values = values_of(plan, shots)
    return Level(
        name,
        by[ShotStatus.VALID] + by[ShotStatus.EXCLUDED],
        by[ShotStatus.VALID],
        by[ShotStatus.EXCLUDED],
        by[ShotStatus.FAILED],
        dict(reasons.most_common()),
        spread(values, independent_codes(plan, kept), plan.analysis.confidence),
    )


def _outliers(fit: _Fit | None) -> tuple[tuple[int, float], ...]:
    """Flag residuals by Iglewicz and Hoaglin's robust z."""
    if fit is None or len(fit[1]) < 5:
        return ()
    residuals, shots = fit[0].residuals, fit[1]
    off = residuals - np.median(residuals)
    scale = 1.4826 * float(np.median(np.abs(off)))
    if not scale:
        return ()
    z = off / scale
    return tuple((shots[i].shot, float(z[i])) for i in np.flatnonzero(np.abs(z) > OUTLIER))


def interim_analysis(plan: CampaignPlan, shots: Sequence[Shot]) -> tuple[int, Comparison] | None:
    """Return a section's comparison at the latest look of the plan's stopping rule, and after which block.

    It costs nothing: the rule has looked at the same `shots`. None before its first look, or without a rule.
    """
    blocks = [shot.block for shot in shots if shot.block]
    # The rule looks before the next block begins.
    looks = [number for number in looks_after(plan) if blocks and number <= max(blocks) - min(blocks)]
    if not looks:
        return None
    number = max(looks)
    taken = [shot for shot in shots if shot.block - min(blocks) < number]
    found = analyse(plan, taken, 1, "", ()).confirmatory
    return None if found is None else (number, found)


def decide(plan: CampaignPlan, shots: Sequence[Shot]) -> str:
    """Return why a section's `shots` are enough by the plan's stopping rule; empty if they are not."""
    result = analyse(plan, shots, 1, "", ()).confirmatory
    count = len(levels(plan))
    if result is None or len(result.pairs) < count * (count - 1) // 2:
        return ""
    if plan.stop.rule == "width":
        widest = max((pair.high - pair.low) / 2 for pair in result.pairs)
        return f"half widths of all intervals are at most {widest:.3g}" if widest <= plan.stop.width else ""
    if plan.stop.rule == "equivalence" and all(
        p.verdict in {"same", "both", "different"} for p in result.pairs
    ):
        words = Counter(pair.verdict for pair in result.pairs)
        return "decided: " + ", ".join(f"{number} {word}" for word, number in words.items())
    return ""
