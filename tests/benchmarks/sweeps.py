"""Engines of sweeps side by side: a sample of the fault matrix in turn, and what a batch costs by itself.

    python -m tests.benchmarks sweeps [--every 60] [--rounds 3] [--workers 2]
    python -m tests.benchmarks sweeps --equal        # outcomes of one process, of 1, 2 and 4 workers
    python -m tests.benchmarks sweeps --kills 10     # outcomes after workers were killed

The engines run the same cases in turn: one process, processes, a cluster of as many workers on this machine,
started before it is timed. Ratios are medians over the rounds; ideal is the processor time of one process,
shared by the workers. What a batch costs is measured with cases that do nothing, each a batch of its own.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter

import psutil

from bench.config import load_configuration, shipped_configuration
from bench.faults.matrix import FaultStudy, MatrixPlan, fault_study, matrix_store, plan_matrix, run_matrix
from bench.faults.verdict import CaseOutcome
from bench.simulation.cluster_engine import connected
from bench.simulation.local_engine import InProcess, LocalProcesses
from bench.simulation.sweep import BATCH_TIME, Engine, sweep
from tests.benchmarks.row import Row
from tests.running_cluster import kill_worker, running_cluster

NAME = "sweeps"
_EMPTY = 2000
"""Batches of cases that do nothing."""


@dataclass(frozen=True)
class Nothing:
    """A study whose cases cost nothing."""

    def prepared(self) -> Callable[[int], int]:
        """Return the function of a case."""
        return abs


class Measured:
    """Wall time and processor time of an engine's runs, s, and the greatest memory, bytes."""

    def __init__(self, engine: Engine, others: Sequence[psutil.Process] = ()) -> None:
        self.engine, self.others = engine, list(others)
        self.wall, self.processor = list[float](), list[float]()
        self.memory = 0

    def run(self, work: Callable[[Engine], list[CaseOutcome]]) -> list[CaseOutcome]:
        """Return the outcomes of `work` on the engine."""
        begin, used = perf_counter(), self._processor()
        found = work(self.engine)
        self.wall.append(perf_counter() - begin)
        self.processor.append(self._processor() - used)
        self.memory = max([self.memory, *(process.memory_info().rss for process in self._all())])
        return found

    def _all(self) -> list[psutil.Process]:
        below = [child for process in self.others for child in process.children(recursive=True)]
        return [psutil.Process(), *self.others, *below]

    def _processor(self) -> float:
        """Processor time of this process, its ended children and the others."""
        own = psutil.Process().cpu_times()
        total = own.user + own.system + own.children_user + own.children_system
        for process in self._all()[1:]:
            times = process.cpu_times()
            total += times.user + times.system
        return float(total)


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return ratios of times, costs of a batch, and whether the outcomes are equal."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks sweeps")
    parser.add_argument("--every", type=int, default=60, help="One case of so many.")
    parser.add_argument("--signal", default="", help="Faults with this in their name only.")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kills", type=int, default=0, help="Kill so many workers on the way, and compare.")
    parser.add_argument("--equal", action="store_true", help="Compare outcomes of 1, 2 and 4 workers only.")
    options = parser.parse_args(arguments)
    c = load_configuration(shipped_configuration())
    study = fault_study(c, c.swing.profile, model_check=True)
    plan = plan_matrix(study.profile, model_check=True, signals=(options.signal,), every=options.every)
    count = options.workers
    if options.equal:
        return _equality(plan, study)
    if options.kills:
        return [_killed(plan, study, options.kills, count)]
    with running_cluster(count) as (address, cluster), connected(address) as remote:
        engines = {
            "one process": Measured(InProcess()),
            "processes": Measured(LocalProcesses(count)),
            "cluster": Measured(remote, [cluster]),
        }
        rows = _ratios(engines, plan, study, options.rounds, count)
        for name in ("processes", "cluster"):
            rows.append(_cost(name, engines[name].engine))
        rows += [
            Row(NAME, f"{name}: largest process", measured.memory / 1e6, "MB")
            for name, measured in engines.items()
        ]
    return rows


