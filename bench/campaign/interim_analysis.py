"""The error level of a look at a campaign before its end, so that all looks together keep the confidence.

Alpha spending (Lan and DeMets 1983) with a function like O'Brien and Fleming's: nearly nothing early, nearly
all at the end. What a look may spend follows from the share of the plan's shots that are done and from the
looks before it; neither their number nor their times need be planned.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from bench.campaign.block_model import Array
from bench.campaign.plan import CampaignPlan, levels
from bench.campaign.randomization import Role
from bench.campaign.shot_sequence import is_settled, looks_after
from bench.shot.shot import Shot

_POINTS = 201
"""Points of the grid of each look's statistic."""


class Look(NamedTuple):
    """One look at one section."""

    share: float
    """Share of the section's planned shots that are done."""
    number: int
    """From 1, looks at fewer shots counted."""
    alpha: float
    """Error level of this look, two-sided."""


def spent(alpha: float, share: float) -> float:
    """Return the error that all looks up to this share of the shots may spend together."""
    if share >= 1:
        return alpha
    return float(4 * stats.norm.sf(stats.norm.isf(alpha / 4) / sqrt(share))) if share > 0 else 0.0


@lru_cache(maxsize=4096)
def look_level(alpha: float, shares: tuple[float, ...]) -> float:
    """Return the two-sided level of the last of the looks at these increasing `shares`."""
    if len(shares) == 1:
        return spent(alpha, shares[0])
    grid, weights, before = _inside(alpha, shares[:-1])
    budget = spent(alpha, shares[-1]) - spent(alpha, shares[-2])
    error = sqrt(shares[-1] - shares[-2])
    if budget < 1e-14:
        return 0.0

    def crossing(limit: float) -> float:
        edge = limit * sqrt(shares[-1])
        beyond = stats.norm.sf((edge - grid) / error) + stats.norm.cdf((-edge - grid) / error)
        return float(weights @ (before * beyond)) - budget

    # Never more than what one look could spend, never less than its own share alone.
    least = float(stats.norm.isf(spent(alpha, shares[-1]) / 2)) - 1e-9
    most = float(stats.norm.isf(budget / 2)) + 1e-9
    if crossing(least) <= 0:
        return spent(alpha, shares[-1])
    return 2 * float(stats.norm.sf(optimize.brentq(crossing, least, most, xtol=1e-9)))


@lru_cache(maxsize=4096)
def _inside(alpha: float, shares: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """Return grid, weights and density of the score after these looks, where none has crossed its limit."""
    level = look_level(alpha, shares)
    limit = min(float(stats.norm.isf(level / 2)) if level > 0 else 9.0, 9.0) * sqrt(shares[-1])
    grid, weights = np.polynomial.legendre.leggauss(_POINTS)
    grid, weights = grid * limit, weights * limit
    if len(shares) == 1:
        return grid, weights, stats.norm.pdf(grid, scale=sqrt(shares[0]))
    old, old_weights, before = _inside(alpha, shares[:-1])
    error = sqrt(shares[-1] - shares[-2])
    moved = stats.norm.pdf(grid[:, None] - old[None, :], scale=error)
    return grid, weights, moved @ (old_weights * before)


def share_done(plan: CampaignPlan, shots: Iterable[Shot]) -> float:
    """Return the share of a section's planned shots that its `shots` have settled."""
    planned = plan.design.blocks * len(levels(plan)) * plan.shots_per_mounting
    return min(sum(s.role == Role.TEST and is_settled(plan, s) for s in shots) / planned, 1.0)


def look_now(plan: CampaignPlan, shots: Sequence[Shot], looks: Sequence[int] | None) -> Look:
    """Return the look at a section's `shots` now.

    `looks` are the numbers of shots at which results were looked at before; None: unknown, then an unfinished
    section counts as looked at after each of its blocks. The stopping rule's own looks are added.
    """
    alpha, now = 1 - plan.analysis.confidence, share_done(plan, shots)
    first = min((shot.block for shot in shots if shot.block), default=1)
    rule = {number / plan.design.blocks for number in looks_after(plan)}
    if looks is not None:
        rule |= {share_done(plan, [s for s in shots if s.shot <= count]) for count in looks}
    elif now < 1 and not rule:
        blocks = {shot.block - first + 1 for shot in shots if shot.block}
        rule = {number / plan.design.blocks for number in blocks}
    before = sorted(share for share in rule if 0 < share < now - 1e-9)
    shares = tuple(round(share, 9) for share in (*before, now))
    return Look(now, len(shares), look_level(alpha, shares) if now > 0 else 0.0)
