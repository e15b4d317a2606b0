"""Dispersion of the landing points, and control chart of the control ball.

Dispersion: the ellipse that holds 95 % of a level's shots, and its area. Carry and offline distance are taken
as normal. The covariance is that of one shot of any of the level's balls: between and within balls (MANOVA
estimators), where balls were hit more than once. Its square root determinant, and so the area, has an exact
distribution for two quantities: 2 v sqrt(|S|/|C|) is chi-square with 2 (v - 1) degrees of freedom for v of S
(Anderson 2003, 7.5); with several balls v is an approximation (Nel and van der Merwe 1986).

Control chart: individual values in order, judged by Nelson's eight rules. The limits come from the moving
range of the same series (Shewhart's chart for individuals, ISO 7870-2), so that a slow drift does not widen
them. The control ball is the same throughout: a signal is of the robot, the monitor or the air, never of the
compared balls.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import Role, tests_by_level
from bench.campaign.statistics.block_model import Array, Codes
from bench.records.shot.shot import Shot, ShotStatus

SHARE = 0.95
"""Share of a level's shots that its ellipse holds."""
MIN_POINTS = 4
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
    dof: float
    """Degrees of freedom of the covariance."""
    long_axis: float
    """Full length of the longer axis, m."""
    short_axis: float
    tilt: float
    """Angle from the target line to the longer axis, positive to the right, in (-pi/2, pi/2] (rad)."""
    area: float
    """Unbiased, m²."""
    area_low: float
    area_high: float
    """Interval of the area at the plan's confidence."""


def dispersion_ellipses(plan: CampaignPlan, shots: Sequence[Shot]) -> tuple[DispersionEllipse, ...]:
    """Return the ellipses of a section's levels that have `MIN_POINTS` valid landing points."""
    found = []
    valid = (shot for shot in shots if shot.status is ShotStatus.VALID)
    for name, mine in tests_by_level(plan, valid).items():
        every = ((shot.carry_side_m, shot.carry_m, shot.sample) for shot in mine)
        rows = [row for row in every if None not in row]
        if len(rows) >= MIN_POINTS:
            values = np.array(rows, dtype=float)
            ball = np.unique(values[:, 2], return_inverse=True)[1]
            found.append(_ellipse(name, values[:, :2], ball, plan.analysis.confidence))
    return tuple(found)


def _ellipse(name: str, points: Array, ball: Codes, confidence: float) -> DispersionEllipse:
    covariance, dof = total_covariance(points, ball)
    factor = float(stats.chi2.ppf(SHARE, 2))
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, 0.0)
    short, long = 2 * np.sqrt(factor * values)
    side, along = vectors[:, 1] * (1.0 if vectors[1, 1] >= 0 else -1.0)
    root = float(np.sqrt(values.prod()))
    # 2 v root / true root is chi-square with 2 (v - 1) degrees of freedom.
    unit, of = pi * factor * 2 * dof * root, 2 * (dof - 1)
    tails = [float(stats.chi2.ppf(tail, of)) for tail in ((1 + confidence) / 2, (1 - confidence) / 2)]
    return DispersionEllipse(
        name,
        len(points),
        int(ball.max()) + 1,
        (float(points[:, 0].mean()), float(points[:, 1].mean())),
        (float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
        dof,
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

    dof = size(total) / sum(size(part) / own for part, own in parts)
    return np.asarray(total), float(min(max(dof, 2.0), n - 1))


_MEAN_RANGE = 1.128379167
"""Mean range of two normal values over their standard deviation."""
MIN_VALUES = 8
"""Min number of values for limits."""

NELSON: Mapping[int, str] = {
    1: "one value beyond three standard deviations",
    2: "nine in a row on one side of the mean",
    3: "six in a row rising, or falling",
    4: "fourteen in a row up and down in turn",
    5: "two of three beyond two standard deviations on one side",
    6: "four of five beyond one standard deviation on one side",
    7: "fifteen in a row within one standard deviation",
    8: "eight in a row beyond one standard deviation, on both sides",
}
"""The rules, by number (Nelson 1984)."""


@dataclass(frozen=True)
class ControlChart:
    """The control ball in one quantity."""

    column: str
    shots: tuple[int, ...]
    values: tuple[float, ...]
    centre: float
    sd: float
    """Standard deviation by the moving range."""
    signals: Mapping[int, tuple[int, ...]]
    """Last shot of each pattern, by the number of its rule."""


def control_charts(plan: CampaignPlan, shots: Sequence[Shot]) -> tuple[ControlChart, ...]:
    """Return a section's charts: the compared quantity, and the ball speed, to which the machine is set.

    Empty without a control ball, or with fewer than `MIN_VALUES` of its values.
    """
    controls = [shot for shot in shots if shot.role == Role.CONTROL and shot.status is ShotStatus.VALID]
    charts = (_chart(name, controls) for name in dict.fromkeys((plan.column, "ball_speed_mps")))
    return tuple(chart for chart in charts if chart is not None)


def _chart(column: str, controls: Sequence[Shot]) -> ControlChart | None:
    measured = [(shot.shot, value) for shot in controls if (value := getattr(shot, column)) is not None]
    if len(measured) < MIN_VALUES:
        return None
    values = np.array([value for _, value in measured], dtype=float)
    centre, sd = float(values.mean()), float(np.abs(np.diff(values)).mean()) / _MEAN_RANGE
    found = nelson_signals((values - centre) / sd) if sd > 0 else {}
    shots = tuple(shot for shot, _ in measured)
    signals = {rule: tuple(shots[place] for place in places) for rule, places in found.items()}
    return ControlChart(column, shots, tuple(map(float, values)), centre, sd, signals)


def nelson_signals(z: Array) -> dict[int, list[int]]:
    """Return the places in `z` (n,), in standard deviations from the mean, that end each rule's pattern."""
    up, steps = z > 0, np.sign(np.diff(z))
    turns = np.concatenate([[False], steps[1:] * steps[:-1] < 0])
    found: dict[int, NDArray[np.bool_]] = {
        1: np.abs(z) > 3,
        2: _either(z, lambda side: _run(side > 0, 9)),
        3: _after_steps(steps > 0, 5) | _after_steps(steps < 0, 5),
        4: _after_steps(turns, 12),
        5: _either(z, lambda side: _of(side > 2, 2, 3)),
        6: _either(z, lambda side: _of(side > 1, 4, 5)),
        7: _run(np.abs(z) < 1, 15),
        8: _run(np.abs(z) > 1, 8) & ~_run(up, 8) & ~_run(~up, 8),
    }
    return {
        rule: places for rule, hits in found.items() if (places := [int(p) for p in np.flatnonzero(hits)])
    }


def _either(z: Array, rule: Callable[[Array], NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Return where `rule` holds on the upper or on the lower side."""
    return rule(z) | rule(-z)


def _of(hits: NDArray[np.bool_], wanted: int, window: int) -> NDArray[np.bool_]:
    """Return where a hit is the last of `wanted` among `window` values."""
    total = np.concatenate([np.zeros(window, int), np.cumsum(hits)])
    return np.asarray(hits & (total[window:] - total[:-window] >= wanted))


def _run(hits: NDArray[np.bool_], length: int) -> NDArray[np.bool_]:
    """Return where `length` hits in a row end."""
    return _of(hits, length, length)


def _after_steps(hits: NDArray[np.bool_], length: int) -> NDArray[np.bool_]:
    """Return the values after `length` hits in a row among the steps between values."""
    return np.concatenate([[False], _run(hits, length)])
