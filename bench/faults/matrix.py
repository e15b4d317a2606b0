"""The whole matrix: the plan of its cases, and their run in parallel processes that may be interrupted."""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from zlib import crc32

from bench.config import Configuration
from bench.faults.case import Workbench
from bench.faults.catalogue import Breakage, irrelevant
from bench.faults.combined import CATALOGUE
from bench.faults.instants import (
    ACCESS,
    INTO_A_STOP,
    START,
    Instant,
    dense_instants,
    instants_of,
    stopped_instants,
)
from bench.faults.verdict import CaseOutcome
from bench.swing.profile import Profile
from drivers.base.machine_code import source_digest
from sim.faults import sort_of

_PR_SET_PDEATHSIG = 1
_AT_ONCE = 12
"""Cases of one instant that a process runs before it reports."""


@dataclass(frozen=True)
class Skipped:
    """A pair that cannot matter, with its rule."""

    breakage: str
    signal: str
    kind: str
    family: str
    instant: str
    phase: str
    rule: str


@dataclass(frozen=True)
class MatrixPlan:
    """Cases to run, and pairs left out."""

    cases: tuple[tuple[Breakage, Instant], ...]
    skipped: tuple[Skipped, ...]
    every: int = 1
    """One case of so many was drawn."""


def instants_for(breakage: Breakage, profile: Profile) -> tuple[Instant, ...]:
    """Return the instants at which `breakage` is tried."""
    of_motion = sort_of(breakage.fault.signal) in ("valve", "encoder")
    if breakage.family == "during a stop":
        return stopped_instants(profile, INTO_A_STOP if of_motion else INTO_A_STOP[1::2])
    if breakage.family == "from the start":
        return START
    if breakage.family == "latent pair":
        return instants_of(profile)[:1]
    if breakage.family == "access":
        return ACCESS
    dense = of_motion and breakage.fault.kind in ("stuck", "off")
    return instants_of(profile) + (dense_instants(profile) if dense else ())


def plan_matrix(
    profile: Profile,
    *,
    model_check: bool,
    signals: Sequence[str] = (),
    phases: Sequence[str] = (),
    families: Sequence[str] = (),
    one_instant: bool = False,
    every: int = 1,
) -> MatrixPlan:
    """Return the cases of `profile`.

    They are narrowed by `signals` (parts of names), `phases`, `families`, `one_instant` of each phase, and to
    one case of `every`, at least one of each breakage.
    """
    cases: list[tuple[Breakage, Instant]] = []
    skipped = []
    for breakage in CATALOGUE:
        if signals and not any(part in breakage.name for part in signals):
            continue
        if families and breakage.family not in families:
            continue
        instants = instants_for(breakage, profile)
        if one_instant:
            instants = _middle_ones(instants)
        for instant in instants:
            if phases and instant.phase not in phases:
                continue
            if rule := irrelevant(breakage, instant.phase, model_check=model_check):
                f = breakage.fault
                skipped.append(
                    Skipped(
                        breakage.name, f.signal, f.kind, breakage.family, instant.name, instant.phase, rule
                    )
                )
            else:
                cases.append((breakage, instant))
    by_lot = sorted(cases, key=lambda case: _drawn(*case) % every, reverse=True)
    first = {breakage.name: instant for breakage, instant in by_lot}
    drawn = tuple(c for c in cases if _drawn(*c) % every == 0 or (every > 1 and first[c[0].name] is c[1]))
    return MatrixPlan(drawn, tuple(skipped), every)


def _drawn(breakage: Breakage, instant: Instant) -> int:
    """Return a number of a case that says nothing of it, and is the same in every run."""
    return crc32(f"{breakage.name} {instant.name}".encode())


