"""State of a campaign, published over the network: `golfbench/<bench>/campaign/<id>`, JSON.

It is published at each shot and each change of state, and answered to who asks in between.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bench.campaign.plan import CampaignPlan
from bench.campaign.progress import CampaignProgress
from bench.campaign.runner import Watcher
from bench.shot.shot import Shot
from bench.store.records import CampaignEntry, CampaignState


class Broadcast(CampaignProgress):
    """Publishes the progress of a campaign after each shot and change."""

    def __init__(
        self, entry: CampaignEntry, plan: CampaignPlan, publish: Callable[[dict[str, Any]], None]
    ) -> None:
        super().__init__(entry, plan)
        self._publish = publish

    def shot(self, shot: Shot) -> None:
        """Publish a shot and the remaining time."""
        super().shot(shot)
        self._publish(self.message)

    def say(self, text: str) -> None:
        """Publish an event."""
        super().say(text)
        self._publish(self.message)

    def standing(self, state: CampaignState, reason: str) -> None:
        """Publish the state; while it waits, `reason` is the prompt."""
        super().standing(state, reason)
        self._publish(self.message)


class Together(Watcher):
    """Several watchers as one."""

    def __init__(self, *watchers: Watcher) -> None:
        self._watchers = watchers

    def shot(self, shot: Shot) -> None:
        """Pass a shot to all watchers."""
        for watcher in self._watchers:
            watcher.shot(shot)

    def set_aside(self, block: int) -> None:
        """Pass the number of a block that restarts."""
        for watcher in self._watchers:
            watcher.set_aside(block)

    def feeder(self, balls: int) -> None:
        """Pass the number of balls in the feeder."""
        for watcher in self._watchers:
            watcher.feeder(balls)

    def say(self, text: str) -> None:
        """Pass an event to all watchers."""
        for watcher in self._watchers:
            watcher.say(text)

    def standing(self, state: CampaignState, reason: str) -> None:
        """Pass the campaign's state to all watchers."""
        for watcher in self._watchers:
            watcher.standing(state, reason)
