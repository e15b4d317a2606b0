"""Engines for sweeps on this machine: this process, or several."""

from __future__ import annotations

import ctypes
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import current_process, get_context
from typing import Any

from bench.base.errors import BenchError, ExitCode
from bench.simulation.one_blas_thread import one_blas_thread_in_children
from bench.simulation.sweep import IN_FLIGHT, BatchDone, CaseBatch, Engine, Study, prepare, run_batch
from drivers.base.compile_report import announce_compilation

_PR_SET_PDEATHSIG = 1
_LOST_IN_A_ROW = 3
"""Losses of workers without a result in between after which a sweep gives up."""


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
        """Yield batches as they are done.

        Raises:
            BenchError: processes die again and again.
        """
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
        fault = BenchError(
            f"sweep with {self._count} processes",
            f"processes that died {lost} times in a row",
            "processes that run their cases",
            "Look for lack of memory in the system's log; try --processes 1. Stored cases are kept.",
        )
        fault.exit_code = ExitCode.DEVICE
        raise fault


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
    # Without it a pool's workers wait for ever after a signal has ended their parent.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)
    if not current_process().name.endswith("-1"):  # all workers compile the same: one reports it
        announce_compilation(str)
    global _function  # noqa: PLW0603 - the only place where a pool's worker can keep its prepared function
    _function = prepare(study)


def _run(batch: CaseBatch) -> BatchDone:
    if _function is None:
        raise RuntimeError("worker not initialised")
    return run_batch(_function, batch)
