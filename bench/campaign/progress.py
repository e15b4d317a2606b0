"""Progress of a campaign as a message: the work done, the time left, the next work by hand.

It is published as `golfbench/<bench>/campaign/<id>`, JSON, at each shot and each change of state, and
answered to who asks in between.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from datetime import UTC, datetime
from itertools import pairwise
from statistics import median
from typing import Any

from bench.campaign.plan import CampaignPlan
from bench.campaign.randomization import Arm, PlannedShot, Role, all_trials, is_mounted, sections
from bench.campaign.runner import Watcher
from bench.campaign.shot_sequence import is_settled
from bench.network.messages import CAMPAIGN_VERSION, LastShot
from bench.shot.shot import Shot, ShotStatus
from bench.store.records import CampaignEntry, CampaignState

_LAST = 11
"""Number of last shots whose times give the pace."""
_FIGURES = tuple(name for name in LastShot.__annotations__ if name != "time_utc")


class CampaignProgress(Watcher):
    """Keeps the state of a campaign up to date in `message`, valid as JSON."""

    def __init__(self, entry: CampaignEntry, plan: CampaignPlan) -> None:
        self._plan, self._entry = plan, entry
        trials = all_trials(plan)
        self._open: dict[tuple[int, int], PlannedShot] = {(t.block, t.position): t for t in trials}
        self._closed: dict[int, list[PlannedShot]] = {}
        """By block, until the next one begins."""
        self._valid: tuple[int, Counter[str]] = 0, Counter()
        """A block and its valid shots by ball."""
        self._times: deque[float] = deque(maxlen=_LAST)
        self._replaying = True
        self._balls_left: int | None = None
        self._last: Shot | None = None
        balls = {name: {"valid": 0, "planned": 0} for name in plan.ball_names}
        for trial in trials:
            balls[trial.arm.ball]["planned"] += 1
        self.message: dict[str, Any] = {
            "version": CAMPAIGN_VERSION,
            "campaign": entry.id,
            "name": entry.name,
            "state": CampaignState.RUNNING,
            "reason": "",
            "shots": 0,
            "valid": 0,
            "done": 0,
            "planned": len(trials),
            "block": 0,
            "blocks": len(sections(plan)) * plan.design.blocks,
            "balls": balls,
            "seconds_left": None,
            "last_shot": None,
            "next_work": None,
            "event": None,
        }
        self._time_left()

    def shot(self, shot: Shot) -> None:
        """Count a shot."""
        m = self.message
        valid = shot.status is ShotStatus.VALID
        m["shots"] += 1
        m["valid"] += valid
        m["block"] = shot.block
        if shot.role != Role.WARM_UP:
            m["balls"][shot.ball]["valid"] += valid
            if self._valid[0] != shot.block:
                self._valid = shot.block, Counter()
            self._valid[1][shot.ball] += valid
        if is_settled(self._plan, shot) and (trial := self._open.pop((shot.block, shot.position), None)):
            self._closed = {shot.block: [*self._closed.get(shot.block, []), trial]}
        m["done"] = m["planned"] - len(self._open)
        m["last_shot"] = {name: getattr(shot, name) for name in _FIGURES} | {
            "time_utc": shot.time_utc.isoformat()
        }
        self._last = shot
        if not self._replaying:  # the wall's clock may be set; in lock-step the shots have one of their own
            self._times.append(time.monotonic())
        elif self._entry.real_time:
            self._times.append(shot.time_utc.timestamp())
        self._time_left()

    def set_aside(self, block: int) -> None:
        """Open a block again; its shots so far do not count."""
        for trial in self._closed.pop(block, []):
            self._open[trial.block, trial.position] = trial
        if self._valid[0] == block:
            for ball, valid in self._valid[1].items():
                self.message["balls"][ball]["valid"] -= valid
                self.message["valid"] -= valid
            self._valid = 0, Counter()
        self._open = dict(sorted(self._open.items()))
        self.message["done"] = self.message["planned"] - len(self._open)
        self._time_left()

    def feeder(self, balls: int) -> None:
        """Keep the number of balls in the feeder."""
        self._balls_left = balls
        self._time_left()

    def say(self, text: str) -> None:
        """Keep the newest event."""
        self.message["event"] = {"text": text, "time_utc": datetime.now(UTC).isoformat(timespec="seconds")}

    def standing(self, state: CampaignState, reason: str) -> None:
        """Keep the state; while it waits, `reason` is the prompt."""
        self._replaying = False
        self.message |= {"state": state, "reason": reason}

    def _time_left(self) -> None:
        pace, work = self._pace(), self._next_work()
        if work is not None:
            work["seconds"] = None if pace is None else round(pace * work["shots"], 1)
        left = None if pace is None else round(pace * len(self._open) + self._hand_work_left(), 1)
        self.message |= {"next_work": work, "seconds_left": left}

    def _pace(self) -> float | None:
        """Return the seconds a shot takes: the median of the last ones, which no interruption moves."""
        times = list(self._times)
        steps = [later - earlier for earlier, later in pairwise(times)]
        if steps := [step for step in steps if step > 0]:
            return median(steps)
        return self._plan.design.seconds_per_shot if self._entry.real_time else None

    def _hand_work_left(self) -> float:
        """Return the time that the club changes to come take, s."""
        if not self._by_hand:
            return 0.0
        coming = list(self._open.values())
        if self._last and coming:
            coming.insert(0, _trial_of(self._last))
        changes = sum(not is_mounted(self._plan, one, two) for one, two in pairwise(coming))
        return changes * self._plan.hand_work.club_change

    @property
    def _by_hand(self) -> bool:
        return bool(self._entry.real_time) and not self._entry.simulated

    def _next_work(self) -> dict[str, Any] | None:
        """Return the next work by hand, and the number of shots before it."""
        if not self._by_hand:
            return None
        found: list[tuple[int, str]] = []
        before = _trial_of(self._last) if self._last else None
        for number, trial in enumerate(self._open.values()):
            if before is not None and not is_mounted(self._plan, before, trial):
                found.append((number, f"mount club {trial.arm.club}"))
                break
            before = trial
        if self._balls_left is not None and self._balls_left < len(self._open):
            found.append((self._balls_left, "fill the feeder"))
        if not found:
            return None
        shots, text = min(found)
        return {"shots": shots, "text": text, "seconds": None}


def _trial_of(shot: Shot) -> PlannedShot:
    """Return the planned shot that `shot` was."""
    arm = Arm(shot.swing, shot.club, shot.ball)
    return PlannedShot(Role(shot.role), shot.section, shot.block, shot.position, arm)


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
