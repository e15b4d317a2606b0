"""Power, resolution and number of shots of a campaign, before and after it.

All for two levels in randomised complete blocks: the variance of a difference of means over b blocks is
2 s^2 / b, estimated with `freedom` degrees of freedom. Deviation and difference have one unit.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

import numpy as np
from scipy import optimize, special, stats

_MOST = 1_000_000
"""Max number of blocks that is searched."""


def block_freedom(levels: int, blocks: float, controls: int = 0, drift: bool = False) -> float:
    """Return the residual degrees of freedom of blocks with one shot a level and `controls` more each."""
    shots = levels + controls
    parameters = levels - 1 + (1 if controls else 0) + (1 if drift else 0)
    return blocks * (shots - 1) - parameters


def power_of_difference(
    difference: float, deviation: float, blocks: float, freedom: float, alpha: float
) -> float:
    """Return the chance to find a true `difference`, two-sided at `alpha` (noncentral t, exact)."""
    if freedom <= 0:
        return 0.0
    return power_of_shift(difference / (deviation * sqrt(2 / blocks)), freedom, alpha)


def power_of_shift(shift: float, freedom: float, alpha: float) -> float:
    """Return the chance to find a difference of `shift` true standard errors, two-sided at `alpha`."""
    if alpha <= 0 or freedom <= 0:
        return 0.0
    shift = abs(shift)
    limit = -special.stdtrit(freedom, alpha / 2)
    # Beyond that the other tail is nothing, and scipy's noncentral t loses its footing.
    lower = special.nctdtr(freedom, shift, -limit) if shift < 5 else 0.0
    return float(1 - special.nctdtr(freedom, shift, limit) + lower)


def power_of_equivalence(
    margin: float, deviation: float, blocks: float, freedom: float, alpha: float, difference: float = 0.0
) -> float:
    """Return the chance that two one-sided tests at `alpha` call a true `difference` less than `margin`.

    Exact: the normal probability of the estimate, averaged over the distribution of the deviation seen.
    """
    return same_power_of_error(margin, deviation * sqrt(2 / blocks), freedom, alpha, difference)


def same_power_of_error(
    margin: float, error: float, freedom: float, alpha: float, difference: float = 0.0
) -> float:
    """Return the same for a difference whose true standard error is `error`."""
    if freedom <= 0 or margin <= 0 or alpha <= 0:
        return 0.0
    if error <= 0:
        return float(abs(difference) < margin)
    steps = (np.arange(500) + 0.5) / 500
    seen = np.sqrt(2 * special.gammaincinv(freedom / 2, steps) / freedom)
    half = margin + special.stdtrit(freedom, alpha) * error * seen
    inside = special.ndtr((half - difference) / error) - special.ndtr((-half - difference) / error)
    return float(np.where(half > 0, inside, 0.0).mean())


def resolution(deviation: float, blocks: float, freedom: float, alpha: float, power: float) -> float:
    """Return the smallest difference that is found with probability `power`; infinite without freedom."""
    if freedom <= 0:
        return float("inf")

    def lacking(difference: float) -> float:
        return power_of_difference(difference, deviation, blocks, freedom, alpha) - power

    error = deviation * sqrt(2 / blocks)
    high = error * (stats.t.ppf(1 - alpha / 2, freedom) + stats.t.ppf(power, freedom) + 5)
    return float(optimize.brentq(lacking, 0.0, high, xtol=1e-9 * high))


def blocks_needed(chance: Callable[[int], float], power: float, at_least: int = 2) -> int | None:
    """Return the min number of blocks whose `chance` reaches `power`; None if no feasible number does."""
    high = max(at_least, 2)
    while chance(high) < power:
        high *= 2
        if high > _MOST:
            return None
    low = max(at_least, high // 2)
    while low < high:
        middle = (low + high) // 2
        if chance(middle) < power:
            low = middle + 1
        else:
            high = middle
    return high
