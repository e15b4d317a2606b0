"""State of a campaign, published over the network: `golfbench/<bench>/campaign/<id>`, JSON.

It is published at each shot and each change of state, and answered to who asks in between.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from datetime import datetime
from typing import Any

from bench.campaign.course import is_settled
from bench.campaign.plan import CampaignPlan
from bench.campaign.runner import Watcher
from bench.campaign.sequence import all_trials
from bench.shot.shot import Shot, ShotStatus
from bench.store.campaigns import CampaignEntry, CampaignState

VERSION = 1
"""Version of the message."""
_LAST = 10
"""Number of last shots whose pace predicts the remaining time."""


class Broadcast(Watcher):
    """Publishes the state of a campaign after each shot and change."""

    def __init__(
        self, entry: CampaignEntry, plan: CampaignPlan, publish: Callable[[dict[str, Any]], None]
    ) -> None:
        self._plan, self._publish = plan, publish
        self._planned = len(all_trials(plan))
        self._times: deque[datetime] = deque(maxlen=_LAST)
        self._message: dict[str, Any] = {
            "version": VERSION,
            "campaign": entry.id,
            "name": entry.name,
            "state": CampaignState.RUNNING,
            "reason": "",
            "shots": 0,
            "valid": 0,
            "done": 0,
            "planned": self._planned,
            "seconds_left": None,
            "last_shot": None,
        }

    def shot(self, shot: Shot) -> None:
        """Publish a shot and the remaining time."""
        m = self._message
        m["shots"] += 1
        m["valid"] += shot.status is ShotStatus.VALID
        m["done"] += is_settled(self._plan, shot)
        m["last_shot"] = {
            "shot": shot.shot,
            "ball": shot.ball,
            "club": shot.club,
            "status": shot.status,
            "reason": shot.reason,
            "club_speed_mps": shot.club_speed_mps,
            "carry_m": shot.carry_m,
            "carry_source": shot.carry_source,
            "time_utc": shot.time_utc.isoformat(),
        }
        self._times.append(shot.time_utc)
        pace = self._plan.design.seconds_per_shot
        if len(self._times) > 1:
            pace = (self._times[-1] - self._times[0]).total_seconds() / (len(self._times) - 1)
        m["seconds_left"] = round(pace * (self._planned - m["done"]), 1)
        self._publish(m)

    def standing(self, state: CampaignState, reason: str) -> None:
        """Publish the state; while it waits, `reason` is the prompt."""
        self._message |= {"state": state, "reason": reason}
        self._publish(self._message)


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

    def say(self, text: str) -> None:
        """Pass an event to all watchers."""
        for watcher in self._watchers:
            watcher.say(text)

    def standing(self, state: CampaignState, reason: str) -> None:
        """Pass the campaign's state to all watchers."""
        for watcher in self._watchers:
            watcher.standing(state, reason)
