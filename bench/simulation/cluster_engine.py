"""The engine for sweeps on a cluster of dask's workers, on this machine or on many.

The study goes to the scheduler once and to each worker once; batches carry nothing but their cases. A
worker refuses a study of other code before it reads it. Batches of a worker that dies are run again, by dask
or, when dask gives up on them, from here. When the scheduler is lost, the sweep ends; with a store the next
run continues it.
"""

from __future__ import annotations

import asyncio
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from socket import gethostname
from threading import Lock
from time import monotonic
from typing import Any
from uuid import uuid4

from bench.base.address import IdentityFiles
from bench.base.errors import BenchError, ExitCode, Refused, load_extra
from bench.simulation.sweep import IN_FLIGHT, BatchDone, CaseBatch, Study, code_digest, prepare, run_batch

CONNECT_TIMEOUT = 10.0
"""Timeout of the scheduler, and of a first worker (s)."""
_LOOK = 1.0
"""Period of counting the workers (s)."""
_TRIES = 4
"""Max number of times that a batch is handed out; each time dask also retries it automatically."""
_ONE_AT_A_TIME = Lock()
"""Lock that keeps two threads of a worker from preparing studies at once."""


class SharedStudy:
    """A study that is sent to the workers, which keep it with the function it prepared."""

    def __init__(self, module: str, digest: str, payload: bytes) -> None:
        self._module, self._digest, self._payload = module, digest, payload

    @cached_property
    def function(self) -> Callable[[Any], Any]:
        """The function of a case.

        Raises:
            Refused: this worker's code differs from that of the sweep.
        """
        if (found := digest_of(self._module)) != self._digest:
            raise Refused(
                f"worker on {gethostname()}",
                f"code {found}",
                f"code {self._digest}, as where the sweep was started",
                "Install the same versions of golfbench, Python, numba, numpy and scipy on all machines.",
            )
        study: Study[Any, Any] = pickle.loads(self._payload)  # noqa: S301 - as all of dask's tasks
        return prepare(study)

    def __reduce__(self) -> tuple[Any, ...]:
        """Leave out the prepared function."""
        return SharedStudy, (self._module, self._digest, self._payload)


def digest_of(module: str) -> str:
    """Return the digest of the code of `module`; empty where it is not installed."""
    from importlib.util import find_spec

    try:
        found = find_spec(module)
    except ModuleNotFoundError:
        found = None
    return code_digest(module) if found else ""


class ClusterEngine:
    """Runs batches on the workers of a cluster."""

    def __init__(self, client: Any, address: str) -> None:
        """Use the connected `client` of distributed."""
        self._client, self._address = client, address
        self._slots, self._looked = 0, -_LOOK

    def slots(self) -> int:
        """Return how many batches run at a time: the workers' threads, looked at once a second."""
        if monotonic() - self._looked >= _LOOK:
            self._slots, self._looked = sum(self._client.nthreads().values()), monotonic()
        return self._slots

    def completed(self, study: Study[Any, Any], batches: Iterator[CaseBatch]) -> Iterator[BatchDone]:
        """Yield batches as they are done.

        Raises:
            Refused: a worker has other code.
            BenchError: the cluster is lost, or ends a batch again and again.
        """
        import distributed
        from distributed.comm.core import CommClosedError

        try:
            yield from self._completed(study, batches)
        except (OSError, TimeoutError, CommClosedError, distributed.client.FutureCancelledError) as error:
            raise _lost(self._address, str(error) or type(error).__name__) from error

    def _completed(self, study: Study[Any, Any], batches: Iterator[CaseBatch]) -> Iterator[BatchDone]:
        import distributed
        from distributed.scheduler import KilledWorker

        self._wait_for_workers()
        name, module = uuid4().hex, type(study).__module__
        arguments = (module, digest_of(module), pickle.dumps(study))
        # A task, not scattered data: the scheduler can make it again when its workers have died.
        shared = self._client.submit(SharedStudy, *arguments, key=f"study-{name}", pure=False)
        waiting: dict[Any, tuple[CaseBatch, int]] = {}
        results: Any = distributed.as_completed([], loop=self._client.loop)

        def hand_out(batch: CaseBatch, tried: int) -> None:
            key = f"batch-{name}-{batch.indices[0]}-{tried}"
            future = self._client.submit(_run, shared, batch, key=key, pure=False)
            waiting[future] = batch, tried
            results.add(future)

        while True:
            while len(waiting) < IN_FLIGHT * max(self.slots(), 1):
                if (batch := next(batches, None)) is None:
                    break
                hand_out(batch, 1)
            if not waiting:
                return
            future = next(results)
            batch, tried = waiting.pop(future)
            try:
                yield future.result(CONNECT_TIMEOUT)
            except KilledWorker as error:
                if tried == _TRIES:
                    raise _killing(self._address, batch) from error
                hand_out(batch, tried + 1)

    def _wait_for_workers(self) -> None:
        try:
            self._client.wait_for_workers(1, CONNECT_TIMEOUT)
        except TimeoutError:
            action = f"Start some: golfbench cluster --join {self._address}."
            where = f"cluster {self._address}"
            raise BenchError(where, "no workers", "at least one", action, code=ExitCode.DEVICE) from None


@contextmanager
def connected(address: str, files: IdentityFiles | None = None) -> Iterator[ClusterEngine]:
    """Yield the engine of the cluster whose scheduler is at `address`, such as tcp://127.0.0.1:8786.

    Raises:
        BenchError: dask.distributed is not installed, or no scheduler answers.
    """
    distributed = load_distributed()
    security = distributed.Security() if files is None else security_of(files)
    try:
        asyncio.run(_look(address, security))
        client = distributed.Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False, security=security)
    except (OSError, TimeoutError, ValueError, TypeError, RuntimeError) as error:
        raise _lost(address, str(error) or type(error).__name__) from None
    with client:
        yield ClusterEngine(client, address)


async def _look(address: str, security: Any) -> None:
    """Connect to the scheduler and leave: a client that cannot connect would leave its thread behind."""
    from distributed.comm.core import connect

    comm = await connect(address, timeout=CONNECT_TIMEOUT, **security.get_connection_args("client"))
    await comm.close()


def security_of(files: IdentityFiles) -> Any:
    """Return dask's settings for TLS on both sides of every connection."""
    distributed = load_distributed()
    pair = {
        f"tls_{role}_{part}": str(file)
        for role in ("client", "scheduler", "worker")
        for part, file in (("cert", files.certificate), ("key", files.key))
    }
    return distributed.Security(require_encryption=True, tls_ca_file=str(files.authority), **pair)


def load_distributed() -> Any:
    """Return the package. Raises BenchError if it is not installed."""
    return load_extra("distributed", "cluster", "--cluster")


def _run(shared: SharedStudy, batch: CaseBatch) -> BatchDone:
    with _ONE_AT_A_TIME:
        return run_batch(shared.function, batch)


def _lost(address: str, why: str) -> BenchError:
    action = "Start the scheduler (golfbench cluster), then run the command again: stored cases are skipped."
    found = why.strip().splitlines()[0]
    expected, code = "a scheduler that answers", ExitCode.NO_ANSWER
    return BenchError(f"cluster {address}", found, expected, action, code=code)


def _killing(address: str, batch: CaseBatch) -> BenchError:
    found = f"a batch whose workers died {_TRIES} times: {batch.cases[0]}"
    action = "Look for lack of memory in the workers' logs. Stored cases are kept."
    expected, code = "workers that run their cases", ExitCode.DEVICE
    return BenchError(f"cluster {address}", found, expected, action, code=code)
