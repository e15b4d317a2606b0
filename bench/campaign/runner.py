"""Runs a campaign: takes the course's shots, stores them in batches, obeys pause, stop and abort."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple, Protocol

from bench.campaign.course import Course, Ending, Step
from bench.campaign.gate import outside
from bench.campaign.plan import Plan
from bench.campaign.shot import Shot, Status
from bench.campaign.simulated import Taken
from bench.errors import BenchError
from bench.store.campaigns import CampaignEntry, CampaignState, CampaignStore, Event, Hit, StoredShot
from bench.telemetry.recorder import write_swing
from drivers.base import ACTUATORS

BATCH = 50
"""Shots that one transaction adds at most, and a crash of a simulated campaign costs at most."""

_LOOK = 0.2
"""s between two looks at the database while paused."""


class Suspended(Exception):
    """The bench gives no more shots until a person has looked; the text says why."""


class ShotSource(Protocol):
    """A bench as a campaign sees it."""

    simulated: bool

    def time_of(self, number: int) -> datetime:
        """Return the time at which shot `number` begins: the clock's, or a virtual one."""
        ...

    def take(self, step: Step, number: int, sample: int) -> Taken:
        """Take shot `number` with physical ball `sample`.

        Raises:
            Suspended: it was not taken, and none can be for now.
            KeyboardInterrupt: somebody asked to stop before the swing.
        """
        ...

    def rest(self) -> None:
        """Leave nothing armed: it is not known when the next shot comes."""
        ...


class _Pending(NamedTuple):
    """A shot on its way to the disk, with what goes into the database beside it."""

    future: Future[StoredShot]
    hits: tuple[Hit, ...]
    events: tuple[Event, ...]


class Outcome(NamedTuple):
    """Where a run left its campaign."""

    state: CampaignState
    reason: str
    shots: int
    valid: int


@dataclass
class Watcher:
    """Who is told how a run goes on; does nothing by itself."""

    def shot(self, shot: Shot) -> None:
        """Hear of a shot that was taken."""

    def say(self, text: str) -> None:
        """Hear of something that happened."""


def sample_for(plan: Plan, ball: str, hits: Counter[Hit]) -> int | None:
    """Return the number of the ball to take: the one of its model with the fewest hits; None: all used up."""
    handling = plan.ball_handling
    numbers = range(handling.first_sample, handling.first_sample + handling.samples)
    number = min(numbers, key=lambda sample: (hits[Hit("ball", ball, sample)], sample))
    return number if hits[Hit("ball", ball, number)] < handling.hits else None


