"""Power and number of blocks of a comparison, by a difference's standard error and its degrees of freedom."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import special

_MOST = 1_000_000
"""Max number of blocks that is searched."""


def power_of_shift(shift: float, freedom: float, alpha: float) -> float:
    """Return the chance to find a difference of `shift` true standard errors, two-sided at `alpha`."""
    if alpha <= 0 or freedom <= 0:
        return 0.0
    shift = abs(shift)
    limit = -special.stdtrit(freedom, alpha / 2)
    # Beyond that the other tail is nothing, and scipy's noncentral t loses its footing.
    lower = special.nctdtr(freedom, shift, -limit) if shift < 5 else 0.0
    return float(1 - special.nctdtr(freedom, shift, limit) + lower)


def same_power_of_error(
    margin: float, error: float, freedom: float, alpha: float, difference: float = 0.0
) -> float:
    """Return the chance that two one-sided tests at `alpha` call a true `difference` less than `margin`.

    `error` is the difference's true standard error. Exact: the normal probability of the estimate, averaged
    over the distribution of the deviation seen.
    """
    if freedom <= 0 or margin <= 0 or alpha <= 0:
        return 0.0
    if error <= 0:
        return float(abs(difference) < margin)
    steps = (np.arange(500) + 0.5) / 500
    seen = np.sqrt(2 * special.gammaincinv(freedom / 2, steps) / freedom)
    half = margin + special.stdtrit(freedom, alpha) * error * seen
    inside = special.ndtr((half - difference) / error) - special.ndtr((-half - difference) / error)
    return float(np.where(half > 0, inside, 0.0).mean())


def blocks_needed(chance: Callable[[int], float], power: float) -> int | None:
    """Return the min number of blocks whose `chance` reaches `power`; None if no feasible number does."""
    high = 2
    while chance(high) < power:
        high *= 2
        if high > _MOST:
            return None
    low = max(2, high // 2)
    while low < high:
        middle = (low + high) // 2
        if chance(middle) < power:
            low = middle + 1
        else:
            high = middle
    return high
