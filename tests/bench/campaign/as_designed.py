"""Swings of a campaign without corrections, and benches that are armed ahead."""

from __future__ import annotations

from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.run._corrections import Arm, CampaignCorrections
from bench.campaign.run._simulated_shots import SimulatedShots
from bench.campaign.run.plan_requirements import Profiles
from bench.swing.profile import Profile


class AsDesigned(CampaignCorrections):
    """No corrections; plans of these campaigns learn none."""

    def __init__(self, profiles: Profiles) -> None:
        self._profiles = profiles

    def profile(self, arm: Arm) -> Profile:
        """Return the profile of `arm`."""
        return self._profiles[arm]

    def weights(self, arm: Arm) -> tuple[float, ...]:
        """Return none."""
        return ()


def arm_all(shots: SimulatedShots, plan: CampaignPlan) -> None:
    """Arm with every swing and club, which otherwise happens at the first shot of each."""
    for swing in plan.design.swings:
        for club in plan.design.clubs:
            shots._bench(swing, club)
