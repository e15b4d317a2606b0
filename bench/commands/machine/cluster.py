"""`golfbench cluster`: a scheduler and workers of dask on this machine, or workers for another one's."""

from __future__ import annotations

import os
from ipaddress import ip_address
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base.errors import BenchError
from bench.commands.common.options import option
from bench.commands.common.session import Session

if TYPE_CHECKING:
    from bench.base.address import IdentityFiles

_ALLOWED_DEATHS = 10
"""Workers that may die under one batch before dask gives it up: most die of something else."""

_CONFIGURATION = {
    "distributed.scheduler.allowed-failures": _ALLOWED_DEATHS,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "warning",
    # By default each process looks at itself up to 100 times per second, for pages that are not served here.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.worker.memory.monitor-interval": "1s",
    # With dask's thresholds malloc returns memory all the time: 40 times the page faults, 5 % of the time.
    # Malloc's own adaptation ends at the thresholds below.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 2**27,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 2**25,
}
"""Dask's configuration of scheduler, nannies and workers."""


def cluster(
    context: typer.Context,
    host: Annotated[str, option("IP address to listen at.", "ADDRESS")] = "127.0.0.1",
    port: Annotated[int, option("Port of the scheduler; 0: any.", low=0, high=65535)] = 8786,
    workers: Annotated[int | None, option("Number of workers.", low=0, shown="one per core")] = None,
    join: Annotated[str, option("Scheduler that the workers join, in place of one here.", "ADDRESS")] = "",
) -> None:
    """Start a scheduler and workers for `--cluster`, until Ctrl-C.

    Beyond this machine only with certificates (`network.identity`): who reaches a worker can run anything
    on it.
    """
    import asyncio

    from bench.base.address import identity_files
    from bench.simulation.cluster_engine import load_distributed

    load_distributed()
    identity = context.ensure_object(Session).configuration().network.identity
    files = identity_files(identity) if identity else None
    beyond = [location for location in (host, _host_of(join)) if location and not _is_loopback(location)]
    if files is None and beyond:
        found = f"{beyond[0]} without a certificate"
        action = "Make one with `golfbench certificates` and name it in network.identity."
        raise BenchError("golfbench cluster", found, "127.0.0.1, or a certificate of this machine", action)
    count = len(os.sched_getaffinity(0)) if workers is None else workers
    asyncio.run(_serve(host, port, count, join, files))


async def _serve(host: str, port: int, workers: int, join: str, files: IdentityFiles | None) -> None:
    import asyncio
    import logging
    import signal
    from contextlib import AsyncExitStack

    import dask
    from distributed import Nanny, Scheduler

    from bench.simulation.cluster_engine import security_of

    # Pages over HTTP would be open to everybody: none is served, the port is a free one of the loopback.
    settings: dict[str, Any] = {
        "protocol": "tls" if files else "tcp",
        "dashboard": False,
        "dashboard_address": "127.0.0.1:0",
    }
    if files:
        settings["security"] = security_of(files)
    dask.config.set(_CONFIGURATION)
    logging.getLogger("distributed").setLevel(logging.WARNING)
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with AsyncExitStack() as stack:
        address = join
        if not join:
            scheduler = Scheduler(host=host, port=port, **settings)
            address = (await stack.enter_async_context(scheduler)).address
            typer.echo(f"scheduler at {address}")
        nannies = [Nanny(address, nthreads=1, host=host, **settings) for _ in range(workers)]

        async def close_all() -> None:
            await asyncio.gather(*(nanny.close() for nanny in nannies))  # each takes seconds

        stack.push_async_callback(close_all)
        await asyncio.gather(*nannies)
        typer.echo(f"{workers} workers; Ctrl-C ends. Use it: golfbench faults run --cluster {address}")
        await stop.wait()


def _host_of(address: str) -> str:
    return address.partition("://")[2].rpartition(":")[0].strip("[]")


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
