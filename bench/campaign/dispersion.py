"""Dispersion of the landing points: the ellipse that holds 95 % of a level's shots, and its area.

Carry and offline distance are taken as normal. The covariance is that of one shot of any of the level's
balls: between and within balls (MANOVA estimators), where balls were hit more than once. Its square root
determinant, and so the area, has an exact distribution for two quantities: 2 v sqrt(|S|/|C|) is chi-square
with 2 (v - 1) degrees of freedom for v of S (Anderson 2003, 7.5); with several balls v is an approximation
(Nel and van der Merwe 1986).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np
from scipy import stats

from bench.campaign.block_model import Array, Codes
from bench.campaign.plan import CampaignPlan, levels
from bench.campaign.randomization import Role
from bench.shot.shot import Shot, ShotStatus

SHARE = 0.95
"""Share of a level's shots that its ellipse holds."""
LEAST_POINTS = 4
"""Min number of landing points of an ellipse."""


@dataclass(frozen=True)
class DispersionEllipse:
    """Landing points of one level: offline (x) and carry (y), m."""

    name: str
    shots: int
    balls: int
    centre: tuple[float, float]
    covariance: tuple[float, float, float]
    """Variance of offline, covariance, variance of carry, m²."""
    freedom: float
    """Degrees of freedom of the covariance."""
    long_axis: float
    """Full length of the longer axis, m."""
    short_axis: float
    tilt: float
    """From the target line to the longer axis, positive to the right, rad in (-pi/2, pi/2]."""
    area: float
    """Unbiased, m²."""
    area_low: float
    area_high: float
    """Interval of the area at the plan's confidence."""


def dispersion_ellipses(plan: CampaignPlan, shots: Sequence[Shot]) -> tuple[DispersionEllipse, ...]:
    """Return the ellipses of a section's levels that have `LEAST_POINTS` valid landing points."""
    found = []
    for name in levels(plan):
        rows = [
            (shot.carry_side_m, shot.carry_m, shot.sample)
            for shot in shots
            if shot.role == Role.TEST
            and shot.status is ShotStatus.VALID
            and getattr(shot, plan.design.compare) == name
            and shot.carry_m is not None
            and shot.carry_side_m is not None
        ]
        if len(rows) >= LEAST_POINTS:
            values = np.array(rows, dtype=float)
            ball = np.unique(values[:, 2], return_inverse=True)[1]
            found.append(_ellipse(name, values[:, :2], ball, plan.analysis.confidence))
    return tuple(found)


def _ellipse(name: str, points: Array, ball: Codes, confidence: float) -> DispersionEllipse:
    covariance, freedom = total_covariance(points, ball)
    factor = float(stats.chi2.ppf(SHARE, 2))
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, 0.0)
    short, long = 2 * np.sqrt(factor * values)
    side, along = vectors[:, 1] * (1.0 if vectors[1, 1] >= 0 else -1.0)
    root = float(np.sqrt(values.prod()))
    # 2 v root / true root is chi-square with 2 (v - 1) degrees of freedom.
    unit, of = pi * factor * 2 * freedom * root, 2 * (freedom - 1)
    tails = [float(stats.chi2.ppf(tail, of)) for tail in ((1 + confidence) / 2, (1 - confidence) / 2)]
    return DispersionEllipse(
        name,
        len(points),
        int(ball.max()) + 1,
        (float(points[:, 0].mean()), float(points[:, 1].mean())),
        (float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
        freedom,
        float(long),
        float(short),
        float(np.arctan2(side, along)),
        unit / of,
        float(unit / tails[0]),
        float(unit / tails[1]),
    )


def total_covariance(points: Array, ball: Codes) -> tuple[Array, float]:
    """Return covariance and degrees of freedom of one shot's point, (n, 2), of any ball (codes from 0)."""
    hits = np.bincount(ball)
    n, balls = len(points), len(hits)
    plain = np.cov(points.T)
    if balls < 2 or balls == n:
        return plain, float(n - 1)
    means = np.column_stack([np.bincount(ball, column) / hits for column in points.T])
    inside, off = points - means[ball], means - points.mean(axis=0)
    within = inside.T @ inside / (n - balls)
    between = (off.T * hits) @ off / (balls - 1)
    if np.trace(between) <= np.trace(within):
        return plain, float(n - 1)
    share = (balls - 1) / (n - float((hits**2).sum()) / n)
    parts = ((share * between, balls - 1), ((1 - share) * within, n - balls))
    total = parts[0][0] + parts[1][0]

    def size(matrix: Array) -> float:
        return float(np.trace(matrix @ matrix) + np.trace(matrix) ** 2)

    freedom = size(total) / sum(size(part) / own for part, own in parts)
    return np.asarray(total), float(min(max(freedom, 2.0), n - 1))
