"""Swings of a campaign without corrections, and benches that are armed ahead."""

from __future__ import annotations

from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.run.corrections import Arm, CampaignCorrections, Drift, Robot
from bench.campaign.run.plan_requirements import Profiles
from bench.campaign.run.simulated_shots import SimulatedShots
from bench.swing.profile import Profile
from sim.plant import PlantParameters


class AsDesigned(CampaignCorrections):
    """No corrections, and none learned on the way."""

    def __init__(self, profiles: Profiles) -> None:
        self._profiles = profiles

    def profile(self, arm: Arm) -> Profile:
        """Return the profile of `arm`."""
        return self._profiles[arm]

    def weights(self, arm: Arm) -> tuple[float, ...]:
        """Return none."""
        return ()

    def refresh(self, drift: Drift, number: int, robot: Robot, truth: PlantParameters | None = None) -> str:
        """Learn nothing."""
        return f"{self._profiles[drift.arm].name}: {drift.text}; it continues as designed"


def arm_all(shots: SimulatedShots, plan: CampaignPlan) -> None:
    """Arm with every swing and club, which otherwise happens at the first shot of each."""
    for swing in plan.design.swings:
        for club in plan.design.clubs:
            shots._bench(swing, club)
