"""Split-plots: clubs stay mounted while balls take turns, so that each question has an error of its own.

A *mounting* is one club in one block, with all its hits. What a mounting does to a club, its hits share:
clubs are compared by their mountings (whole plots), not by their shots. Balls alternate while a club is
mounted and share its mounting: within each club they are compared by shots and balls (sub-plots), each
complete set of balls being a block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bench.campaign.block_model import Array, Codes, fit_blocks
from bench.campaign.plan import CampaignPlan
from bench.shot.shot import Shot

_OWN_SCATTER = 10
"""Mountings of each club from which on each club's scatter is estimated for itself."""


def within_club(plan: CampaignPlan, club: str) -> CampaignPlan:
    """Return the plan of the comparison of balls within `club`, of a split-plot."""
    d = plan.design
    design = replace(
        d, compare="ball", clubs=(club,), blocks=d.blocks * d.hits_per_mounting, hits_per_mounting=0
    )
    analysis = replace(plan.analysis, reference="")
    return replace(plan, design=design, stop=replace(plan.stop, rule="fixed"), analysis=analysis)


def shots_within(plan: CampaignPlan, club: str, shots: Sequence[Shot]) -> list[Shot]:
    """Return the shots with `club`, each complete set of balls as a block."""
    mine = [shot for shot in shots if shot.club == club]
    return [replace(shot, block=code) for shot, code in zip(mine, set_codes(plan, mine), strict=True)]


def set_codes(plan: CampaignPlan, shots: Sequence[Shot]) -> list[int]:
    """Return the number, from 1, of the complete set of balls that each shot with its club belongs to."""
    hits, balls = plan.design.hits_per_mounting, len(plan.design.balls)
    return [(shot.block - 1) * hits + (shot.position - 1) // balls % hits + 1 for shot in shots]


def independent_codes(plan: CampaignPlan, shots: Sequence[Shot]) -> Codes:
    """Return which shots of a level belong together: those of a ball, or of a mounting in a split-plot."""
    return np.array([shot.block if plan.split else shot.sample for shot in shots], int)


def ball_columns(plan: CampaignPlan, shots: Sequence[Shot]) -> Array | None:
    """Return columns (n, m) that take the balls out of a comparison of clubs; None if there is one ball.

    A club's effect beside them is its mean over all balls, missing shots or not.
    """
    balls, clubs = plan.design.balls, plan.design.clubs
    if not plan.split or len(balls) < 2:
        return None
    ball = np.array([balls.index(shot.ball) for shot in shots], int)
    club = np.array([clubs.index(shot.club) for shot in shots], int)
    centred = (ball[:, None] == np.arange(1, len(balls))) - 1 / len(balls)
    return np.hstack([centred * (club == code)[:, None] for code in range(len(clubs))])


def enough_mountings(level: Codes, block: Codes, levels: int) -> bool:
    """Return whether mountings leave degrees of freedom for their own scatter beside blocks and levels."""
    plots = np.unique(np.column_stack([level, block]), axis=0)
    return fit_blocks(np.zeros(len(plots)), plots[:, 0], plots[:, 1], levels).freedom >= 1


def are_pooled(mountings: Codes) -> bool:
    """Return whether all clubs' mountings are taken to scatter alike; else each club's for itself."""
    return int(mountings.min()) < _OWN_SCATTER


def fully_randomised(plan: CampaignPlan) -> CampaignPlan:
    """Return the plan with as many shots whose clubs change from shot to shot."""
    d = plan.design
    blocks = d.blocks * max(d.hits_per_mounting, 1)
    return replace(plan, design=replace(d, blocks=blocks, hits_per_mounting=0))


def as_split_plot(plan: CampaignPlan) -> CampaignPlan | None:
    """Return the plan with as many shots and fewer club changes; None without a layout worth naming.

    The fewest mountings that leave four degrees of freedom for their scatter.
    """
    d = plan.design
    if d.compare != "club" or plan.split or plan.control.ball or plan.stop.rule != "fixed":
        return None
    for blocks in range(2, d.blocks // 2 + 1):
        if d.blocks % blocks == 0 and (blocks - 1) * (len(d.clubs) - 1) >= 4:
            return replace(plan, design=replace(d, blocks=blocks, hits_per_mounting=d.blocks // blocks))
    return None