def _killed(plan: MatrixPlan, study: FaultStudy, kills: int, count: int) -> Row:
    """Return how many outcomes differ after workers were killed, or are stored twice."""
    with TemporaryDirectory() as folder:
        alone, path = matrix_store(Path(folder) / "alone.jsonl", study), Path(folder) / "killed.jsonl"
        expected = run_matrix(plan, study, alone, LocalProcesses(count))
        killed = list[int]()
        with running_cluster(count) as (address, cluster), connected(address) as remote:

            def kill(done: int) -> None:
                if len(killed) < kills and done * (kills + 1) >= len(plan.cases) * (len(killed) + 1):
                    killed.extend(kill_worker(cluster))

            found = run_matrix(plan, study, matrix_store(path, study), remote, progress=kill)
        twice = path.read_text().count('"case"') - len(plan.cases)
    differing = sum(one != other for one, other in zip(expected, found, strict=True))
    note = f"{len(set(killed))} workers killed, {len(plan.cases)} cases, {twice} stored twice"
    return Row(NAME, "outcomes that differ", differing + twice, "", note, at_most=0)


def _equality(plan: MatrixPlan, study: FaultStudy) -> list[Row]:
    """Return how many outcomes of each engine differ from those of one process."""
    note = f"{len(plan.cases)} cases"
    with TemporaryDirectory() as folder:

        def outcomes(name: str, engine: Engine) -> list[CaseOutcome]:
            return run_matrix(plan, study, matrix_store(Path(folder) / f"{name}.jsonl", study), engine)

        def row(name: str, found: list[CaseOutcome]) -> Row:
            differing = sum(one != other for one, other in zip(alone, found, strict=True))
            return Row(NAME, f"{name}: outcomes that differ", differing, "", note, at_most=0)

        alone = outcomes("one process", InProcess())
        rows = [row("one process again", outcomes("again", InProcess()))]
        for count in (1, 2, 4):
            name = f"processes, {count}"
            rows.append(row(name, outcomes(name, LocalProcesses(count))))
            name = f"cluster, {count} workers"
            with running_cluster(count) as (address, _), connected(address) as remote:
                rows.append(row(name, outcomes(name, remote)))
    return rows


def _ratios(
    engines: dict[str, Measured], plan: MatrixPlan, study: FaultStudy, rounds: int, count: int
) -> list[Row]:
    differing = 0
    with TemporaryDirectory() as folder:
        for number in range(rounds + 1):
            outcomes = []
            for name, measured in engines.items():
                store = matrix_store(Path(folder) / f"{name}-{number}.jsonl", study)
                outcomes.append(
                    measured.run(lambda engine, store=store: run_matrix(plan, study, store, engine))  # type: ignore[misc]
                )
            differing += sum(found != outcomes[0] for found in outcomes)
    # The first round loads machine code in the workers that stay.
    one, local, remote = engines.values()
    ideal = median(one.processor[1:]) / count
    note = f"{len(plan.cases)} cases, {rounds} rounds, {count} workers"
    return [
        Row(NAME, "one process: wall time", median(one.wall[1:]), "s", note),
        Row(NAME, "processes: ideal over wall time", ideal / median(local.wall[1:]), "", note),
        Row(NAME, "cluster: ideal over wall time", ideal / median(remote.wall[1:]), "", note),
        Row(
            NAME,
            "cluster: wall time of processes over its own",
            median(a / b for a, b in zip(local.wall[1:], remote.wall[1:], strict=True)),
            "",
            note,
            at_least=0.95,
        ),
        Row(
            NAME,
            "processes: processor time over that of one",
            median(local.processor[1:]) / median(one.processor[1:]),
            "",
        ),
        Row(
            NAME,
            "cluster: processor time over that of one",
            median(remote.processor[1:]) / median(one.processor[1:]),
            "",
        ),
        Row(NAME, "runs whose outcomes differ", differing, "", at_most=0),
    ]


def _cost(name: str, engine: Engine) -> Row:
    """Return the time for which a batch keeps those busy who hand it out, and what follows of it."""
    sweep(Nothing(), range(50), engine, group=lambda case: case)
    begin = perf_counter()
    sweep(Nothing(), range(_EMPTY), engine, group=lambda case: case)
    cost = (perf_counter() - begin) / _EMPTY
    note = f"{100 * cost / BATCH_TIME:.2f} % of a batch; binds at {BATCH_TIME / cost:.0f} workers"
    return Row(NAME, f"{name}: a batch", 1e3 * cost, "ms", note, at_most=50.0 * BATCH_TIME)
