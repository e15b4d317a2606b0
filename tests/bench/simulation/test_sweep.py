"""Sweeps: order, batches, the store, and the same results on every engine, whatever dies."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from threadpoolctl import threadpool_limits

from bench.base.errors import BenchError, Refused
from bench.simulation.sweep import (
    BATCH_TIME,
    BatchDone,
    CaseBatch,
    InProcess,
    LocalProcesses,
    Study,
    SweepStore,
    local_engine,
    one_blas_thread_in_children,
    sweep,
)
from tests.bench.simulation.studies import BlasThreads, Draws, as_dict, as_float


@dataclass(frozen=True)
class Deadly:
    """A study that no process survives."""

    def prepared(self) -> Callable[[int], float]:
        def die(seed: int) -> float:
            os.kill(os.getpid(), signal.SIGKILL)
            return 0.0

        return die


class Timed:
    """An engine that runs nothing: a case takes `cost` s; remembers the batches."""

    def __init__(self, cost: float, slots: int = 2) -> None:
        self.cost, self.number, self.batches = cost, slots, list[CaseBatch]()

    def slots(self) -> int:
        return self.number

    def completed(self, study: Study[Any, Any], batches: Iterator[CaseBatch]) -> Iterator[BatchDone]:
        for batch in batches:
            self.batches.append(batch)
            yield BatchDone(batch.indices, batch.cases, self.cost * len(batch.cases))


def test_sweep_results_keep_case_order_for_each_engine() -> None:
    cases = [5, 3, 9, 1, 12, 4]
    alone = sweep(Draws(), cases, InProcess())
    walk = Draws().prepared()
    assert alone == [walk(case) for case in cases]
    assert sweep(Draws(), cases, LocalProcesses(2)) == alone


def test_sweep_batches_match_batch_time_and_shrink_at_end() -> None:
    engine = Timed(0.1)
    assert sweep(Draws(), range(1000), engine) == list(range(1000))
    sizes = [len(batch.cases) for batch in engine.batches]
    assert sizes[0] == 1
    assert sizes[1] == round(BATCH_TIME / 0.1)
    assert sizes[-1] == 1
    assert sizes[1:] == sorted(sizes[1:], reverse=True)


def test_sweep_batch_has_cases_of_one_group() -> None:
    engine = Timed(0.001)
    assert sweep(Draws(), range(40), engine, group=lambda case: case % 3) == list(range(40))
    assert all(len({case % 3 for case in batch.cases}) == 1 for batch in engine.batches)


def test_sweep_resumed_from_store_runs_no_case_twice(tmp_path: Path) -> None:
    path, engine, done = tmp_path / "results.jsonl", Timed(10.0), list[int]()
    store = SweepStore(path, "d", as_dict, as_float)
    sweep(Draws(), range(10), engine, store=store, progress=done.append, stop=lambda: len(done) > 4)
    assert done == [0, 1, 2, 3, 4]
    with path.open("a") as file:
        file.write('{"case": "9", "resu')
    engine = Timed(10.0)
    store = SweepStore(path, "d", as_dict, as_float)
    found = sweep(Draws(), range(10), engine, store=store, progress=done.append)
    assert found == list(range(10))
    assert [batch.cases for batch in engine.batches] == [[i] for i in range(4, 10)]
    assert done[5:] == [4, 5, 6, 7, 8, 9, 10]


def test_sweep_store_other_digest_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    SweepStore(path, "one", as_dict, as_float).add({"1": 1.0})
    assert SweepStore(path, "one", as_dict, as_float).results == {"1": 1.0}
    assert not SweepStore(path, "another", as_dict, as_float).results


def test_sweep_dead_process_cases_run_again_once(tmp_path: Path) -> None:
    deadly = tmp_path / "deadly"
    deadly.touch()
    store = SweepStore(tmp_path / "results.jsonl", "d", as_dict, as_float)
    found = sweep(Draws(deadly=deadly), range(20), LocalProcesses(2), store=store)
    assert not deadly.exists()
    assert found == sweep(Draws(), range(20), InProcess())
    lines = (tmp_path / "results.jsonl").read_text().splitlines()
    assert len(lines) == 1 + 20 + 1


@pytest.mark.slow
def test_sweep_repeatedly_dying_processes_raise_error() -> None:
    with pytest.raises(BenchError, match="died 3 times in a row"):
        sweep(Deadly(), range(4), LocalProcesses(2))


@pytest.mark.parametrize("engine", [InProcess(), LocalProcesses(2)], ids=["in process", "processes"])
def test_sweep_case_exception_ends_sweep(engine: InProcess | LocalProcesses) -> None:
    with pytest.raises(Refused, match="found 3"):
        sweep(Draws(refused=3), range(6), engine)


@pytest.mark.parametrize("engine", [InProcess(), LocalProcesses(2)], ids=["in process", "processes"])
def test_sweep_cases_run_with_one_blas_thread(
    engine: InProcess | LocalProcesses, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    with threadpool_limits(3, "blas"):
        assert sweep(BlasThreads(), range(4), engine) == [(1, 1)] * 4
        before, _ = BlasThreads().prepared()(0)
    assert before == 3
    assert os.environ["OPENBLAS_NUM_THREADS"] == "3"


def test_one_blas_thread_in_children_sets_and_restores_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with one_blas_thread_in_children():
        assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_local_engine_one_case_or_process_runs_in_process() -> None:
    assert isinstance(local_engine(4, cases=1), InProcess)
    assert isinstance(local_engine(1, cases=9), InProcess)
    assert isinstance(local_engine(2, cases=9), LocalProcesses)
