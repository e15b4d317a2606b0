"""Analysis of a campaign, fixed by its plan beforehand: levels described and compared.

Confirmatory: block effects fixed (`bench.campaign.block_model`), the drift taken out by the control ball when
the plan says so; the other way stands beside it, and so does a mixed model. Holm's step-down holds the error
of all pairs of a section together; two one-sided tests (TOST), Holm-adjusted too, say "the same".
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy import stats

from bench.campaign.block_model import Array, BlockFit, Contrast, fit_blocks, holm
from bench.campaign.plan import CampaignPlan, controls_per_block, levels
from bench.campaign.power import power_of_difference, shots_for_equivalence, shots_needed
from bench.campaign.sequence import Role
from bench.shot.shot import Shot, ShotStatus

COLUMN = {"launch_angle": "launch_angle_deg", "landing_angle": "landing_angle_deg"}
"""Columns whose quantity is named without its unit."""

OUTLIER = 3.5
"""Robust z (Iglewicz and Hoaglin 1993) from which a shot is flagged; it stays in the analysis."""


class Spread(NamedTuple):
    """Mean and standard deviation of a figure, with intervals; NaN with too few shots."""

    n: int
    mean: float
    low: float
    high: float
    deviation: float
    deviation_low: float
    deviation_high: float


@dataclass(frozen=True)
class Level:
    """One level of the compared factor in one section."""

    name: str
    hit: int
    valid: int
    excluded: int
    failed: int
    reasons: dict[str, int]
    """Number of shots by reason that they are not valid."""
    spread: Spread


@dataclass(frozen=True)
class Pair:
    """Two levels compared: `first` less `second`, in the quantity's unit."""

    first: str
    second: str
    difference: float
    error: float
    freedom: float
    low: float
    high: float
    """Interval of this pair alone."""
    low_together: float
    high_together: float
    """Interval that holds together with all pairs' (Bonferroni)."""
    p: float
    p_adjusted: float
    """Holm."""
    p_same: float | None
    """TOST, Holm-adjusted; None without a margin."""
    shots: int
    """Valid shots of the level with fewer."""
    power: float
    """Power to find the difference worth finding, with the measured scatter."""
    verdict: str
    """"different", "same", "both" (different, but by less than the margin), "not enough shots" or "open"."""


@dataclass(frozen=True)
class Comparison:
    """Result of one model for one section."""

    method: str
    deviation: float
    """Standard deviation of one shot, other effects removed."""
    freedom: float
    pairs: tuple[Pair, ...]
    drift: float | None
    """Drift of the quantity per shot, from the control ball; None if it is not in the model."""
    drift_error: float | None


@dataclass(frozen=True)
class SectionAnalysis:
    """Results of one section."""

    number: int
    name: str
    levels: tuple[Level, ...]
    control: Level | None
    confirmatory: Comparison | None
    beside: Comparison | None
    """The same analysis without, or with, the drift correction."""
    outliers: tuple[tuple[int, float], ...]
    """(shot, robust z) of outliers among valid shots; never removed."""


def analyse(plan: CampaignPlan, shots: Sequence[Shot], number: int, name: str) -> SectionAnalysis:
    """Return the analysis of one section's `shots`."""
    mine = [shot for shot in shots if shot.role != Role.WARM_UP]
    tests = [shot for shot in mine if shot.role == Role.TEST]
    controls = [shot for shot in mine if shot.role == Role.CONTROL]
    names, factor = levels(plan), plan.design.compare
    raw, fit = _compared(plan, tests, [], "raw")
    corrected = None
    if controls_per_block(plan):
        corrected, corrected_fit = _compared(plan, tests, controls, "drift removed by the control ball")
        fit = corrected_fit or fit
    first, second = (corrected, raw) if plan.analysis.drift == "linear" and corrected else (raw, corrected)
    return SectionAnalysis(
        number,
        name,
        tuple(_level(plan, level, [s for s in tests if getattr(s, factor) == level]) for level in names),
        _level(plan, f"{plan.control.ball} (control)", controls) if controls else None,
        first,
        second,
        _outliers(fit),
    )


def values_of(plan: CampaignPlan, shots: Sequence[Shot]) -> tuple[list[Shot], Array]:
    """Return the valid shots that have the plan's quantity, and its values."""
    column = COLUMN.get(plan.analysis.quantity, plan.analysis.quantity)
    kept = [shot for shot in shots if shot.status is ShotStatus.VALID and getattr(shot, column) is not None]
    return kept, np.array([getattr(shot, column) for shot in kept], dtype=float)


def alpha_of(plan: CampaignPlan) -> float:
    """Return the error level of one look at the data."""
    looks = plan.stop.looks if plan.stop.rule != "fixed" else 1
    return (1 - plan.analysis.confidence) / looks


class _Fit(NamedTuple):
    fit: BlockFit
    shots: list[Shot]


def _compared(
    plan: CampaignPlan, tests: Sequence[Shot], controls: Sequence[Shot], method: str
) -> tuple[Comparison | None, _Fit | None]:
    """Return all pairs by one model; with `controls` they are a level of their own, and time is in it."""
    names = levels(plan)
    kept, y = values_of(plan, [*tests, *controls])
    if len(kept) < 3:
        return None, None
    index = {name: code for code, name in enumerate(names)}
    level = np.array(
        [len(names) if s.role == Role.CONTROL else index[getattr(s, plan.design.compare)] for s in kept]
    )
    block, time = np.array([s.block for s in kept]), np.array([s.shot for s in kept], dtype=float)
    fit = fit_blocks(y, level, block, len(names) + bool(controls), time if controls else None)
    pairs = []
    present = {int(code) for code in level}
    for one, two in combinations(range(len(names)), 2):
        contrast = fit.contrast(one, two) if {one, two} <= present else None
        if contrast is not None:
            fewer = min(int((level == one).sum()), int((level == two).sum()))
            pairs.append((names[one], names[two], contrast, fewer))
    slope = slope_error = None
    if controls and fit.freedom >= 1:
        slope = float(fit.effects[-1])
        slope_error = fit.deviation * sqrt(max(float(fit.inverse[-1, -1]), 0.0))
    judged = _judged(plan, pairs, fit) if pairs else ()
    if not judged and len(names) > 1:
        return None, _Fit(fit, kept)
    return Comparison(method, fit.deviation, fit.freedom, judged, slope, slope_error), _Fit(fit, kept)


