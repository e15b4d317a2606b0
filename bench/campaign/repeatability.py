"""Repeatability of the delivery: from shot to shot, and over the whole campaign (ISO 5725).

Repeatability is the scatter between shots of one block; intermediate precision adds what differs between the
blocks of one bench (one-way random effects). It is not reproducibility, which takes other laboratories. Where
no block has two shots, repeatability is that of successive shots (von Neumann's mean squared successive
difference), which a slow drift does not enter. Intervals: chi-square for the first, Satterthwaite's
approximation for the second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy import stats

from bench.campaign.block_model import Array, Codes
from bench.shot.shot import Shot, ShotStatus

FIGURES = (
    ("club_speed_mps", "Club speed", "m/s", 3),
    ("attack_angle_deg", "Attack angle", "°", 3),
    ("club_path_deg", "Club path", "°", 3),
    ("face_angle_deg", "Face angle", "°", 3),
    ("dynamic_loft_deg", "Dynamic loft (shaft lean)", "°", 3),
    ("strike_x_mm", "Strike, heel–toe", "mm", 2),
    ("strike_y_mm", "Strike, low–high", "mm", 2),
)
"""Column, name, unit and digits of each figure of the delivery."""


@dataclass(frozen=True)
class Scatter:
    """A standard deviation with its 95 % interval; NaN with too few shots."""

    deviation: float
    low: float
    high: float


@dataclass(frozen=True)
class Repeatability:
    """One figure of the delivery with one swing and club."""

    column: str
    name: str
    unit: str
    digits: int
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
    return {key: [r for row in FIGURES if (r := _figure(*row, mine))] for key, mine in groups.items()}


def _figure(column: str, name: str, unit: str, digits: int, shots: Sequence[Shot]) -> Repeatability | None:
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
        name,
        unit,
        digits,
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
        total, freedom = mean_square, float(inside)
    else:
        total = share * between_square + (1 - share) * mean_square
        parts = (share * between_square) ** 2 / between + ((1 - share) * mean_square) ** 2 / inside
        freedom = total**2 / parts
    return _interval(mean_square, inside, confidence), _interval(total, freedom, confidence)


def successive_scatter(values: Array, confidence: float = 0.95) -> Scatter:
    """Return the scatter from each value to the next one (n at least 3)."""
    n = len(values)
    variance = float((np.diff(values) ** 2).sum()) / (2 * (n - 1))
    return _interval(variance, 2 * (n - 1) ** 2 / (3 * n - 4), confidence)


def _interval(variance: float, freedom: float, confidence: float) -> Scatter:
    deviation = sqrt(variance)
    tails = [(1 + confidence) / 2, (1 - confidence) / 2]
    low, high = deviation * np.sqrt(freedom / stats.chi2.ppf(tails, freedom))
    return Scatter(deviation, float(low), float(high))
