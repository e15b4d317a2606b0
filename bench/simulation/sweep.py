"""Sweeps: one pure function of many cases, on any engine, with results in the order of the cases.

A study is the work on each case. An engine runs batches of cases: this process (`InProcess`), processes of
this machine (`LocalProcesses`), or a cluster (`bench.simulation.cluster_engine`). Results are the same bit
for bit on all of them, as seeds come from the case and nothing of one case reaches another. With a store an
interrupted sweep resumes where it stopped; results of other code are neither reused nor mixed.

Linear algebra has one thread. The matrices of swings and campaigns are small: several processes with a BLAS
thread per core each take two to five times the processor time. And a product summed by two threads is rounded
otherwise than by one.
"""

from __future__ import annotations

import json
import os
import sys
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from hashlib import sha256
from importlib.metadata import version
from multiprocessing import current_process, get_context
from pathlib import Path
from time import perf_counter
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy.linalg  # noqa: F401 - a limit reaches libraries that are loaded
import scipy.linalg  # noqa: F401
from threadpoolctl import threadpool_limits

from bench.base.errors import BenchError, ExitCode
from bench.base.json_schema import json_object
from bench.base.process import end_with
from drivers.base.compile_report import announce_compilation
from drivers.base.machine_code import imported_sources

Case = TypeVar("Case")
Result = TypeVar("Result")
Case_contra = TypeVar("Case_contra", contravariant=True)
Result_co = TypeVar("Result_co", covariant=True)

BATCH_TIME = 4.0
"""Target duration of a batch, s: long compared with handing it out, short compared with a sweep."""
IN_FLIGHT = 2
"""Batches handed out for each worker, so that none waits for its next one."""
_LOST_IN_A_ROW = 3
"""Losses of workers without a result in between after which a sweep gives up."""
_SCHEMA = 2
_VARIABLE = "OPENBLAS_NUM_THREADS"
_TOP = Path(__file__).resolve().parents[2]
_PACKAGES = ("numba", "numpy", "scipy")


class Study(Protocol[Case_contra, Result_co]):
    """The work on each case: a value with all that the cases share, to be pickled.

    Raises of the function end the sweep.
    """

    def prepared(self) -> Callable[[Case_contra], Result_co]:
        """Return the function of a case; called once in a process, for what takes long to make."""
        ...


class CaseBatch(NamedTuple):
    """Cases for one worker at a time."""

    indices: list[int]
    """Positions among the cases of the sweep."""
    cases: list[Any]


class BatchDone(NamedTuple):
    """A batch that was run."""

    indices: list[int]
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
    return BatchDone(batch.indices, results, perf_counter() - begin)


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
    pace, begin = _Pace(engine), perf_counter()
    for done in engine.completed(study, _batches(cases, left, group, pace, stop)):
        pace.add(done)
        results.update(zip(done.indices, done.results, strict=True))
        if store is not None:
            store.add({key(cases[i]): results[i] for i in done.indices})
        progress(len(results))
    if store is not None:
        store.took(perf_counter() - begin)
    return [results[i] for i in sorted(results)]


class _Pace:
    """Sizes batches by what cases have cost so far."""

    def __init__(self, engine: Engine) -> None:
        self._engine, self._cases, self._duration = engine, 0, 0.0

    def add(self, done: BatchDone) -> None:
        self._cases += len(done.results)
        self._duration += done.duration

    def size(self, left: int) -> int:
        """Return how many cases take BATCH_TIME, fewer towards the end so that all workers end together."""
        if not self._cases:
            return 1
        wanted = BATCH_TIME * self._cases / max(self._duration, 1e-9)
        return max(1, int(min(wanted, left / (IN_FLIGHT * max(self._engine.slots(), 1)))))


def _batches(
    cases: Sequence[Case],
    left: Sequence[int],
    group: Callable[[Case], Hashable],
    pace: _Pace,
    stop: Callable[[], bool],
) -> Iterator[CaseBatch]:
    by_group: dict[Hashable, deque[int]] = {}
    for i in left:
        by_group.setdefault(group(cases[i]), deque()).append(i)
    count = len(left)
    for waiting in by_group.values():
        while waiting:
            if stop():
                return
            indices = [waiting.popleft() for _ in range(min(pace.size(count), len(waiting)))]
            count -= len(indices)
            yield CaseBatch(indices, [cases[i] for i in indices])


# Stored results --------------------------------------------------------------------------------------


