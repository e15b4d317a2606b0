"""Levels compared within blocks: block effects fixed, a linear drift if there is one, intervals exact.

Model of one shot: y = block + level + slope * time + noise, the noise normal and the same for all. Blocks are
taken out by subtracting their means (Frisch, Waugh and Lovell), so that ten thousand shots are a small
problem; the estimates are those of the full least-squares fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

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
