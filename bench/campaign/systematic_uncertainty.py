"""Errors that all shots of a level have in common, which more shots do not average away."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bench.campaign.plan import CampaignPlan, levels
from bench.shot.shot import Shot, ShotStatus


def common_errors(plan: CampaignPlan, shots: Sequence[Shot]) -> Mapping[str, float]:
    """Return the standard uncertainty (m) of each ball's carry from its measured aerodynamics.

    Empty where they do not separate the levels: clubs and swings hit the same ball, and carry of another
    source, or another quantity, does not come from them. The total has the uncertainty of its carry.
    """
    if plan.design.compare != "ball" or plan.analysis.quantity not in {"carry_m", "total_m"}:
        return {}
    found = {}
    for name in levels(plan):
        errors = [
            error
            for shot in shots
            if shot.ball == name and shot.status is ShotStatus.VALID and shot.carry_source == "measured"
            if (error := shot.carry_measured_error_m) is not None
        ]
        if errors:
            found[name] = float(np.mean(errors))
    return found
