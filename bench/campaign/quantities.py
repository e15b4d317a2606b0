"""All quantities of each level, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.campaign.analysis import Spread, spread
from bench.campaign.plan import CampaignPlan, levels
from bench.campaign.randomization import Role
from bench.campaign.split_plot import independent_codes
from bench.shot.shot import Shot, ShotStatus

QUANTITIES: Mapping[str, str] = {
    "ball_speed_mps": "ball speed",
    "launch_angle_deg": "launch",
    "spin_rpm": "spin",
    "landing_angle_deg": "descent",
    "apex_m": "apex",
    "carry_m": "carry",
    "total_m": "total",
    "carry_side_m": "offline",
}
"""Columns of the shot table with their names in the table of all quantities."""

QUANTITY_NAMES: Mapping[str, str] = {
    **QUANTITIES,
    "club_speed_mps": "club speed",
    "launch_angle_deg": "launch angle",
    "landing_angle_deg": "landing angle",
    "total_m": "total distance",
}
"""Columns with their names where there is room."""


@dataclass(frozen=True)
class LevelQuantities:
    """All quantities of one level in one section, of valid shots."""

    name: str
    control: bool
    """Whether it is the control ball."""
    balls: int
    """Number of different balls."""
    hits: int
    """Number of shots that hit a ball, valid or not."""
    valid: int
    spreads: Mapping[str, Spread]
    """Mean and standard deviation with their intervals, by column."""


def level_quantities(plan: CampaignPlan, shots: Sequence[Shot]) -> tuple[LevelQuantities, ...]:
    """Return all quantities of a section's levels, those of the control ball last."""
    tests = [shot for shot in shots if shot.role == Role.TEST]
    controls = [shot for shot in shots if shot.role == Role.CONTROL]
    by_level: dict[str, list[Shot]] = {name: [] for name in levels(plan)}
    for shot in tests:
        by_level.get(getattr(shot, plan.design.compare), []).append(shot)
    found = [_quantities(plan, name, mine, control=False) for name, mine in by_level.items()]
    if controls:
        found.append(_quantities(plan, plan.control.ball, controls, control=True))
    return tuple(found)


def _quantities(plan: CampaignPlan, name: str, shots: Sequence[Shot], *, control: bool) -> LevelQuantities:
    valid = [shot for shot in shots if shot.status is ShotStatus.VALID]
    spreads = {}
    for column in QUANTITIES:
        measured = [shot for shot in valid if getattr(shot, column) is not None]
        values = np.array([getattr(shot, column) for shot in measured], dtype=float)
        spreads[column] = spread(values, independent_codes(plan, measured), plan.analysis.confidence)
    return LevelQuantities(
        name,
        control,
        len({shot.sample for shot in valid}),
        sum(shot.status is not ShotStatus.FAILED for shot in shots),
        len(valid),
        spreads,
    )
