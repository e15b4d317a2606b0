"""Options of every command that sweeps, and the engine they choose."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

from bench.commands.options import option
from bench.errors import BenchError

if TYPE_CHECKING:
    from bench.config import Configuration
    from bench.simulation.sweep import Engine

Processes = Annotated[int, option("Number of processes; 0: one per core.", low=0)]
ClusterAddress = Annotated[
    str,
    option(
        "Scheduler of a cluster that runs it instead, tcp://HOST:PORT or tls://HOST:PORT.",
        "ADDRESS",
        names="--cluster",
    ),
]


@contextmanager
def sweep_engine(configuration: Configuration, processes: int, cluster: str, cases: int) -> Iterator[Engine]:
    """Yield the engine for so many `cases`.

    Raises:
        BenchError: the cluster is not there, or a certificate for it.
    """
    from bench.address import identity_files
    from bench.simulation.local_engine import local_engine

    if not cluster:
        yield local_engine(processes, cases)
        return
    scheme, separator, rest = cluster.partition("://")
    if scheme not in ("tcp", "tls") or not separator or not rest:
        expected = "tcp://HOST:PORT or tls://HOST:PORT"
        raise BenchError("--cluster", repr(cluster), expected, "Copy what golfbench cluster says.")
    from bench.simulation.cluster_engine import connected

    files = identity_files(configuration.network.identity) if scheme == "tls" else None
    with connected(cluster, files) as engine:
        yield engine
