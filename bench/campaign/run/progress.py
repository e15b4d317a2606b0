"""Progress of a campaign as messages to programs, and as notifications to persons.

A message has the work done, the time left and the next work by hand. It is published as
`golfbench/<bench>/campaign/<id>`, JSON, at each shot, at each change of state and on request.

Notifications go out by mail, webhook or chat when a campaign waits, is suspended or finishes. `apprise` sends
them from a separate thread, with retries: no shot waits for it. URLs of services hold passwords and tokens.
They are in a file that only its owner may read, and in no message, log or record.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from queue import Empty, Full, Queue
from statistics import median
from threading import Event, RLock, Thread
from typing import Any, NamedTuple

from bench.base.errors import BenchError
from bench.base.from_toml import read_text
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import (
    Arm,
    PlannedShot,
    Role,
    all_trials,
    is_mounted,
    is_settled,
    sections,
)
from bench.campaign.run.shot_source import Watcher
from bench.network.messages import CAMPAIGN_VERSION, LastShot
from bench.records.shot.shot import Shot, ShotStatus
from bench.store.rows import CampaignEntry, CampaignState

_LAST = 11
"""Number of last shots whose times give the pace."""
_FIGURES = tuple(name for name in LastShot.__annotations__ if name != "time_utc")


class CampaignProgress(Watcher):
    """Keeps the state of a campaign up to date in `message`, valid as JSON."""

    def __init__(
        self,
        entry: CampaignEntry,
        plan: CampaignPlan,
        publish: Callable[[dict[str, Any]], None] = lambda message: None,
    ) -> None:
        """`publish` gets the message after each shot of this run, event and change of state."""
        self._plan, self._entry, self._publish = plan, entry, publish
        self._saying = RLock()
        """Held while an event is published: the notifier speaks from its own thread."""
        trials = all_trials(plan)
        self._open: dict[tuple[int, int], PlannedShot] = {(t.block, t.position): t for t in trials}
        self._block: list[Shot] = []
        """Shots of the block in progress."""
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
            if self._block and self._block[-1].block != shot.block:
                self._block = []
            self._block.append(shot)
        if is_settled(self._plan, shot):
            self._open.pop((shot.block, shot.position), None)
        m["done"] = m["planned"] - len(self._open)
        m["last_shot"] = {name: getattr(shot, name) for name in _FIGURES} | {
            "time_utc": shot.time_utc.isoformat()
        }
        self._last = shot
        if not self._replaying:  # the wall clock may be set; in lock-step shots have a virtual clock
            self._times.append(time.monotonic())
        elif self._entry.real_time:
            self._times.append(shot.time_utc.timestamp())
        self._time_left()
        if not self._replaying:
            self._publish(self.message)

    def set_aside(self, block: int) -> None:
        """Open a block again; its shots so far do not count."""
        for shot in (one for one in self._block if one.block == block):
            valid = shot.status is ShotStatus.VALID
            self.message["balls"][shot.ball]["valid"] -= valid
            self.message["valid"] -= valid
            self._open[shot.block, shot.position] = _trial_of(shot)
        self._block = []
        self._open = dict(sorted(self._open.items()))
        self.message["done"] = self.message["planned"] - len(self._open)
        self._time_left()

    def feeder(self, balls: int) -> None:
        """Keep the number of balls in the feeder."""
        self._balls_left = balls
        self._time_left()

    def say(self, text: str) -> None:
        """Keep the newest event."""
        with self._saying:
            self.message["event"] = {
                "text": text,
                "time_utc": datetime.now(UTC).isoformat(timespec="seconds"),
            }
            self._publish(self.message)

    def standing(self, state: CampaignState, reason: str) -> None:
        """Keep the state; while it waits, `reason` is the prompt."""
        self._replaying = False
        self.message |= {"state": state, "reason": reason}
        self._publish(self.message)

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
    arm = Arm(shot.swing, shot.club, shot.ball)
    return PlannedShot(Role(shot.role), shot.section, shot.block, shot.position, arm)


WAITS = (0.0, 3.0, 15.0, 60.0)
"""Times before the attempts at a notification, s."""
LAST_TIMEOUT = 10.0
"""Max time for notifications that are still on their way at the end of a run, s."""
_MAX_WAITING = 50
"""Max number of waiting notifications; a newer one is dropped."""
_WORDS = {
    CampaignState.WAITING: "waits for a person",
    CampaignState.SUSPENDED: "is suspended",
    CampaignState.FINISHED: "is finished",
}


class Service(NamedTuple):
    """One service that receives notifications."""

    location: str
    """File and line of its URL, for messages."""
    send: Callable[[str, str], bool]
    """Send text and title; return whether it was accepted."""


def read_services(file: Path) -> list[Service]:
    """Return the services in `file`: one URL of apprise a line; empty lines and comments (#) do not count.

    Raises:
        BenchError: apprise is not installed; the file is missing or others may read it; a URL is unknown.
    """
    try:
        import apprise
    except ImportError as error:
        action = 'Run pip install "golfbench[notify]", or leave notifications.file empty.'
        found = f"package apprise is not installed ({error})"
        raise BenchError("notifications.file", found, "apprise", action) from error
    log = logging.getLogger("apprise")
    log.propagate = False  # its texts may name a URL
    log.addHandler(logging.NullHandler())
    text = read_text(file, "a text file", "Write the URLs of the services to it, one a line.")
    mode = file.stat().st_mode
    if mode & 0o077:
        expected, action = "readable by its owner only: it holds secrets", f"chmod 600 {file}"
        raise BenchError(f"notifications.file: {file}", f"mode {mode & 0o777:o}", expected, action)
    services = []
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        location, one = f"{file}, line {number}", apprise.Apprise.instantiate(line)
        if one is None:
            action = "See apprise's list of services. The line is not shown: it may hold a secret."
            raise BenchError(location, "a URL that apprise does not know", "the URL of a service", action)
        # In the thread that calls it: apprise's own pool would outlive the run.
        services.append(Service(location, one.notify))
    return services


class Notifier(Watcher):
    """Sends each state of a campaign that a person should know, from a thread, to all services."""

    def __init__(
        self,
        entry: CampaignEntry,
        services: Sequence[Service],
        say: Callable[[str], None],
        waits: Sequence[float] = WAITS,
    ) -> None:
        """`say` shows that a notification could not be sent."""
        self._entry, self._services, self._say, self._waits = entry, services, say, waits
        self._queue: Queue[tuple[str, str]] = Queue(_MAX_WAITING)
        self._closing = Event()
        self._thread = Thread(target=self._work, name="notifier", daemon=True)
        self._thread.start()

    def standing(self, state: CampaignState, reason: str) -> None:
        """Send a state that a person should know; returns at once."""
        if word := _WORDS.get(state):
            title = f"golfbench {self._entry.bench}: {self._entry.name} {word}"
            with suppress(Full):
                self._queue.put_nowait((title, f"{reason or self._entry.title}\ncampaign {self._entry.id}"))

    def close(self, timeout: float = LAST_TIMEOUT) -> None:
        """Wait up to `timeout` (s) for unsent notifications, then discard them."""
        self._closing.set()
        self._thread.join(timeout)
        if self._thread.is_alive():
            self._say("Some notifications were not sent by the end; they are discarded.")

    def _work(self) -> None:
        while True:
            try:
                title, text = self._queue.get(timeout=0.1)
            except Empty:
                if self._closing.is_set():
                    return
                continue
            for service in self._services:
                self._deliver(service, title, text)

    def _deliver(self, service: Service, title: str, text: str) -> None:
        for wait in self._waits:
            time.sleep(wait)
            with suppress(Exception):  # whatever a service does, the campaign continues
                if service.send(text, title):
                    return
        self._say(f"A notification was not sent ({service.location}): {title}")


@contextmanager
def notifying(
    file: str, entry: CampaignEntry, say: Callable[[str], None], waits: Sequence[float] = WAITS
) -> Iterator[Watcher]:
    """Notify the services in `file` of the states of `entry`; none if `file` is empty.

    Raises:
        BenchError: as `read_services`.
    """
    if not file:
        yield Watcher()
        return
    notifier = Notifier(entry, read_services(Path(file)), say, waits)
    try:
        yield notifier
    finally:
        notifier.close()
