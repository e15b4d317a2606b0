"""Progress of the campaign that this process runs, at the terminal."""

from __future__ import annotations

from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.run.progress import CampaignProgress
from bench.commands.campaign.campaign_screen import CampaignBar, ProgressScreen
from bench.records.shot.shot import Shot
from bench.store.records import CampaignEntry, CampaignState


class CampaignScreen(CampaignProgress):
    """Shows the progress of the campaign that this process runs."""

    def __init__(self, entry: CampaignEntry, plan: CampaignPlan, bar: CampaignBar) -> None:
        super().__init__(entry, plan)
        self._screen = ProgressScreen(bar)

    def shot(self, shot: Shot) -> None:
        """Show a shot; stored ones at once, when the run begins."""
        super().shot(shot)
        if not self._replaying:
            self._screen.show(self.message)

    def say(self, text: str) -> None:
        """Show an event."""
        super().say(text)
        self._screen.say(text)

    def standing(self, state: CampaignState, reason: str) -> None:
        """Show the work done so far."""
        before = self.message["state"], self._replaying
        super().standing(state, reason)
        self._screen.show(self.message)
        if (state, False) != before and reason:
            self._screen.say(f"{state}: {reason}")