def shots_still_needed(plan: CampaignPlan, comparison: Comparison) -> tuple[int | None, int | None]:
    """Return how many valid shots of each level would suffice, with the measured scatter.

    The first finds the difference worth finding, the second calls equal levels the same; each with the wished
    power. None: too many to name, or not asked.
    """
    a, count, controls = plan.analysis, len(levels(plan)), controls_per_block(plan)
    single = alpha_of(plan) / max(len(comparison.pairs), 1)
    deviation = comparison.deviation
    same = shots_for_equivalence(a.margin, deviation, single, a.power, count, controls) if a.margin else None
    return shots_needed(a.difference, deviation, single, a.power, count, controls), same


def _judged(
    plan: CampaignPlan, pairs: Sequence[tuple[str, str, Contrast, int]], fit: BlockFit
) -> tuple[Pair, ...]:
    """Adjust all pairs together and put each into one word."""
    a, alpha, count = plan.analysis, alpha_of(plan), len(pairs)
    contrasts = [contrast for _, _, contrast, _ in pairs]
    adjusted = holm([c.p for c in contrasts])
    same: Sequence[float | None] = [None] * count
    if a.margin:
        same = list[float | None](holm([c.p_same(a.margin) for c in contrasts]))
    single = alpha / count
    found = []
    for (first, second, _, shots), contrast, p, equal in zip(pairs, contrasts, adjusted, same, strict=True):
        power = _power(a.difference, contrast, fit, single)
        found.append(
            Pair(
                first,
                second,
                contrast.estimate,
                contrast.error,
                contrast.freedom,
                *contrast.interval(1 - alpha),
                *contrast.interval(1 - single),
                contrast.p,
                p,
                equal,
                shots,
                power,
                _verdict(p < alpha, equal is not None and equal < alpha, power >= a.power, bool(a.margin)),
            )
        )
    return tuple(found)


def _power(difference: float, contrast: Contrast, fit: BlockFit, alpha: float) -> float:
    if not contrast.error:
        return 1.0
    blocks = 2 * (fit.deviation / contrast.error) ** 2  # number of complete blocks with the same information
    return power_of_difference(difference, fit.deviation, blocks, contrast.freedom, alpha)


def _verdict(different: bool, same: bool, enough: bool, asked_same: bool) -> str:
    if different:
        return "both" if same else "different"
    if same:
        return "same"
    return "open" if enough and not asked_same else "not enough shots"


def spread(values: Array, confidence: float = 0.95) -> Spread:
    """Return mean and standard deviation with Student's and the chi-square interval."""
    n, nan = len(values), float("nan")
    if n < 2:
        return Spread(n, float(values[0]) if n else nan, nan, nan, nan, nan, nan)
    mean, deviation, freedom = float(values.mean()), float(values.std(ddof=1)), n - 1
    half = float(stats.t.ppf((1 + confidence) / 2, freedom)) * deviation / sqrt(n)
    tails = [(1 + confidence) / 2, (1 - confidence) / 2]
    low, high = deviation * np.sqrt(freedom / stats.chi2.ppf(tails, freedom))
    return Spread(n, mean, mean - half, mean + half, deviation, float(low), float(high))


def _level(plan: CampaignPlan, name: str, shots: Sequence[Shot]) -> Level:
    by = Counter(shot.status for shot in shots)
    reasons = Counter(_kind(shot.reason) for shot in shots if shot.reason)
    _, values = values_of(plan, shots)
    return Level(
        name,
        by[ShotStatus.VALID] + by[ShotStatus.EXCLUDED],
        by[ShotStatus.VALID],
        by[ShotStatus.EXCLUDED],
        by[ShotStatus.FAILED],
        dict(reasons.most_common()),
        spread(values, plan.analysis.confidence),
    )


def _kind(reason: str) -> str:
    """Return a reason without its figures, so that like ones are counted together."""
    head = reason.split(";", maxsplit=1)[0]
    for mark in (", outside", " not measured"):
        if mark in head:
            words = head.split(mark)[0].split()
            return " ".join(w for w in words if not any(c.isdigit() for c in w)).rstrip(" m/s°") + " outside"
    return head


def _outliers(fit: _Fit | None) -> tuple[tuple[int, float], ...]:
    """Flag residuals by Iglewicz and Hoaglin's robust z."""
    if fit is None or len(fit.shots) < 5:
        return ()
    residuals = fit.fit.residuals
    off = residuals - np.median(residuals)
    scale = 1.4826 * float(np.median(np.abs(off)))
    if not scale:
        return ()
    z = off / scale
    return tuple((fit.shots[i].shot, float(z[i])) for i in np.flatnonzero(np.abs(z) > OUTLIER))


def decide(plan: CampaignPlan, shots: Sequence[Shot]) -> str:
    """Return why a section's `shots` are enough by the plan's stopping rule; empty if they are not."""
    result = analyse(plan, shots, 1, "").confirmatory
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
