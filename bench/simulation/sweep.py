"""Sweeps: one pure function of many cases, on any engine, with results in the order of the cases.

A study is the work on each case. An engine runs batches of cases: this process
(`bench.simulation.local_engine.InProcess`), processes of this machine (`LocalProcesses`), or a cluster
(`bench.simulation.cluster_engine`). Results are the same bit for bit on all of them, as seeds come from the
case and nothing of one case reaches another. With a store, an interrupted sweep resumes where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from time import perf_counter
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from bench.simulation.one_blas_thread import one_blas_thread
from bench.simulation.sweep_store import SweepStore

Case = TypeVar("Case")
Result = TypeVar("Result")
Case_contra = TypeVar("Case_contra", contravariant=True)
Result_co = TypeVar("Result_co", covariant=True)

BATCH_TIME = 4.0
"""Target duration of a batch, s: long compared with handing it out, short compared with a sweep."""
IN_FLIGHT = 2
"""Batches handed out for each worker, so that none waits for its next one."""


class Study(Protocol[Case_contra, Result_co]):
    """The work on each case: a value with all that the cases share, to be pickled.

    Raises of the function end the sweep.
    """

    def prepared(self) -> Callable[[Case_contra], Result_co]:
        """Return the function of a case; called once in a process, for what takes long to make."""
        ...


class CaseBatch(NamedTuple):
    """Cases for one worker at a time."""

    number: int
    cases: tuple[Any, ...]


class BatchDone(NamedTuple):
    """A batch that was run."""

    number: int
    results: list[Any]
    duration: float
    """Duration in the worker (s)."""


class Engine(Protocol):
    """Where batches run."""

    def slots(self) -> int:
        """Return how many batches run at a time."""
        ...

    def completed(self, study: Study[Any, Any], batches: Iterator[CaseBatch]) -> Iterator[BatchDone]:
        """Yield each of `batches` when it is done, in any order; takes the next when a worker is free."""
        ...


def prepare(study: Study[Case, Result]) -> Callable[[Case], Result]:
    """Return the function of a case, prepared as its cases are run: with one BLAS thread."""
    with one_blas_thread():
        return study.prepared()


def run_batch(function: Callable[[Any], Any], batch: CaseBatch) -> BatchDone:
    """Return what `function` makes of the cases of `batch`, with one BLAS thread on any engine."""
    begin = perf_counter()
    with one_blas_thread():
        results = [function(case) for case in batch.cases]
    return BatchDone(batch.number, results, perf_counter() - begin)


def sweep(
    study: Study[Case, Result],
    cases: Sequence[Case],
    engine: Engine,
    *,
    store: SweepStore[Result] | None = None,
    key: Callable[[Case], str] = str,
    group: Callable[[Case], Hashable] = lambda case: None,
    progress: Callable[[int], None] = lambda done: None,
    stop: Callable[[], bool] = lambda: False,
) -> list[Result]:
    """Return the results of `cases` in their order; those so far if `stop` requested an end.

    Args:
        study: the work on a case.
        cases: the cases.
        engine: where they run.
        store: holds the results of earlier runs by `key`; new ones are added as they come.
        key: name of a case in the store.
        group: cases of one group share preparations: a batch has cases of one group only.
        progress: called with the number of cases that are done.
        stop: whether no further batch is to begin.
    """
    results: dict[int, Result] = {}
    if store is not None:
        kept = store.results
        results = {i: kept[name] for i, case in enumerate(cases) if (name := key(case)) in kept}
    progress(len(results))
    left = [i for i in range(len(cases)) if i not in results]
    batches = _Batches(cases, left, group, engine.slots, stop)
    begin = perf_counter()
    for done in engine.completed(study, batches):
        indices = batches.took(done)
        results.update(zip(indices, done.results, strict=True))
        if store is not None:
            store.add({key(cases[i]): results[i] for i in indices})
        progress(len(results))
    if store is not None:
        store.took(perf_counter() - begin)
    return [results[i] for i in sorted(results)]


class _Batches(Generic[Case]):
    """Batches of the cases that are left, sized by what cases have cost so far."""

    def __init__(
        self,
        cases: Sequence[Case],
        left: Sequence[int],
        group: Callable[[Case], Hashable],
        slots: Callable[[], int],
        stop: Callable[[], bool],
    ) -> None:
        self._cases, self._slots, self._stop = cases, slots, stop
        by_group: dict[Hashable, list[int]] = {}
        for i in left:
            by_group.setdefault(group(cases[i]), []).append(i)
        self._groups = [indices[::-1] for indices in reversed(by_group.values())]
        self._left = len(left)
        self._out: dict[int, list[int]] = {}
        self._number = self._known = 0
        self._duration = 0.0

    def __iter__(self) -> Iterator[CaseBatch]:
        return self

    def __next__(self) -> CaseBatch:
        if not self._groups or self._stop():
            raise StopIteration
        group, size = self._groups[-1], self._size()
        indices = [group.pop() for _ in range(min(size, len(group)))]
        if not group:
            self._groups.pop()
        self._left -= len(indices)
        self._number += 1
        self._out[self._number] = indices
        return CaseBatch(self._number, tuple(self._cases[i] for i in indices))

    def _size(self) -> int:
        """Return how many cases take BATCH_TIME, fewer towards the end so that all workers end together."""
        if not self._known:
            return 1
        wanted = BATCH_TIME * self._known / max(self._duration, 1e-9)
        return max(1, int(min(wanted, self._left / (IN_FLIGHT * max(self._slots(), 1)))))

    def took(self, done: BatchDone) -> list[int]:
        """Add the cost of the cases of `done`; return their places among the cases."""
        self._known += len(done.results)
        self._duration += done.duration
        return self._out.pop(done.number)
