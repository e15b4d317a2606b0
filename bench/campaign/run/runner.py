"""Run a campaign: take the course's shots, store them in batches, obey pause, stop and abort."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from sqlalchemy.exc import SQLAlchemyError

from bench.base.atomic_file import NotStored
from bench.base.errors import BenchError
from bench.campaign.interruptions import duration_text, found_at_begin
from bench.campaign.plan.bench_setup import (
    Fitting,
    Preparation,
    coming_shots,
    fitting_after,
    missing,
    sample_for,
)
from bench.campaign.plan.gate import outside
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import Course, Ending, Role, Step
from bench.campaign.run._corrections import DriftDetector
from bench.campaign.run.shot_source import (
    BlockingCondition,
    Operator,
    ShotPostponed,
    ShotSource,
    Suspended,
    Taken,
    Watcher,
)
from bench.records.shot.recorded_shot import shot_to_json
from bench.records.shot.shot import Shot, ShotStatus
from bench.records.telemetry.record_file import write_swing
from bench.store.campaigns import CampaignStore, StoredShot
from bench.store.database import DatabaseLocked
from bench.store.rows import CampaignEntry, CampaignRun, CampaignState, Event, Hit, Prompt, PromptKind
from drivers.base import ACTUATORS

BATCH = 50
"""Max number of shots per transaction, lost at most in a crash of a simulated campaign."""

_LOOK = 0.2
"""Polling interval of the database while paused, s."""
_TOUCH_PERIOD = 1.0
"""Time between two signs of life, s."""
_SETTLED = 3.0
"""Time without hindrance before a suspended campaign continues automatically (s)."""
_DATABASE_TIMEOUT = 120.0
"""Max time to wait for a database that another process holds, s."""
_MAX_RESTARTS = 2
"""Max number of restarts of one block: a block with long work by hand must also end."""


class _Pending(NamedTuple):
    """A shot on its way to the disk, with its rows for the database."""

    future: Future[StoredShot]
    hits: Sequence[Hit]
    events: Sequence[Event]
    prompts: Sequence[Prompt]
    original: Path | None


class RunOutcome(NamedTuple):
    """State of a campaign after a run."""

    state: CampaignState
    reason: str
    shots: int
    valid: int


class _RunEnd(Exception):
    def __init__(self, state: CampaignState, reason: str) -> None:
        super().__init__(reason)
        self.state, self.reason = state, reason


class Runner:
    """One run of one campaign, from its first or its next shot to its end or a stop."""

    def __init__(
        self,
        entry: CampaignEntry,
        plan: CampaignPlan,
        store: CampaignStore,
        data_dir: Path,
        source: ShotSource,
        watcher: Watcher,
        batch: int = BATCH,
        operator: Operator | None = None,
        start: CampaignRun | None = None,
        cause: Callable[[], str] = lambda: "Ctrl-C",
    ) -> None:
        """`operator` None: prompts that the simulation cannot answer wait for the database.

        `cause` names what interrupted the run.
        """
        self._start, self._cause = start or CampaignRun(0, datetime.now(UTC)), cause
        self._entry, self._plan, self._store, self._source = entry, plan, store, source
        self._data_dir, self._watcher, self._batch = data_dir, watcher, batch
        self._folder = data_dir / "campaigns" / entry.id / "swings"
        self._operator = operator
        self._drifts = DriftDetector(plan)
        self._fitting = Fitting("")
        self._asked_so_far = 0
        self._open: Prompt | None = None
        self._done_by_itself: list[Prompt] = []
        self._noted: list[Event] = []
        """Events before the next shot."""
        self._alive = data_dir / "campaigns" / entry.id / "alive"
        """Touched at looks, once a second: the time of the runner's last sign of life."""
        self._next_touch = 0.0
        self._last: datetime | None = None
        self._block: list[Shot] = []
        """Shots so far of the block in progress."""
        self._restarts: Counter[tuple[int, int]] = Counter()
        """Restarts by section and block."""
        self._interrupted: Callable[[], bool] = lambda: False
        self._locked: DatabaseLocked | None = None
        """Last wait for the database since the last shot."""
        self._pending: list[_Pending] = []
        self._hits: Counter[Hit] = Counter()
        self.taken = self.valid = 0

    def run(self, course: Course, interrupted: Callable[[], bool]) -> RunOutcome:
        """Continue the campaign; earlier shots go to the watcher first.

        Raises:
            BenchError: data cannot be stored; the database is consistent, and `resume` continues.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        for left in self._folder.glob(".*.partial"):
            left.unlink(missing_ok=True)
        self._interrupted, self._store.waiting = interrupted, self._wait_for_database
        try:
            return self._run(course)
        finally:
            self._store.waiting = None

    def _run(self, course: Course) -> RunOutcome:
        step = self._replay(course)
        self._begin()
        self._store.change(self._entry.id, requested="")
        with ThreadPoolExecutor(1, "swing-writer") as writer:
            try:
                state, reason = self._go_on(course, step, writer)
            except BenchError as error:
                self._store.waiting = None
                with suppress(BenchError, SQLAlchemyError):
                    self._note_event("error", f"the run ended with an error: {error.location}: {error.found}")
                raise
            finally:
                with suppress(BenchError):  # report the first error
                    self._commit()
        with suppress(DatabaseLocked):  # then `resume` finds out
            self._store.change(self._entry.id, requested="")
            if state is not CampaignState.FINISHED:
                self._note_event(str(state), reason)
            self._stand(state, reason)
        return RunOutcome(state, reason, self.taken, self.valid)

    def _begin(self) -> None:
        """Store the beginning of this run, and what there is to say about the one before."""
        campaign, start = self._entry.id, self._start._replace(began=datetime.now(UTC))
        standing, runs = self._store.standing(campaign), self._store.runs(campaign)
        seen = (
            datetime.fromtimestamp(self._alive.stat().st_mtime, UTC) if self._alive.exists() else self._last
        )
        for kind, text in found_at_begin(standing, runs, self.taken, seen, start):
            self._report(kind, text)
        self._store.begin_run(campaign, start)
        self._alive.touch()

    def _note_event(self, kind: str, text: str) -> None:
        self._store.note_event(self._entry.id, Event(datetime.now(UTC), self.taken + 1, kind, text))

    def _report(self, kind: str, text: str) -> None:
        self._note_event(kind, text)
        self._watcher.say(text)

    def _wait_for_database(self, locked: DatabaseLocked) -> None:
        """Give up waiting for the database after some time or when interrupted."""
        if self._locked is None:
            self._watcher.say(f"The database is {locked.state}: waiting for it.")
        self._locked = locked
        if locked.waited > _DATABASE_TIMEOUT or self._interrupted():
            self._store.waiting = None  # later accesses try once
            raise locked

    def _replay(self, course: Course) -> Step | Ending:
        """Send the stored shots to the course; return the next step or the ending."""
        self._hits = self._store.hits(self._entry.hit_scope)
        shots = self._store.shots(self._entry.id)
        restarts = {e.before_shot for e in self._store.events(self._entry.id) if e.kind == "restart"}
        self._recall([stored.shot for stored in shots])
        try:
            step = next(course)
            for stored in shots:
                if stored.shot.shot in restarts:
                    step = self._restart(course, step)
                if stored.set_aside:
                    self._note(stored.shot)
                    continue
                self._require_same(step, stored.shot)
                if drift := self._drifts.before(step):
                    self._source.relearn(drift, stored.shot.shot)  # reported then
                self._note(stored.shot)
                step = course.send(stored.shot)
            if self.taken + 1 in restarts:
                step = self._restart(course, step)
        except StopIteration as stop:
            ending: Ending = stop.value
            return ending
        return step

    def _recall(self, shots: Sequence[Shot]) -> None:
        """Restore the fitting of the bench and any open prompt."""
        entry, prompts = self._entry, self._store.prompts(self._entry.id)
        club = entry.real_time.get("club") or entry.configuration["swing"]["club"]
        self._fitting = fitting_after(club, shots, prompts)
        self._asked_so_far = len(prompts)
        self._open = prompts[-1] if prompts and prompts[-1].answered is None else None
        if entry.real_time and self._store.standing(entry.id).state is not CampaignState.WAITING:
            # A ball may have gone into a shot that was cut off.
            self._fitting = self._fitting._replace(feeder=())
        if not entry.simulated and (last := self._store.last_answered(entry, PromptKind.CLUB)):
            campaign, prompt = last
            if campaign != entry.id:
                self._fitting = self._fitting.with_done(prompt)

    def _require_same(self, step: Step, shot: Shot) -> None:
        trial = step.trial
        planned = (trial.role, trial.block, trial.position, trial.arm.swing, trial.arm.club, trial.arm.ball)
        stored = (shot.role, shot.block, shot.position, shot.swing, shot.club, shot.ball)
        if planned != stored or step.attempt != shot.attempt:
            location = f"campaign {self._entry.id}, shot {shot.shot}"
            action = "Its records do not belong to its plan; start a new campaign."
            raise BenchError(location, f"stored as {stored}", f"{planned} by its plan", action)

    def _go_on(
        self, course: Course, step: Step | Ending, writer: ThreadPoolExecutor
    ) -> tuple[CampaignState, str]:
        try:
            self._go_back_to_work()
            ending = self._shots(course, step, writer)
            return (CampaignState.FINISHED if ending.complete else CampaignState.SUSPENDED), ending.reason
        except _RunEnd as end:
            return end.state, end.reason
        except KeyboardInterrupt:
            return CampaignState.STOPPED, f"stopped by {self._cause()} before the next shot"
        except DatabaseLocked as error:
            self._source.rest()
            lost = "; the last shot is not stored and is taken again" * bool(self._pending)
            return CampaignState.SUSPENDED, f"the database was {error.found}{lost}"
        except Suspended as why:
            if self._requested()[0] == "abort":
                return CampaignState.ABORTED, self._by_request("aborted")
            return CampaignState.SUSPENDED, str(why)

    def _shots(self, course: Course, step: Step | Ending, writer: ThreadPoolExecutor) -> Ending:
        failures = 0
        while not isinstance(step, Ending):
            self._obey_requests()
            self._wait_for_hindrance(step)
            number = self.taken + 1
            sample = sample_for(self._plan, step.trial, self._hits)
            if sample is None:
                raise Suspended(
                    f"balls used up: every sample of {step.trial.arm.ball!r} has its "
                    f"{self._plan.ball_handling.hits} hits"
                )
            self._fit(step, number, sample)
            if self._stood_too_long(step, number):
                step = self._restart(course, step)
                continue
            if drift := self._drifts.before(step):
                self._say("learned", self._source.relearn(drift, number))
            self._source.foresee(number, coming_shots(self._plan, step.trial, self._hits))
            try:
                taken = self._source.take(step, number, sample)
            except ShotPostponed as postponed:
                for kind, text in postponed.args:
                    self._say(kind, text)
                continue
            if taken.stopped:  # as if it was never started
                reason = f"stopped by {self._cause()}; the swing will be repeated"
                raise _RunEnd(CampaignState.STOPPED, reason)
            shot = self._gated(step, taken)
            self._store_later(step, sample, shot, taken, writer)
            failures = 0 if shot.status is ShotStatus.VALID else failures + 1
            try:
                step = course.send(shot)
            except StopIteration as stop:
                step = stop.value
            if failures >= self._plan.design.failures_in_a_row and not isinstance(step, Ending):
                raise Suspended(f"{failures} shots in a row not valid, the last: {shot.reason}")
        self._commit()
        return step

    def _store_later(
        self, step: Step, sample: int, shot: Shot, taken: Taken, writer: ThreadPoolExecutor
    ) -> None:
        """Count `shot` and write it; it is added to the database with its batch."""
        for kind, text in taken.events:
            self._say(kind, text)
        events, self._noted = self._noted, []
        arm, hits = step.trial.arm, list[Hit]()
        if taken.cycles is not None:
            hits += [Hit("valve", name) for name in ACTUATORS]
        if taken.struck:
            hits += [Hit("ball", arm.ball, sample), Hit("club", arm.club)]
        self._hits.update(hits)
        prompts, self._done_by_itself = self._done_by_itself, []
        written = writer.submit(self._written, shot, taken)
        self._pending.append(_Pending(written, hits, events, prompts, taken.original))
        self._fitting = self._fitting.after(shot)
        self._locked = None
        self._note(shot)
        if self._plan.ball_handling.magazine:
            self._watcher.feeder(len(self._fitting.feeder))
        if len(self._pending) >= self._batch:
            self._commit()

    def _stood_too_long(self, step: Step, number: int) -> bool:
        """Store a long time without a shot; return whether the block restarts, whose shots are set aside."""
        bound, before = self._plan.interruption.restart_after, self._last
        now = self._source.time_of(number)
        gap = 0.0 if before is None else (now - before).total_seconds()
        if not bound or 0 <= gap <= bound:
            return False
        self._last = now
        self._commit()
        words = (
            f"{duration_text(gap)} without a shot"
            if gap > 0
            else "an unknown time without a shot (the clock went back)"
        )
        trial, warm_up = step.trial, self._plan.warm_up.at_most
        location = f"block {trial.block}" if trial.block else f"the warm-up of section {trial.section}"
        tried = [shot for shot in self._block if shot.block == trial.block]
        if tried or (warm_up and (trial.role is not Role.WARM_UP or trial.position > 1)):
            if self._restarts[trial.section, trial.block] < _MAX_RESTARTS:
                aside = [shot.shot for shot in tried]
                after = " after a new warm-up" if warm_up and trial.block else ""
                text = f"{words}: {location} restarts{after}"
                text += f"; set aside: shots {aside[0]} to {aside[-1]}" if aside else ""
                event = Event(now, number, "restart", text)
                self._store.set_aside(self._entry.id, aside, event)
                self.valid -= sum(shot.status is ShotStatus.VALID for shot in tried)
                self._watcher.say(text)
                return True
            words += f"; {location} was restarted {_MAX_RESTARTS} times already and continues"
        self._report("gap", words)
        return False

    def _restart(self, course: Course, step: Step) -> Step:
        """Restart the block of `step`; return its first step, or that of its warm-up."""
        trial = step.trial
        self._restarts[trial.section, trial.block] += 1
        self._block = []
        self._drifts.set_aside(trial.block)
        self._watcher.set_aside(trial.block)
        return course.send(None)

    def _go_back_to_work(self) -> None:
        """Take the bench back after an answer that came without a runner."""
        waiting = self._store.standing(self._entry.id).state is CampaignState.WAITING
        if waiting and self._open is None and (prompts := self._store.prompts(self._entry.id)):
            self._source.resume_after_access(PromptKind(prompts[-1].kind), self._ask_also)
        self._stand(CampaignState.RUNNING, "")  # an open prompt waits for access first

    def _fit(self, step: Step, number: int, sample: int) -> None:
        looked = self._source.simulated  # else last thing before the shot
        while wish := missing(
            self._plan, self._fitting, step, sample, self._hits
        ) or self._source.required_restart(step):
            if wish.kind not in (self._operator.kinds if self._operator else {PromptKind.BENCH}):
                now = self._source.time_of(number)
                prompt = self._prompt(wish, number, now)._replace(answered=now, by="simulation")
                self._source.grant_access(wish.kind, self._ask_also)
                self._source.resume_after_access(wish.kind, self._ask_also)
                self._done_by_itself.append(prompt)
                self._watcher.say(f"{wish.text} Done automatically by the simulation.")
            else:
                self._commit()
                self._source.grant_access(wish.kind, self._ask_also)
                prompt = self._opened(wish, number)
                self._wait_for_answer(prompt, wish.kind)
            self._fitting, looked = self._fitting.with_done(prompt), False
        if before := self._withdrawn():
            looked = False
            self._source.resume_after_access(PromptKind(before.kind), self._ask_also)
            self._stand(CampaignState.RUNNING, "")
        if (work := self._source.work_before_arming()) and not self._requested()[0]:
            self._store.change(self._entry.id, requested="pause", requested_by="")
        if work or not looked:
            self._obey_requests(work)

    def _prompt(self, wish: Preparation, number: int, now: datetime) -> Prompt:
        self._asked_so_far += 1
        return Prompt(self._asked_so_far, number, wish.kind, wish.text, wish.content, now)

    def _opened(self, wish: Preparation, number: int) -> Prompt:
        """Return the open prompt if it asks for `wish`, else a new one."""
        before = self._open
        if before and (before.kind, before.content) == (wish.kind, wish.content):
            self._open = None
            return before
        self._withdrawn()
        prompt = self._prompt(wish, number, datetime.now(UTC))
        done, self._done_by_itself = self._done_by_itself, []
        self._store.add(self._entry, (), prompts=done)  # else a resumed run would give its numbers again
        self._store.ask(self._entry.id, prompt)
        return prompt

    def _withdrawn(self) -> Prompt | None:
        """Close and return the open prompt, which is no longer needed; None without one."""
        before, self._open = self._open, None
        if before:
            self._store.answer(self._entry.id, before.number, "no one: no longer needed", datetime.now(UTC))
        return before

    def _wait_for_answer(self, prompt: Prompt, kind: PromptKind) -> None:
        campaign, operator = self._entry.id, self._operator
        self._stand(CampaignState.WAITING, prompt.text)
        if operator:
            operator.show(prompt)
        try:
            while not self._store.prompts(campaign)[-1].answered:
                requested, _ = self._requested()
                if requested == "abort":
                    raise _RunEnd(CampaignState.ABORTED, self._by_request("aborted"))
                if requested == "stop" or self._interrupted():
                    how = self._by_request("").strip() if requested else f"by {self._cause()}"
                    reason = f"stopped {how} while it waited ({prompt.text.rstrip('.')})"
                    raise _RunEnd(CampaignState.STOPPED, reason)
                if operator and operator.answered():
                    self._store.answer(campaign, prompt.number, operator.name, datetime.now(UTC))
                else:
                    time.sleep(_LOOK)
        finally:
            if operator:
                operator.hide()
        self._source.resume_after_access(kind, self._ask_also)
        self._stand(CampaignState.RUNNING, "")

    def _ask_also(self, text: str) -> None:
        """Show work at the robot other than that of the prompt, unless `text` is empty.

        Raises:
            _RunEnd: a stop is requested.
        """
        if self._requested()[0] == "stop":
            shown = f" ({text.rstrip('.')})" if text else ""
            raise _RunEnd(CampaignState.STOPPED, f"{self._by_request('stopped')} while it waited{shown}")
        if text and self._store.standing(self._entry.id).reason != text:
            self._stand(CampaignState.WAITING, text)

    def _stand(self, state: CampaignState, reason: str) -> None:
        self._store.change(self._entry.id, state=state, reason=reason)
        self._watcher.standing(state, reason)

    def _wait_for_hindrance(self, step: Step) -> None:
        if (first := self._source.hindrance(step)) is None:
            return
        self._commit()
        self._end_on_machine(first)
        if not first.armed:
            self._source.rest()
        began = free_since = time.monotonic()
        self._stand(CampaignState.SUSPENDED, first.text)
        self._watcher.say(f"suspended: {first.text}")
        while (now := time.monotonic()) - free_since < _SETTLED:
            self._obey_requests()
            if found := self._source.hindrance(step):
                free_since = now
                self._end_on_machine(found)
                if self._store.standing(self._entry.id).state is not CampaignState.SUSPENDED:
                    self._stand(CampaignState.SUSPENDED, found.text)  # it was paused meanwhile
            time.sleep(_LOOK)
        self._stand(CampaignState.RUNNING, "")
        self._say("suspended", f"{first.text}; continued automatically after {now - began:.0f} s")

    def _end_on_machine(self, hindrance: BlockingCondition) -> None:
        """Vent a machine that may not wait armed; a person may stand at the hindrance, in the line of flight.

        Raises:
            Suspended: it was vented, and waits for `campaign resume`.
        """
        if not (hindrance.armed or self._source.simulated):
            self._source.rest()
            raise Suspended(hindrance.text)

    def _say(self, kind: str, text: str) -> None:
        """Report an event now, and store it with the next shot."""
        self._watcher.say(text)
        number = self.taken + 1
        self._noted.append(Event(self._source.time_of(number), number, kind, text))

    def _requested(self) -> tuple[str, str]:
        """Return the pending request and who made it; a sign of life."""
        if (now := time.monotonic()) >= self._next_touch:  # a touch waits for the disk
            self._next_touch = now + _TOUCH_PERIOD
            with suppress(OSError):
                self._alive.touch()
        standing = self._store.standing(self._entry.id)
        return standing.requested, standing.requested_by

    def _by_request(self, done: str) -> str:
        _, by = self._requested()
        return f"{done} by request{f' of {by}' if by else ''}"

    def _obey_requests(self, work: str = "") -> None:
        """Wait while paused, for `work` of a person if not empty.

        Raises:
            _RunEnd: an end is requested.
        """
        paused: float | None = None
        first = f"; before the robot arms: {work}" if work else ""
        while True:
            if self._interrupted():
                raise _RunEnd(CampaignState.STOPPED, f"stopped by {self._cause()}{first}")
            match self._requested()[0]:
                case "stop":
                    raise _RunEnd(CampaignState.STOPPED, f"{self._by_request('stopped')}{first}")
                case "abort":
                    raise _RunEnd(CampaignState.ABORTED, self._by_request("aborted"))
                case "pause":
                    if paused is None:
                        paused, text = time.monotonic(), work or self._by_request("paused")
                        self._commit()
                        self._source.rest()
                        self._report("paused", text)
                        self._stand(CampaignState.PAUSED, text)
                    time.sleep(_LOOK)
                case _:
                    if paused is not None:
                        duration = duration_text(time.monotonic() - paused)
                        self._report("resumed", f"continued after a pause of {duration}")
                        self._stand(CampaignState.RUNNING, "")
                    return

    def _gated(self, step: Step, taken: Taken) -> Shot:
        shot = taken.shot
        if shot.status is ShotStatus.VALID:
            club = self._plan.clubs[step.trial.arm.club]
            figure, reason = outside(shot, club, step.centre, self._plan.gate)
            if reason:
                return replace(shot, status=ShotStatus.EXCLUDED, reason=reason, gate_figure=figure)
        return shot

    def _written(self, shot: Shot, taken: Taken) -> StoredShot:
        """Write the shot's cycles to a complete file and return the row for the database."""
        if taken.cycles is None:
            return StoredShot(shot)
        path = self._folder / f"{shot.shot:06d}.parquet"
        facts = {"campaign": self._entry.id, "shot": shot_to_json(shot)}
        write_swing(path, taken.cycles, {**taken.metadata, **facts})
        return StoredShot(shot, str(path.relative_to(self._data_dir)), path.stat().st_size)

    def _note(self, shot: Shot) -> None:
        self.taken += 1
        self.valid += shot.status is ShotStatus.VALID
        self._last = shot.time_utc
        if self._block and self._block[-1].block != shot.block:
            self._block = []
        if shot.block:
            self._block.append(shot)
        self._drifts.note(shot)
        self._watcher.shot(shot)

    def _commit(self) -> None:
        """Add the pending shots in one transaction, once all their files are complete.

        Raises:
            BenchError: a file cannot be stored; the shots before it are still added.
        """
        pending, self._pending = self._pending, []
        shots, events, hits, prompts = list[StoredShot](), list[Event](), Counter[Hit](), list[Prompt]()
        try:
            for one in pending:
                shots.append(one.future.result())
                events += one.events
                hits.update(one.hits)
                prompts += one.prompts
        except NotStored as error:
            stored = self.taken - len(pending) + len(shots)
            resume = f"golfbench campaign resume {self._entry.id}"
            action = f"Free some space, then {resume}: {stored} shots are stored."
            raise NotStored(error.location, error.found, error.expected, action) from error
        finally:
            if shots:
                try:
                    self._store.add(self._entry, shots, events, hits, prompts)
                except DatabaseLocked:
                    self._pending = pending
                    raise
                if self._locked is not None:
                    waited = duration_text(self._locked.waited)
                    text = f"the database was {self._locked.state} for {waited}; waited for it"
                    self._note_event("database", text)
                    self._locked = None
                for one in pending[: len(shots)]:
                    if one.original is not None:
                        with suppress(OSError):  # not ours to remove: kept twice
                            one.original.unlink(missing_ok=True)