def _middle_ones(instants: Sequence[Instant]) -> tuple[Instant, ...]:
    """Return the middle one of `instants` in each phase."""
    by_phase: dict[str, list[Instant]] = {}
    for instant in instants:
        by_phase.setdefault(instant.phase, []).append(instant)
    return tuple(of_phase[len(of_phase) // 2] for of_phase in by_phase.values())


def digest_of(configuration: Configuration, profile: Profile, model_check: bool) -> str:
    """Return the digest of all that results depend on: sources, plant, settings, profile."""
    effective = configuration.effective()
    parts = {
        name: effective[name]
        for name in ("plant", "control", "lifecycle", "homing", "envelope", "estimator", "driver")
    }
    text = json.dumps([source_digest(), parts, model_check], sort_keys=True)
    return hashlib.sha256(text.encode() + profile.angle.tobytes() + profile.valve.tobytes()).hexdigest()[:16]


class CaseStore:
    """Outcomes of one matrix in a file of JSON lines; stored cases are not run again."""

    def __init__(self, path: Path, digest: str) -> None:
        """Read the stored outcomes; a file of another matrix is replaced, a torn last line dropped."""
        self.path = path
        self.outcomes: dict[tuple[str, str], CaseOutcome] = {}
        self.seconds = 0.0
        """Time that the cases took over all runs, s."""
        lines = path.read_text().splitlines() if path.exists() else []
        if not lines or _parsed(lines[0]).get("digest") != digest:
            lines = [json.dumps({"schema": 1, "digest": digest})]
        kept = lines[:1]
        for line in lines[1:]:
            record = _parsed(line)
            if "seconds" in record:
                self.seconds += float(record["seconds"])
                kept.append(line)
            elif record:
                outcome = outcome_of(record)
                self.outcomes[outcome.breakage, outcome.instant] = outcome
                kept.append(line)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(kept) + "\n")

    def add(self, outcomes: Sequence[CaseOutcome]) -> None:
        """Store `outcomes`."""
        with self.path.open("a") as file:
            for outcome in outcomes:
                self.outcomes[outcome.breakage, outcome.instant] = outcome
                file.write(json.dumps(outcome.as_json()) + "\n")

    def took(self, seconds: float) -> None:
        """Store the duration of a run."""
        self.seconds += seconds
        with self.path.open("a") as file:
            file.write(json.dumps({"seconds": round(seconds, 1)}) + "\n")


def _parsed(line: str) -> dict[str, Any]:
    try:
        record = json.loads(line)
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}


def outcome_of(record: dict[str, Any]) -> CaseOutcome:
    """Return the outcome of a record of `CaseOutcome.as_json`."""
    return CaseOutcome(**{**record, "reasons": tuple(record["reasons"])})


def run_matrix(
    plan: MatrixPlan,
    configuration: Configuration,
    profile: Profile,
    store: CaseStore,
    *,
    model_check: bool,
    processes: int = 0,
    progress: Callable[[int], None] = lambda done: None,
    stop: Callable[[], bool] = lambda: False,
) -> list[CaseOutcome]:
    """Run the cases that `store` lacks, and return the outcomes of all of `plan` in its order.

    In this process with `processes` 1, else in as many, by default one a core. `progress` is called with the
    number of cases done. On `stop` the outcomes so far are returned; the rest is run the next time.
    """
    left = [(b, i) for b, i in plan.cases if (b.name, i.name) not in store.outcomes]
    progress(len(plan.cases) - len(left))
    done = len(plan.cases) - len(left)
    tasks = list(_tasks(left))
    if processes == 1 or len(tasks) <= 1:
        bench = Workbench(configuration, profile, model_check=model_check)
        for instant, breakages in tasks:
            if stop():
                break
            store.add([bench.run(breakage, instant) for breakage in breakages])
            done += len(breakages)
            progress(done)
    else:
        count = min(processes or os.cpu_count() or 1, len(tasks))
        with ProcessPoolExecutor(
            count, get_context("spawn"), _begin, (os.getpid(), configuration, profile, model_check)
        ) as pool:
            waiting: set[Future[list[CaseOutcome]]] = set()
            queue = iter(tasks)
            while True:
                while len(waiting) < 2 * count and not stop() and (task := next(queue, None)) is not None:
                    waiting.add(pool.submit(_run, *task))
                if not waiting:
                    break
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in finished:
                    outcomes = future.result()
                    store.add(outcomes)
                    done += len(outcomes)
                    progress(done)
    keys = [(breakage.name, instant.name) for breakage, instant in plan.cases]
    return [store.outcomes[key] for key in keys if key in store.outcomes]


def _tasks(cases: Sequence[tuple[Breakage, Instant]]) -> Iterator[tuple[Instant, list[Breakage]]]:
    """Yield the cases by instant, a few at a time: a process keeps the undisturbed bench of each."""
    for instant in dict.fromkeys(instant for _, instant in cases):
        breakages = [breakage for breakage, at in cases if at == instant]
        for begin in range(0, len(breakages), _AT_ONCE):
            yield instant, breakages[begin : begin + _AT_ONCE]


_bench: Workbench | None = None
"""Bench of a worker process."""


def _begin(parent: int, configuration: Configuration, profile: Profile, model_check: bool) -> None:
    # Without it a pool's workers wait for ever after a signal has ended their parent.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)
    global _bench  # noqa: PLW0603 - the only place where a pool's worker can keep its bench
    _bench = Workbench(configuration, profile, model_check=model_check)


def _run(instant: Instant, breakages: list[Breakage]) -> list[CaseOutcome]:
    if _bench is None:
        raise RuntimeError("worker not initialised")
    return [_bench.run(breakage, instant) for breakage in breakages]