class Runner:
    """One run of one campaign, from its first or its next shot to its end or a stop."""

    def __init__(
        self,
        entry: CampaignEntry,
        plan: Plan,
        store: CampaignStore,
        data_dir: Path,
        source: ShotSource,
        watcher: Watcher,
        batch: int = BATCH,
    ) -> None:
        self._entry, self._plan, self._store, self._source = entry, plan, store, source
        self._data_dir, self._watcher, self._batch = data_dir, watcher, batch
        self._folder = data_dir / "campaigns" / entry.id / "swings"
        self._pending: list[_Pending] = []
        self._hits: Counter[Hit] = Counter()
        self.taken = self.valid = 0

    def run(self, course: Course, interrupted: Callable[[], bool]) -> Outcome:
        """Go on from where the campaign stands; shots taken so far are told to the watcher first.

        Raises:
            BenchError: something cannot be stored; what is in the database is whole, and `resume` goes on.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        for left in self._folder.glob(".*.partial"):
            left.unlink(missing_ok=True)
        step = self._replay(course)
        self._store.change(self._entry.id, state=CampaignState.RUNNING, reason="", requested="")
        with ThreadPoolExecutor(1, "swing-writer") as writer:
            try:
                state, reason = self._go_on(course, step, interrupted, writer)
            finally:
                with suppress(BenchError):  # the first trouble is the one to tell of
                    self._commit()
        self._store.change(self._entry.id, state=state, reason=reason, requested="")
        return Outcome(state, reason, self.taken, self.valid)

    def _replay(self, course: Course) -> Step | Ending:
        """Send the stored shots to the course and return what comes next."""
        self._hits = self._store.hits(self._entry.hit_scope)
        try:
            step = next(course)
            for stored in self._store.shots(self._entry.id):
                self._require_same(step, stored.shot)
                self._note(stored.shot)
                step = course.send(stored.shot)
        except StopIteration as stop:
            ending: Ending = stop.value
            return ending
        return step

    def _require_same(self, step: Step, shot: Shot) -> None:
        """Refuse to go on when the stored shot is not the one the plan had here."""
        trial = step.trial
        planned = (trial.role, trial.block, trial.position, trial.arm.swing, trial.arm.club, trial.arm.ball)
        stored = (shot.role, shot.block, shot.position, shot.swing, shot.club, shot.ball)
        if planned != stored or step.attempt != shot.attempt:
            raise BenchError(
                f"campaign {self._entry.id}, shot {shot.shot}",
                f"stored as {stored}",
                f"{planned} by its plan",
                "Its records and its plan do not belong together; begin a new campaign.",
            )

    def _go_on(
        self, course: Course, step: Step | Ending, interrupted: Callable[[], bool], writer: ThreadPoolExecutor
    ) -> tuple[CampaignState, str]:
        failures = 0
        while not isinstance(step, Ending):
            for state, reason in self._asked(interrupted):
                return state, reason
            number = self.taken + 1
            sample = sample_for(self._plan, step.trial.arm.ball, self._hits)
            if sample is None:
                return CampaignState.SUSPENDED, (
                    f"balls used up: every sample of {step.trial.arm.ball!r} has its "
                    f"{self._plan.ball_handling.hits} hits"
                )
            try:
                taken = self._source.take(step, number, sample)
            except KeyboardInterrupt:
                return CampaignState.STOPPED, "interrupted before the next shot"
            except Suspended as why:
                if self._store.standing(self._entry.id).requested == "abort":
                    return CampaignState.ABORTED, "aborted by request"
                return CampaignState.SUSPENDED, str(why)
            if taken.stopped:  # by Ctrl-C: as if it had not been begun
                return CampaignState.STOPPED, "interrupted within a swing, which is taken again"
            shot = self._gated(step, taken)
            events = tuple(Event(shot.time_utc, number, *event) for event in taken.events)
            hits = _used(step, taken, sample)
            self._hits.update(hits)
            for event in events:
                self._watcher.say(event.text)
            self._pending.append(_Pending(writer.submit(self._written, shot, taken), hits, events))
            self._note(shot)
            if len(self._pending) >= self._batch:
                self._commit()
            failures = 0 if shot.status is Status.VALID else failures + 1
            try:
                step = course.send(shot)
            except StopIteration as stop:
                step = stop.value
            if failures >= self._plan.design.failures_in_a_row and not isinstance(step, Ending):
                return (
                    CampaignState.SUSPENDED,
                    f"{failures} shots in a row not valid, the last: {shot.reason}",
                )
        self._commit()
        return (CampaignState.FINISHED if step.complete else CampaignState.SUSPENDED), step.reason

    def _asked(self, interrupted: Callable[[], bool]) -> Iterator[tuple[CampaignState, str]]:
        """Yield where to go when somebody asks to end; waits while paused."""
        campaign, paused = self._entry.id, False
        while True:
            if interrupted():
                yield CampaignState.STOPPED, "interrupted by Ctrl-C"
                return
            match self._store.standing(campaign).requested:
                case "stop":
                    yield CampaignState.STOPPED, "stopped by request"
                    return
                case "abort":
                    yield CampaignState.ABORTED, "aborted by request"
                    return
                case "pause":
                    if not paused:
                        self._commit()
                        self._source.rest()
                        self._store.change(campaign, state=CampaignState.PAUSED, reason="paused by request")
                        self._watcher.say("paused")
                    paused = True
                    time.sleep(_LOOK)
                case _:
                    if paused:
                        self._store.change(campaign, state=CampaignState.RUNNING, reason="")
                        self._watcher.say("running")
                    return

    def _gated(self, step: Step, taken: Taken) -> Shot:
        """Return the shot, excluded when its delivery does not count."""
        shot = taken.shot
        if shot.status is Status.VALID:
            club = self._plan.clubs[step.trial.arm.club]
            if reason := outside(shot, club, step.centre, self._plan.gate):
                return replace(shot, status=Status.EXCLUDED, reason=reason)
        return shot

    def _written(self, shot: Shot, taken: Taken) -> StoredShot:
        """Write the shot's cycles, whole, and return what the database is to know."""
        if taken.cycles is None:
            return StoredShot(shot)
        path = self._folder / f"{shot.shot:06d}.parquet"
        row = asdict(shot) | {"time_utc": shot.time_utc.isoformat()}
        write_swing(path, taken.cycles, {**taken.metadata, "campaign": self._entry.id, "shot": row})
        return StoredShot(shot, str(path.relative_to(self._data_dir)), path.stat().st_size)

    def _note(self, shot: Shot) -> None:
        self.taken += 1
        self.valid += shot.status is Status.VALID
        self._watcher.shot(shot)

    def _commit(self) -> None:
        """Add what is pending in one transaction, once all its files are whole.

        Raises:
            BenchError: a file cannot be stored; the shots before it are added all the same.
        """
        pending, self._pending = self._pending, []
        shots, events, hits = list[StoredShot](), list[Event](), Counter[Hit]()
        try:
            for one in pending:
                shots.append(one.future.result())
                events += one.events
                hits.update(one.hits)
        finally:
            if shots:
                self._store.add(self._entry, shots, events, hits)


def _used(step: Step, taken: Taken, sample: int) -> tuple[Hit, ...]:
    """Return what the shot wore."""
    arm = step.trial.arm
    valves = tuple(Hit("valve", name) for name in ACTUATORS) if taken.cycles is not None else ()
    struck = (Hit("ball", arm.ball, sample), Hit("club", arm.club)) if taken.struck else ()
    return (*valves, *struck)
