"""Do two balls differ? Welch's t, the number of shots it takes, and the answer in words."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from math import ceil, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

CONFIDENCE = 0.95
POWER = 0.80


class Difference(NamedTuple):
    """Mean of `first` minus mean of `second`, with its confidence interval; units of the samples."""

    first: str
    second: str
    mean: float
    low: float
    high: float
    shots_first: int
    shots_second: int
    deviation: float
    """Standard deviation of a single shot, pooled."""

    @property
    def resolved(self) -> bool:
        """The interval excludes zero: the data tell the two apart."""
        return self.low > 0 or self.high < 0


def compare(samples: Mapping[str, ArrayLike], confidence: float = CONFIDENCE) -> list[Difference]:
    """Return every pair's difference; the intervals hold together with `confidence` (Bonferroni).

    Groups of fewer than two values are left out: they have no scatter to judge by.
    """
    arrays = {name: np.asarray(values, dtype=float) for name, values in samples.items()}
    groups = {name: values for name, values in arrays.items() if len(values) >= 2}
    pairs = list(combinations(groups, 2))
    single = 1 - (1 - confidence) / max(len(pairs), 1)
    return [_welch(one, groups[one], two, groups[two], single) for one, two in pairs]


def _welch(one: str, a: np.ndarray, two: str, b: np.ndarray, confidence: float) -> Difference:
    """Welch's interval: unequal variances, Satterthwaite's degrees of freedom."""
    mean = float(a.mean() - b.mean())
    share_a, share_b = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    half = 0.0
    if share_a + share_b > 0:
        freedom = (share_a + share_b) ** 2 / (share_a**2 / (len(a) - 1) + share_b**2 / (len(b) - 1))
        half = float(stats.t.ppf((1 + confidence) / 2, freedom) * sqrt(share_a + share_b))
    squares = a.var(ddof=1) * (len(a) - 1) + b.var(ddof=1) * (len(b) - 1)
    deviation = sqrt(squares / (len(a) + len(b) - 2))
    return Difference(one, two, mean, mean - half, mean + half, len(a), len(b), deviation)


def shots_needed(
    deviation: float, difference: float, confidence: float = CONFIDENCE, power: float = POWER
) -> int:
    """Return how many shots of each of two balls resolve a true `difference` with probability `power`.

    `deviation` is the standard deviation of one shot, same unit. Two-sided, with Student's t in place of
    the normal quantiles, so that small numbers are not flattered. At least 2; raises ValueError unless
    difference is positive.
    """
    if not difference > 0:
        raise ValueError(f"difference is {difference}, expected more than 0")
    levels = np.array([(1 + confidence) / 2, power])
    scale = 2 * (deviation / difference) ** 2
    shots: int = max(2, ceil(scale * stats.norm.ppf(levels).sum() ** 2))
    while shots < scale * stats.t.ppf(levels, 2 * shots - 2).sum() ** 2:
        shots += 1  # a few times only: t lies just above the normal quantiles
    return shots


class Verdict(NamedTuple):
    """The answer to one comparison, in words."""

    resolved: bool
    headline: str
    detail: str


def verdict(difference: Difference, quantity: str, unit: str, wished: float) -> Verdict:
    """Put `difference` of a `quantity` (in `unit`) into words; `wished` is the difference worth finding."""
    d = difference
    shots = f"{d.shots_first} and {d.shots_second} valid shots"
    if d.deviation <= 1e-9 * max(1.0, abs(d.mean)):
        return Verdict(
            True,
            f"{d.first} and {d.second} differ by {abs(d.mean):.2f} {unit} in {quantity}, without scatter.",
            f"All shots of one ball are alike ({shots}): a simulation without noise. Its figure is exact for "
            "its model and says nothing about scatter on a real bench.",
        )
    interval = f"95 % confidence interval {_number(d.low)} to {_number(d.high)} {unit}, {shots}"
    if d.resolved:
        ahead, behind = (d.first, d.second) if d.mean > 0 else (d.second, d.first)
        return Verdict(
            True,
            f"{ahead} has {abs(d.mean):.1f} {unit} more {quantity} than {behind}.",
            f"Difference {d.first} − {d.second}: {_number(d.mean)} {unit} ({interval}); "
            f"scatter of a single shot {d.deviation:.2f} {unit} (SD).",
        )
    needed = shots_needed(d.deviation, wished)
    if needed > min(d.shots_first, d.shots_second):
        outlook = (
            f"With this scatter (SD of one shot {d.deviation:.2f} {unit}) about {needed} shots a ball are "
            f"needed to resolve {wished:g} {unit}."
        )
        headline = f"Not enough shots to tell {d.first} and {d.second} apart in {quantity}."
    else:
        outlook = f"A difference of {wished:g} {unit} would very probably have been seen."
        headline = f"No difference between {d.first} and {d.second} in {quantity} was found."
    return Verdict(False, headline, f"Difference seen: {_number(d.mean)} {unit} ({interval}). {outlook}")


def _number(value: float) -> str:
    """Write a signed figure with a real minus sign."""
    return f"{value:+.1f}".replace("-", "−")