class SweepStore(Generic[Result]):
    """Results of one sweep by case, and the time that they took."""

    def __init__(
        self,
        path: Path,
        digest: str,
        encode: Callable[[Result], dict[str, Any]],
        decode: Callable[[dict[str, Any]], Result],
    ) -> None:
        """Read the stored results; a file of another `digest` is replaced, a torn last line dropped.

        `digest` is of all that results depend on. `encode` makes JSON of a result, `decode` reads it.
        """
        self.path = path
        self._encode = encode
        self.results: dict[str, Result] = {}
        self.seconds = 0.0
        """Time that the results took over all runs, s."""
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        header = {"schema": _SCHEMA, "digest": digest}
        if not lines or json_object(lines[0]) != header:
            lines = [json.dumps(header)]
        kept = lines[:1]
        for line in lines[1:]:
            record = json_object(line) or {}
            if "seconds" in record:
                self.seconds += float(record["seconds"])
                kept.append(line)
            elif record:
                self.results[record["case"]] = decode(record["result"])
                kept.append(line)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(kept) + "\n")

    def add(self, results: Mapping[str, Result]) -> None:
        """Store `results` by case."""
        self.results.update(results)
        lines = [
            json.dumps({"case": case, "result": self._encode(result)}) for case, result in results.items()
        ]
        with self.path.open("a", encoding="utf-8") as file:
            file.write("".join(f"{line}\n" for line in lines))

    def took(self, seconds: float) -> None:
        """Store the duration of a run."""
        self.seconds += seconds
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"seconds": round(seconds, 1)}) + "\n")


def code_digest(*modules: str) -> str:
    """Return the digest (16 hex digits) of `modules` of this installation and all they import.

    It also covers the packages that compute: another NumPy may round otherwise.
    """
    packages = " ".join(f"{name} {version(name)}" for name in _PACKAGES)
    digest = sha256(f"python {sys.version_info[:2]} {packages}".encode())
    for path, source in imported_sources(_TOP, modules).items():
        digest.update(f"\n{path} {len(source)}\n".encode())
        digest.update(source)
    return digest.hexdigest()[:16]


# Engines of this machine -----------------------------------------------------------------------------


@contextmanager
def one_blas_thread_in_children() -> Iterator[None]:
    """Give one BLAS thread to processes started in the block, and to libraries loaded in it."""
    before = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = before


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Run the block with one thread of each BLAS: NumPy's, SciPy's, and those of libraries loaded in it."""
    with one_blas_thread_in_children(), threadpool_limits(1, "blas"):
        yield


class InProcess:
    """Runs batches in this process, one after the other."""

    def slots(self) -> int:
        """Return 1."""
        return 1

    def completed(self, study: Study[Any, Any], batches: Iterator[CaseBatch]) -> Iterator[BatchDone]:
        """Yield the batches in their order."""
        function: Callable[[Any], Any] | None = None
        for batch in batches:
            function = function or prepare(study)
            yield run_batch(function, batch)


class LocalProcesses:
    """Runs batches in processes of this machine; those of a process that dies are run again."""

    def __init__(self, count: int) -> None:
        self._count = count

    def slots(self) -> int:
        """Return the number of processes."""
        return self._count

    def completed(self, study: Study[Any, Any], batches: Iterator[CaseBatch]) -> Iterator[BatchDone]:
        """Yield batches as they are done; raises BenchError: processes die again and again."""
        again: deque[CaseBatch] = deque()
        lost = 0
        while lost < _LOST_IN_A_ROW:
            waiting: dict[Future[BatchDone], CaseBatch] = {}
            with ProcessPoolExecutor(self._count, get_context("spawn"), _begin, (os.getpid(), study)) as pool:
                try:
                    for done in _results(pool, waiting, again, batches, IN_FLIGHT * self._count):
                        lost = 0
                        yield done
                    return
                except BrokenProcessPool:
                    lost += 1
            again.extend(waiting.values())
        location, found = f"sweep with {self._count} processes", f"processes that died {lost} times in a row"
        action = "Look for lack of memory in the system's log; try --processes 1. Stored cases are kept."
        raise BenchError(location, found, "processes that run their cases", action, code=ExitCode.DEVICE)


def local_engine(processes: int = 0, cases: int = 2) -> Engine:
    """Return the engine for so many `cases` on this machine: `processes` or, with 0, one a core."""
    count = min(processes or len(os.sched_getaffinity(0)), cases)
    return InProcess() if count <= 1 else LocalProcesses(count)


def _results(
    pool: ProcessPoolExecutor,
    waiting: dict[Future[BatchDone], CaseBatch],
    again: deque[CaseBatch],
    batches: Iterator[CaseBatch],
    in_flight: int,
) -> Iterator[BatchDone]:
    """Yield the results of `again` and `batches`; `waiting` holds the batches handed out and not yielded."""
    while True:
        while len(waiting) < in_flight:
            batch = again.popleft() if again else next(batches, None)
            if batch is None:
                break
            try:
                with one_blas_thread_in_children():  # a library makes threads for all cores when it is loaded
                    waiting[pool.submit(_run, batch)] = batch
            except BrokenProcessPool:
                again.append(batch)
                raise
        if not waiting:
            return
        for future in wait(waiting, return_when=FIRST_COMPLETED).done:
            done = future.result()
            del waiting[future]
            yield done


_function: Callable[[Any], Any] | None = None
"""Function of a case, in a worker process."""


def _begin(parent: int, study: Study[Any, Any]) -> None:
    end_with(parent)  # else a pool's workers wait for ever after a signal has ended their parent
    if not current_process().name.endswith("-1"):  # all workers compile the same: one reports it
        announce_compilation(str)
    global _function  # noqa: PLW0603 - the only place where a pool's worker can keep its prepared function
    _function = prepare(study)


def _run(batch: CaseBatch) -> BatchDone:
    if _function is None:
        raise RuntimeError("worker not initialised")
    return run_batch(_function, batch)
